"""Doubts about two trajectories: how else they could be read, where they would agree far better. Said, never done.

A truth numbered from 1, poses world-to-camera, quaternions with the scalar first, metres read as mm and another clock
(`other_clocks`) leave figures that look like the errors of a method.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.align import AlignMode
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.evaluation.other_clocks import clock_readings, late_readings
from scopemap.evaluation.poses import (
    MatchedTrajectories,
    length_ratio,
    match,
    pose_report,
    rotation_errors,
    translation_errors_mm,
    unaligned_rotation_errors_rad,
)
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap.result.trajectories import read_trajectory

# An error that another reading divides by so much is the reading's, not the method's.
_BETTER = 5.0
# Smaller errors are rounding: a share of the path's spread, and rad.
_ROUNDING = 1e-6
_ROUNDING_RAD = 1e-5
# Positions that agree to this share of the path's spread contradict rotations that are so far off.
_AGREE = 0.05
_TURNED_DEG = 45.0
# Units differ by 1000; monocular scales beside it are off by some factor.
_UNIT_FACTOR = 1000.0
_NEAR = 2.0


@dataclass(frozen=True)
class _Errors:
    """Errors after a Sim(3) over the true path's spread; rotations after it, and since the first frame, deg."""

    ate_mm: float
    share: float
    turned_deg: float
    since_first_rad: float

    @classmethod
    def of(cls, estimate: Trajectory, reference: Trajectory) -> _Errors:
        """Return the errors of the tracked frames; raises `AlignmentError` as `match`."""
        matched = match(estimate, reference, "sim3")
        aligned, truth = matched.aligned[matched.tracked], matched.reference[matched.tracked]
        ate_mm = float(np.sqrt(np.mean(translation_errors_mm(aligned, truth) ** 2)))
        spread_mm = float(np.sqrt(truth[:, :3, 3].var(axis=0).sum()))
        turned_deg = float(np.degrees(rotation_angle_rad(rotation_errors(aligned, truth)).mean()))
        since_first_rad = float(unaligned_rotation_errors_rad(matched).mean())
        return cls(ate_mm, ate_mm / max(spread_mm, np.finfo(float).tiny), turned_deg, since_first_rad)

    @property
    def rank(self) -> tuple[float, float]:
        """What the least errors are found by, without rounding: of equal ones the first reading stands."""
        return max(self.share, _ROUNDING), max(self.since_first_rad, _ROUNDING_RAD)

    def improve(self, other: _Errors) -> bool:
        """Return whether these are a fifth of the others in position or rotation, and not worse in either."""
        nearer = other.share > _ROUNDING and self.share <= other.share / _BETTER
        turned = other.since_first_rad > _ROUNDING_RAD and self.since_first_rad <= other.since_first_rad / _BETTER
        worse = self.share > other.share + _ROUNDING or self.since_first_rad > other.since_first_rad + _ROUNDING_RAD
        return (nearer or turned) and not worse


@dataclass(frozen=True)
class _Reading:
    """Another reading of the two, and in words what it supposes and what to do."""

    estimate: Trajectory
    reference: Trajectory
    supposed: str
    remedy: str


def doubts(
    estimate: Trajectory, reference: Trajectory, matched: MatchedTrajectories, *, read_s: float = 0.0
) -> list[str]:
    """Return a sentence for each other reading of two trajectories that would explain the errors of `matched`.

    read_s : so much later than recorded `reference` is read already, s.
    """
    found = [_of_unit(matched)]
    try:
        errors = _Errors.of(estimate, reference)
    except AlignmentError:  # standing still: nothing tells
        return [one for one in found if one]
    said = _of_reading(estimate, reference, errors, read_s)
    found.append(said or _of_rotation(estimate, reference, errors))
    return [one for one in found if one]


def evaluate_poses(
    estimate: Trajectory | Path | str, reference: Trajectory | Path | str, align: AlignMode, *, first: int | None = None
) -> dict[str, Any]:
    """Return the errors of a trajectory against the true one, by name: `ate_rmse_mm`, `rotation_mean_deg`, `rpe_10_mm`.

    All names are in the docstring of `pose_report`. `doubts`, where there are any, are sentences: how else the two
    could be read, where they would agree far better. Raises `AlignmentError` where too few frames match, or where these
    determine no alignment, and what `read_trajectory` does.

    estimate, reference : trajectories, or what `read_trajectory` reads: files, folders of runs or of data sets.
    align : what is fitted first, "none", "origin" (the first frames), "se3", "sim3" or "scale" (the size alone).
    first : fit on so many tracked frames; None: on all.
    """
    one, other = (path if isinstance(path, Trajectory) else read_trajectory(path) for path in (estimate, reference))
    matched = match(one, other, align, first=first)
    doubted = doubts(one, other, matched)
    return pose_report(matched) | ({"doubts": doubted} if doubted else {})


def _of_unit(matched: MatchedTrajectories) -> str:
    fitted = matched.align in ("sim3", "scale")
    ratio = length_ratio(matched)
    factor = matched.similarity.scale if fitted else 1 / ratio if ratio > 0 else math.nan
    for times, one, other in ((_UNIT_FACTOR, "m", "mm"), (1 / _UNIT_FACTOR, "mm", "m")):
        if times / _NEAR <= factor <= times * _NEAR:
            what = "the fitted scale is" if fitted else "the ratio of the true to the estimated path is"
            return (
                f"{what} {factor:.4g}: the trajectory may be in {one} and read as {other}, or the truth in {other} and "
                f"read as {one}; state units by --unit and --truth-unit"
            )
    return ""


