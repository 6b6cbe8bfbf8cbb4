"""Which focal length an unknown camera gets: the assumed one, unless the motion clearly says another."""

from __future__ import annotations

from scopemap.calibration.focal_length.estimate import FocalEstimate, focal_from_motion
from scopemap.calibration.focal_length.windows import MOST_FRAMES
from scopemap.config import Config
from scopemap.errors import CalibrationError
from scopemap.io.sequence import Sequence

LARGEST_SHARE = 0.1
"""Spread, one standard deviation over the focal length, above which an estimate is no better than an assumption."""

_LEAST_BEND = 0.05  # less is found where there is none


def with_focal_from_motion(sequence: Sequence, config: Config) -> tuple[Sequence, list[str]]:
    """Return a sequence of unknown camera with the focal length that its motion tells, and notes on what was found.

    `input.focal` "flow" takes any estimate, "auto" one of small spread that contradicts the assumed focal length.
    Raises `CalibrationError` where the camera is known, and where "flow" is asked for and there is no estimate.
    """
    estimate, assumed_px = focal_from_motion(sequence, config), sequence.camera.fx
    wanted = config.input.focal == "flow"
    if estimate.reason:
        if wanted:
            raise CalibrationError(
                f"input.focal = flow: the motion in {sequence.path} does not tell the focal length, {estimate.reason}; "
                "give a calibration (--camera) or the field of view (--fov, with input.focal = assume)"
            )
        return sequence, [f"focal length: assumed, for the motion does not tell it: {estimate.reason}"]
    if not wanted and estimate.share > LARGEST_SHARE:
        return sequence, [f"focal length: assumed, for the motion does not tell it well: {_described(estimate)}"]
    if not wanted and not estimate.differs_from(assumed_px):
        return sequence, [f"focal length: assumed {assumed_px:.0f} px, and the motion agrees: {_described(estimate)}"]
    frames = min(sequence.count or MOST_FRAMES, MOST_FRAMES)
    source = f"estimated: from the motion of {frames} frames, {_described(estimate)}"
    return sequence.with_focal(estimate.focal_px, source, estimate.sigma_px), _bend_note(estimate)


def _bend_note(estimate: FocalEstimate) -> list[str]:
    if abs(estimate.bend) < _LEAST_BEND:
        return []
    return [
        f"focal length: the lens bends straight lines, too, by about {abs(estimate.bend):.0%} half a picture's width "
        "from the middle; only a calibration takes that away (--camera)"
    ]


def _described(estimate: FocalEstimate) -> str:
    focal = f"fx {estimate.focal_px:.0f} +- {max(estimate.sigma_px, 1):.0f} px"
    return f"{focal}, horizontal field of view {estimate.fov_deg:.0f} deg"
