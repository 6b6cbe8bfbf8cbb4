"""True poses by another clock than the pictures': read later or earlier, by an offset that is stated or fitted.

The sign is that of evo's `--t_offset`: a picture of time t has the true pose of time t + offset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation, Slerp

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.align import AlignMode, align_trajectories
from scopemap.evaluation.poses import ErrorSummary, associate, match, translation_errors_mm
from scopemap.input.trajectory.trajectory import Trajectory

FIT: Final = "fit"
MOST_OFFSET_S = 0.5
"""Offsets that are tried, s, in either direction: more than a recorder delays its pictures by."""
_STEPS = 100  # in either direction: of 5 ms for half a second
# Fewer frames that have a true pose at every offset tried would be fitted by chance.
_LEAST_FRAMES = 10
# An offset is told apart from the best one where the error is so much larger: a share of it, or of the path's spread.
_RISE = 0.1
_RISE_OF_SPREAD = 1e-3
# Told to no better than this to either side, an offset would be any.
_MOST_DOUBT_S = 0.1
# True poses farther apart than so many usual steps have none between them.
_MOST_STEPS = 2.5


@dataclass(frozen=True)
class ClockFit:
    """An offset, s, and by how much it may be off, s: farther off the error is a tenth larger than the least."""

    offset_s: float
    within_s: float


class PoseCurve:
    """A trajectory's poses at any time: positions between two of them linearly, rotations by slerp."""

    def __init__(self, trajectory: Trajectory) -> None:
        known = trajectory.rows(trajectory.tracked)
        # Two poses of one time stamp, or a clock that went back, determine nothing between them.
        before = np.concatenate([[-np.inf], np.maximum.accumulate(known.times_s)[:-1]])
        known = known.rows(known.times_s > before)
        if len(known) < 2:
            raise AlignmentError(f"cannot read the truth by another clock: {len(known)} true poses, 2 are needed")
        self._times_s, self._positions = known.times_s, known.positions_mm
        self._turn = Slerp(known.times_s, Rotation.from_matrix(known.T_world_camera[:, :3, :3]))

    def knows(self, times_s: np.ndarray) -> np.ndarray:
        """Return (N,) bool: whether times (N,), s, lie between poses that are near each other."""
        steps_s = np.diff(self._times_s)
        within = (times_s >= self._times_s[0] - 1e-9) & (times_s <= self._times_s[-1] + 1e-9)
        step = np.clip(np.searchsorted(self._times_s, times_s) - 1, 0, len(steps_s) - 1)
        return np.asarray(within & (steps_s[step] <= _MOST_STEPS * np.median(steps_s)))

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """Return the poses (N, 4, 4) at times (N,), s, that it knows; the first or last one beyond its ends."""
        times_s = np.clip(times_s, self._times_s[0], self._times_s[-1])
        T = np.tile(np.eye(4), (len(times_s), 1, 1))
        T[:, :3, :3] = self._turn(times_s).as_matrix()
        T[:, :3, 3] = np.column_stack([np.interp(times_s, self._times_s, axis) for axis in self._positions.T])
        return T


def read_later(reference: Trajectory, offset_s: float) -> Trajectory:
    """Return the true poses as of `offset_s` later, s, under their own numbers and times; those without one left out.

    Raises `AlignmentError` where none is left.
    """
    curve = PoseCurve(reference)
    left = reference.rows(curve.knows(reference.times_s + offset_s))
    if not len(left):
        raise AlignmentError(f"cannot read the truth {offset_s:+.4g} s later: it has no poses then")
    poses = curve.at(left.times_s + offset_s)
    status = np.where(np.arange(len(left)) == 0, "initial", "ok")
    return replace(left, T_world_camera=poses, status=status)


