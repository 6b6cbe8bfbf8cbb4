"""The focal length of a lens that nobody has given, from the motion of all keyframes after the last frame."""

from __future__ import annotations

import math

from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.config import Config
from scopemap.engine.mapping.lens_test import LensTest
from scopemap.engine.notices import Notice
from scopemap.input.focal_length.from_motion import FOV_RANGE_DEG
from scopemap.input.sequence import Sequence

_MOST_SHARE = 0.1
"""Standard deviation of ln f above which an estimate is none: on drawn scenes of 100 frames it was at most .05, on ten
frames of 160 px, whose second pass could not be adjusted, .37."""
MOST_PASSES = 3  # by hand
"""Times that a run goes through its frames: the first lens may be far away, so that even flow and depth are worse."""
_FAR = 0.05  # of ln f: the field of view is to be right within 5 %
_INFLATION = 5.0
"""Factor of the standard deviation of ln f: errors of the predicted depth bias it, too. After the last pass drawn
scenes of 50, 110 and 130 degrees were off by up to 4.5 times the deviation that the tracks account for."""


def with_lens_of_motion(sequence: Sequence, config: Config, lens: LensTest, *, again: bool) -> Sequence | None:
    """Return the sequence with the focal length that left-out tracks fit; None where it stays as it is.

    It stays where it is not assumed, where `input.focal` chooses how it is found, where the tracks do not contradict
    it, where they tell it badly, and where they fit a field of view that no endoscope has. again : whether it comes
    from the motion itself; then any change of more than 5 % is taken.
    """
    is_assumed = sequence.camera_origin == "assumed" and config.input.focal == "auto"
    is_refined = again and lens.differs and abs(lens.log_focal) > _FAR
    if not ((is_assumed and lens.contradicts) or is_refined):
        return None
    focal_px, share = sequence.camera.fx * math.exp(lens.log_focal), _INFLATION * lens.sigma
    if share > _MOST_SHARE:
        return None
    widest, fov, narrowest = (_fov_deg(sequence, focal_px * math.exp(n * share)) for n in (-2, 0, 2))
    if not FOV_RANGE_DEG[0] <= fov <= FOV_RANGE_DEG[1]:
        return None
    source = f"estimated: field of view {fov:.0f} deg, from the motion, {narrowest:.0f} to {widest:.0f}"
    lens_model = sequence.rectifier.source
    bend = lens_model.distortion if isinstance(lens_model, FisheyeCamera) else ()
    # What was said before the first frame no longer holds.
    warnings = sequence.source.warnings
    warnings[:] = [one for one in warnings if not (isinstance(one, Notice) and one.code == "camera-unknown")]
    return sequence.with_focal(focal_px, source, share * focal_px, bend)


def _fov_deg(sequence: Sequence, focal_px: float) -> float:
    """Return the horizontal field of view of a focal length at the working size, degrees."""
    return math.degrees(2 * math.atan(sequence.camera.width / 2 / focal_px))
