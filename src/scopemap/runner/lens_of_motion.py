"""The lens that nobody has given, from the motion of all keyframes after the last frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.config import Config
from scopemap.engine.mapping.judge import LensTest
from scopemap.engine.mapping.lens import LensKinds, angle_of_radius
from scopemap.engine.notices import Notice
from scopemap.input.scopes import ANY_LENS, FOV_RANGE_DEG, KINDS, SCOPES
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


@dataclass(frozen=True)
class OtherLens:
    """A lens for `Sequence.with_focal`, by its arguments."""

    focal_px: float
    source: str
    sigma_px: float
    fisheye: tuple[float, ...]

    def seen_by(self, sequence: Sequence) -> Sequence:
        """Return the sequence with this lens; that its camera is not known no longer holds."""
        warnings = sequence.source.warnings
        warnings[:] = [one for one in warnings if not (isinstance(one, Notice) and one.code == "camera-unknown")]
        return sequence.with_focal(self.focal_px, self.source, self.sigma_px, self.fisheye)


def lenses_of(sequence: Sequence, config: Config, *, again: bool) -> LensKinds:
    """Return what the lens of a sequence may be, as `lens_of_motion` takes it; no kinds where it is known."""
    if not (again or _is_assumed(sequence, config)):
        return LensKinds()
    scope = SCOPES.get(config.input.scope, ANY_LENS)
    return LensKinds({kind: KINDS[kind] for kind in scope.kinds}, _bend(sequence))


def lens_of_motion(sequence: Sequence, config: Config, lens: LensTest, *, again: bool) -> OtherLens | None:
    """Return the lens that left-out tracks fit; None where that of the sequence stays as it is.

    It stays where it is not assumed, where `input.focal` chooses how it is found, where the tracks do not contradict
    it, where they tell it badly, and where they fit a field of view that no endoscope has. again : whether it comes
    from the motion itself; then any change of more than 5 % is taken.
    """
    is_refined = again and lens.differs and (bool(lens.kind) or abs(lens.log_focal) > _FAR)
    if not ((_is_assumed(sequence, config) and lens.contradicts) or is_refined):
        return None
    focal_px, share = sequence.camera.fx * math.exp(lens.log_focal), _INFLATION * lens.sigma
    if share > _MOST_SHARE:
        return None
    bend = KINDS[lens.kind] if lens.kind else _bend(sequence)
    widest, fov, narrowest = (_fov_deg(sequence, focal_px * math.exp(n * share), bend) for n in (-2, 0, 2))
    if not FOV_RANGE_DEG[0] <= fov <= FOV_RANGE_DEG[1]:
        return None
    kind = next(name for name, coefficients in KINDS.items() if coefficients == bend)
    source = f"estimated: {kind}, field of view {fov:.0f} deg, from the motion, {narrowest:.0f} to {widest:.0f}"
    return OtherLens(focal_px, source, share * focal_px, bend)


def _is_assumed(sequence: Sequence, config: Config) -> bool:
    return sequence.camera_origin == "assumed" and config.input.focal == "auto"


def _bend(sequence: Sequence) -> tuple[float, ...]:
    """Return the coefficients of the lens that pictures are straightened by, () where they are not."""
    lens = sequence.rectifier.source
    return lens.distortion if isinstance(lens, FisheyeCamera) else ()


def _fov_deg(sequence: Sequence, focal_px: float, bend: tuple[float, ...]) -> float:
    """Return the horizontal field of view of a lens at the working size, degrees."""
    return 2 * math.degrees(angle_of_radius(bend, sequence.camera.width / 2 / focal_px))