def fitted_offset(
    estimate: Trajectory,
    reference: Trajectory,
    align: AlignMode,
    *,
    first: int | None = None,
    most_s: float = MOST_OFFSET_S,
) -> ClockFit | None:
    """Return the offset of less than `most_s` that leaves the least error of positions after the alignment.

    None where the poses do not tell it: on a straight path of constant speed the alignment absorbs any offset, and
    frames may be too few. All offsets are compared on the same frames, those that have a true pose by each.
    """
    known = reference.rows(reference.tracked)
    rows_estimate, rows_reference = associate(estimate, known)
    ok = estimate.tracked[rows_estimate]
    curve, offsets = PoseCurve(known), np.linspace(-most_s, most_s, 2 * _STEPS + 1)
    estimated, times_s = estimate.T_world_camera[rows_estimate[ok]], known.times_s[rows_reference[ok]]
    inside = np.all([curve.knows(times_s + offset) for offset in offsets], axis=0)
    if np.count_nonzero(inside) < max(_LEAST_FRAMES, first or 0):
        return None
    estimated, times_s = estimated[inside], times_s[inside]

    def error_mm(offset_s: float) -> float:
        truth = curve.at(times_s + offset_s)
        aligned, _ = align_trajectories(estimated, truth, align, first=first, by_orientations=True)
        return float(np.sqrt(np.mean(translation_errors_mm(aligned, truth) ** 2)))

    errors_mm = np.array([error_mm(float(offset)) for offset in offsets])
    best = int(np.argmin(errors_mm))
    if best in (0, len(offsets) - 1):
        return None
    spread_mm = float(np.sqrt(curve.at(times_s)[:, :3, 3].var(axis=0).sum()))
    # Of all that are as good the outermost: noise of the true poses makes an error wave from frame to frame.
    alike = offsets[errors_mm <= errors_mm[best] + max(_RISE * errors_mm[best], _RISE_OF_SPREAD * spread_mm)]
    within_s = float(np.abs(alike - offsets[best]).max()) + most_s / _STEPS
    if within_s > _MOST_DOUBT_S:
        return None
    found = minimize_scalar(error_mm, bounds=(offsets[best - 1], offsets[best + 1]), method="bounded")
    return ClockFit(float(found.x), within_s)


def by_clock(
    estimate: Trajectory,
    reference: Trajectory,
    align: AlignMode,
    offset: float | Literal["fit"],
    *,
    first: int | None = None,
) -> tuple[Trajectory, dict[str, Any]]:
    """Return the truth as read by another clock, and what says so; without an offset the truth itself, and {}.

    time_offset_s : so much later the truth is read, s; NaN where it was to be fitted and the poses do not tell it: the
        truth then is as recorded.
    time_offset : "stated", "fitted", or "not told by the poses".
    time_offset_within_s : by how much a fitted one may be off, s.
    ate_as_recorded_mm : RMSE of the positions after the alignment without the offset, to compare `ate_rmse_mm` with.
    """
    if offset == 0:
        return reference, {}
    fit = fitted_offset(estimate, reference, align, first=first) if offset == FIT else ClockFit(float(offset), 0.0)
    recorded = match(estimate, reference, align, first=first)
    errors_mm = translation_errors_mm(recorded.aligned, recorded.reference)[recorded.tracked]
    before = {"ate_as_recorded_mm": ErrorSummary.of(errors_mm).rmse}
    if fit is None:
        return reference, {"time_offset_s": float("nan"), "time_offset": "not told by the poses"} | before
    said: dict[str, Any] = {"time_offset_s": fit.offset_s, "time_offset": "fitted" if offset == FIT else "stated"}
    within = {"time_offset_within_s": fit.within_s} if offset == FIT else {}
    return read_later(reference, fit.offset_s), said | within | before


def clock_sentence(figures: dict[str, Any]) -> str:
    """Return what figures say of the truth's clock, in words; "" where they say nothing."""
    if "time_offset" not in figures:
        return ""
    offset_s, recorded = figures["time_offset_s"], f"ATE {figures['ate_as_recorded_mm']:.3f} mm as recorded"
    if np.isnan(offset_s):
        return (
            "the clock offset is not told by these poses (a straight path of constant speed looks the same at any, or "
            f"the frames are too few, or it exceeds {MOST_OFFSET_S} s): the truth is read as recorded"
        )
    how = figures["time_offset"]
    if "time_offset_within_s" in figures:
        how += f" to within {figures['time_offset_within_s']:.3f} s, by the least error"
    return f"the truth is read {abs(offset_s):.3f} s {'earlier' if offset_s < 0 else 'later'} ({how}); {recorded}"
