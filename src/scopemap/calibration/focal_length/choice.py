"""Choice of an unknown camera's focal length: the assumed one, unless the estimate contradicts it significantly."""

from __future__ import annotations

from scopemap.calibration.focal_length.estimate import FocalEstimate, focal_from_motion
from scopemap.calibration.focal_length.windows import MAX_FRAMES
from scopemap.config import Config
from scopemap.errors import CalibrationError
from scopemap.io.sequence import Sequence

MAX_SHARE = 0.1
"""Standard deviation over the focal length above which an estimate is no better than the assumption."""

_MIN_DISTORTION = 0.05  # smaller estimates are noise


def with_focal_from_motion(sequence: Sequence, config: Config) -> tuple[Sequence, list[str]]:
    """Return a sequence of unknown camera with the focal length estimated from its motion, and notes on the estimate.

    `input.focal` "flow" takes any estimate, "auto" one of small deviation that contradicts the assumed focal length.
    Raises `CalibrationError` where the camera is known, and where there is no estimate for "flow".
    """
    estimate, assumed_px = focal_from_motion(sequence, config), sequence.camera.fx
    wanted = config.input.focal == "flow"
    if estimate.reason:
        if wanted:
            raise CalibrationError(
                f"input.focal = flow: the motion in {sequence.path} does not determine the focal length, "
                f"{estimate.reason}; "
                "give a calibration (--camera) or the field of view (--fov, with input.focal = assume)"
            )
        return sequence, [f"focal length: assumed, because the motion does not determine it: {estimate.reason}"]
    if not wanted and estimate.share > MAX_SHARE:
        return sequence, [f"focal length: assumed, because the estimate is uncertain: {_described(estimate)}"]
    if not wanted and not estimate.differs_from(assumed_px):
        return sequence, [
            f"focal length: assumed {assumed_px:.0f} px, consistent with the estimate: {_described(estimate)}"
        ]
    frames = min(sequence.count or MAX_FRAMES, MAX_FRAMES)
    source = f"estimated: from the motion of {frames} frames, {_described(estimate)}"
    return sequence.with_focal(estimate.focal_px, source, estimate.sigma_px), _distortion_note(estimate)


def _distortion_note(estimate: FocalEstimate) -> list[str]:
    if abs(estimate.distortion) < _MIN_DISTORTION:
        return []
    return [
        f"focal length: the lens has radial distortion, about {abs(estimate.distortion):.0%} at half the image's width "
        "from the centre; only a calibration corrects it (--camera)"
    ]


def _described(estimate: FocalEstimate) -> str:
    focal = f"fx {estimate.focal_px:.0f} +- {max(estimate.sigma_px, 1):.0f} px"
    return f"{focal}, horizontal field of view {estimate.fov_deg:.0f} deg"