def _of_reading(estimate: Trajectory, reference: Trajectory, before: _Errors, read_s: float) -> str:
    """Return the sentence of the reading, or of two together, that leaves the least error; "" where none is better."""
    now, found = before, list[_Reading]()
    while len(found) < 2:
        better = _better(_readings(estimate, reference, read_s), now)
        # An offset that is fitted explains whole frames, too: it is tried where nothing else does.
        if not better and now.share > _ROUNDING:
            better = _better((_Reading(*read) for read in late_readings(estimate, reference, read_s)), now)
        if not better:
            break
        now, best = min(better, key=lambda pair: pair[0].rank)
        estimate, reference = best.estimate, best.reference
        found.append(best)
    if not found:
        return ""
    turns = f"{np.degrees(now.since_first_rad):.2f} in place of {np.degrees(before.since_first_rad):.2f} deg"
    left = f"ATE {now.ate_mm:.3f} in place of {before.ate_mm:.3f} mm, rotation {turns}"
    supposed, remedies = (
        " and ".join(words) for words in zip(*((one.supposed, one.remedy) for one in found), strict=True)
    )
    return f"{supposed}, which would leave {left} after a Sim(3); if so, {remedies}"


def _better(readings: Iterable[_Reading], now: _Errors) -> list[tuple[_Errors, _Reading]]:
    tried = [(errors, one) for one in readings if (errors := _errors(one)) is not None]
    return [(errors, one) for errors, one in tried if errors.improve(now)]


def _errors(reading: _Reading) -> _Errors | None:
    try:
        return _Errors.of(reading.estimate, reading.reference)
    except AlignmentError:
        return None


def _readings(estimate: Trajectory, reference: Trajectory, read_s: float) -> Iterator[_Reading]:
    for name, inverted in (("the truth", False), ("the trajectory", True)):
        one, other = (_inverted(estimate), reference) if inverted else (estimate, _inverted(reference))
        yield _Reading(one, other, f"the poses of {name} may be world-to-camera", "invert them")
    by_number = estimate.has_indices and reference.has_indices
    step_s = float(np.median(np.diff(reference.times_s))) if len(reference) > 1 else 0.0
    for by in (-1, 1):
        if by_number:
            shifted = replace(reference, indices=reference.indices + by)
            counted = "the truth may be numbered from 1" if by < 0 else "the truth's frame numbers may be one too low"
            yield _Reading(estimate, shifted, counted, f"make its numbers one {'higher' if by > 0 else 'lower'}")
        elif step_s > 0:
            shifted = replace(reference, times_s=reference.times_s + by * step_s)
            when = f"the truth may be one frame too {'early' if by > 0 else 'late'}"
            give = f"give --time-offset {read_s - by * step_s:.6g} to scopemap evaluate"
            yield _Reading(estimate, shifted, when, give)
    yield from (_Reading(*read) for read in clock_readings(estimate, reference))


def _of_rotation(estimate: Trajectory, reference: Trajectory, errors: _Errors) -> str:
    """Return a question where positions agree and rotations contradict them; ""."""
    if errors.share > _AGREE or errors.turned_deg < _TURNED_DEG:
        return ""
    start = f"positions agree (ATE {errors.ate_mm:.3f} mm), but rotations are {errors.turned_deg:.0f} deg off"
    matched = match(estimate, reference, "sim3")
    between = Rotation.from_matrix(rotation_errors(matched.aligned, matched.reference)[matched.tracked])
    constant = between.mean()
    axes = "one side may have OpenGL's axes, or the poses of another body than the camera"
    by = f", all by one turn of {np.degrees(constant.magnitude()):.0f} deg: {axes}; bring both to OpenCV's camera axes"
    found = [(float(np.degrees((constant.inv() * between).magnitude().mean())), by)]
    for one, other, whose in _rolled_readings(estimate, reference):
        left = _errors(_Reading(one, other, "", ""))
        columns = "correct the order of its columns, or name them in a header (qw qx qy qz)"
        if left is not None:
            found.append((left.turned_deg, f", {left.turned_deg:.2f} deg with the scalar of {whose}; {columns}"))
    least_deg, words = min(found, key=lambda pair: round(pair[0], 3))
    if least_deg <= errors.turned_deg / _BETTER:
        return start + words
    return f"{start}; check the order of the quaternions, and which way the rotations point"


def _rolled_readings(estimate: Trajectory, reference: Trajectory) -> Iterator[tuple[Trajectory, Trajectory, str]]:
    """Yield both with the quaternions of one in the other order, and whose scalar stands where, in words."""
    for by, order in ((-1, "first"), (1, "last")):
        yield estimate, _rolled(reference, by), f"the truth's quaternions {order}"
        yield _rolled(estimate, by), reference, f"the trajectory's quaternions {order}"


def _inverted(trajectory: Trajectory) -> Trajectory:
    return replace(trajectory, T_world_camera=inverse(trajectory.T_world_camera), others=())


def _rolled(trajectory: Trajectory, by: int) -> Trajectory:
    """Return a trajectory whose quaternions, x y z w, are rolled by so many places."""
    T, rows = trajectory.T_world_camera.copy(), trajectory.tracked
    xyzw = Rotation.from_matrix(T[rows, :3, :3]).as_quat()
    T[rows, :3, :3] = Rotation.from_quat(np.roll(xyzw, by, axis=1)).as_matrix()
    return replace(trajectory, T_world_camera=T)
