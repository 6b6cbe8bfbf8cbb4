"""Pose errors of a trajectory against the reference: association, alignment, absolute (APE) and relative (RPE) errors.

Poses are camera to world, (N, 4, 4) float64, mm, matched row by row. Definitions: evo's documentation and Sturm et al.,
"A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, section IV.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.align import AlignMode, Similarity, align_trajectories
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.evaluation.turn import NOT_DETERMINED, Turn
from scopemap.input.trajectory.trajectory import Trajectory, path_length_mm

MIN_MATCHED = 3
_MS_PER_S = 1000.0
# evo's 0.01 s, and a little over, since decimal time stamps are not exact in binary.
_MOST_GAP_S = 0.01 + 1e-9
# A pair over a path length is kept if its path differs by at most this share (evo's `rel_delta_tol`).
_PATH_TOLERANCE = 0.1


@dataclass(frozen=True)
class ErrorSummary:
    """Statistics of non-negative errors, in their unit; NaN where there are none. `std` divides by N, as in evo."""

    mean: float
    std: float
    rmse: float
    final: float
    max: float
    below_mean_percent: float
    median: float
    min: float
    sse: float

    @classmethod
    def of(cls, errors: np.ndarray) -> ErrorSummary:
        """Summarise errors of shape (N,)."""
        if len(errors) == 0:
            return cls(*[float("nan")] * 9)
        mean, squares = float(np.mean(errors)), np.square(errors)
        return cls(
            mean=mean,
            std=float(np.std(errors)),
            rmse=float(np.sqrt(np.mean(squares))),
            final=float(errors[-1]),
            max=float(np.max(errors)),
            below_mean_percent=below_percent(errors, mean),
            median=float(np.median(errors)),
            min=float(np.min(errors)),
            sse=float(np.sum(squares)),
        )


def below_percent(errors: np.ndarray, limit: float) -> float:
    """Return the share of errors (N,) strictly below `limit`, in percent; NaN where there are none."""
    return float(100 * np.mean(errors < limit)) if len(errors) else float("nan")


def translation_errors_mm(estimated: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the norms of `p_i - q_i`, (N,) mm: the absolute pose error (APE) in translation."""
    return np.asarray(np.linalg.norm(estimated[:, :3, 3] - reference[:, :3, 3], axis=1))


def rotation_errors(estimated: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the rotations `R(Q_i)^T R(P_i)`, (N, 3, 3), from the estimated to the reference camera."""
    return np.swapaxes(reference[:, :3, :3], 1, 2) @ estimated[:, :3, :3]


def rotation_errors_rad(estimated: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the angles of `rotation_errors`, (N,) rad in 0..pi: the absolute pose error (APE) in rotation."""
    return rotation_angle_rad(rotation_errors(estimated, reference))


def relative_errors(estimated: np.ndarray, reference: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return translation (M,) mm and rotation (M,) rad of `(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)` for pairs (M, 2) of rows.

    A rigid alignment changes neither; its scale changes the translation.
    """
    first, second = pairs[:, 0], pairs[:, 1]
    motion_estimated = inverse(estimated[first]) @ estimated[second]
    motion_reference = inverse(reference[first]) @ reference[second]
    error = inverse(motion_reference) @ motion_estimated
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angle_rad(error[:, :3, :3])


def frame_pairs(count: int, step: int) -> np.ndarray:
    """Return all row pairs (M, 2) that are `step` rows apart."""
    first = np.arange(count - step)
    return np.stack([first, first + step], axis=1)


def path_pairs(positions_mm: np.ndarray, length_mm: float) -> np.ndarray:
    """Return row pairs (M, 2) with `length_mm` of path between them, measured along `positions_mm` (N, 3).

    For each row the later row that comes closest, kept within 10 %.
    """
    path_mm = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions_mm, axis=0), axis=1))])
    pairs = []
    for row in range(len(path_mm) - 1):
        miss_mm = np.abs(path_mm[row + 1 :] - path_mm[row] - length_mm)
        nearest = int(np.argmin(miss_mm))
        if miss_mm[nearest] <= _PATH_TOLERANCE * length_mm:
            pairs.append((row, row + 1 + nearest))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


@dataclass(frozen=True)
class MatchedTrajectories:
    """An estimate and its reference, frame by frame, and the alignment between them.

    Attributes
    ----------
    estimated, reference : (N, 4, 4) mm; lost frames hold the last tracked pose. aligned : `estimated` after the
        alignment.
    tracked : (N,) bool, False where the estimate is lost.
    align, similarity : mode of the alignment, fitted on the tracked frames, and its result.
    turn : of the alignment, and how well it is determined.
    reference_frames, reference_in_span : reference poses, and those between the estimate's first and last frame.
    """

    estimated: np.ndarray
    aligned: np.ndarray
    reference: np.ndarray
    tracked: np.ndarray
    align: AlignMode
    similarity: Similarity
    turn: Turn
    reference_frames: int
    reference_in_span: int

    @property
    def turned(self) -> tuple[np.ndarray, np.ndarray]:
        """Aligned and true poses (M, 4, 4) of the tracked frames; none where the turn does not tell their rotation."""
        aligned, reference = self.aligned[self.tracked], self.reference[self.tracked]
        known = self.turn.determines_rotation(float(rotation_errors_rad(aligned, reference).mean()))
        return (aligned, reference) if known else (aligned[:0], reference[:0])

    @property
    def coverage(self) -> float:
        """Tracked frames over reference poses in the estimate's span, 0..1; missing frames count as lost."""
        return float(np.count_nonzero(self.tracked) / self.reference_in_span)


def associate(estimate: Trajectory, reference: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return matching rows of the estimate and of the reference, both (N,) int64, in time order.

    By frame index where both have one, else by the nearest time stamp, one to one, at most 0.01 s apart (as evo).
    """
    stamps, true_stamps, most_gap = _stamps(estimate, reference)
    if not len(stamps) or not len(true_stamps):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    gaps, nearest = cKDTree(true_stamps[:, None]).query(stamps[:, None])
    order = np.argsort(gaps, kind="stable")
    # A reference frame goes to the estimated frame nearest to it, the first in this order.
    rows_reference, claim = np.unique(nearest[order], return_index=True)
    rows_estimate = order[claim]
    near = gaps[rows_estimate] <= most_gap
    return rows_estimate[near], rows_reference[near]


def _stamps(estimate: Trajectory, reference: Trajectory) -> tuple[np.ndarray, np.ndarray, float]:
    """Return what frames are matched by, numbers where both have them, else times in s, and the largest gap."""
    if estimate.has_indices and reference.has_indices:
        return estimate.indices, reference.indices, 0.0
    return estimate.times_s, reference.times_s, _MOST_GAP_S


def match(
    estimate: Trajectory, reference: Trajectory, align: AlignMode, *, first: int | None = None
) -> MatchedTrajectories:
    """Associate, fill lost frames with the last tracked pose, and align on the tracked frames, or the `first` of them.

    Raises `AlignmentError` where fewer than 3 tracked frames match or the fit is degenerate.
    """
    known = reference.rows(reference.tracked)
    rows_estimate, rows_reference = associate(estimate, known)
    tracked = estimate.tracked[rows_estimate]
    if np.count_nonzero(tracked) < MIN_MATCHED:
        raise AlignmentError(_too_few(estimate, known, int(np.count_nonzero(tracked))))
    estimated = _with_last_pose(estimate)[rows_estimate]
    truth = known.T_world_camera[rows_reference]
    pairs = (estimated[tracked], truth[tracked])
    aligned, similarity = align_trajectories(*pairs, align, first=first, by_orientations=True)
    by_positions = align in ("se3", "sim3")
    turn = Turn.of(aligned[:first], pairs[1][:first], by_positions=by_positions, straight=similarity.straight)
    stamps, true_stamps, gap = _stamps(estimate, known)
    in_span = (true_stamps >= stamps.min() - gap) & (true_stamps <= stamps.max() + gap)
    return MatchedTrajectories(
        estimated=estimated,
        aligned=similarity.transform_poses(estimated),
        reference=truth,
        tracked=tracked,
        align=align,
        similarity=similarity,
        turn=turn,
        reference_frames=len(known),
        reference_in_span=int(np.count_nonzero(in_span)),
    )


def _with_last_pose(trajectory: Trajectory) -> np.ndarray:
    """Return all poses (N, 4, 4); lost frames have the last tracked pose, at the start the first tracked one."""
    last = np.maximum.accumulate(np.where(trajectory.tracked, np.arange(len(trajectory)), -1))
    return trajectory.T_world_camera[np.where(last < 0, int(np.argmax(trajectory.tracked)), last)]


def _too_few(estimate: Trajectory, reference: Trajectory, found: int) -> str:
    *stamps, gap = _stamps(estimate, reference)
    spans = [f"{values[0]:.10g}..{values[-1]:.10g}" if len(values) else "none" for values in stamps]
    start = f"cannot compare the trajectories: {found} tracked frames match, at least {MIN_MATCHED} are needed; "
    if gap == 0:
        otherwise = _numbered_otherwise(estimate, reference) or _clocked_otherwise(estimate, reference)
        return f"{start}frame numbers are {spans[0]} and {spans[1]}{otherwise}"
    times = f"time stamps are {spans[0]} s and {spans[1]} s (30 frames per s where a file has none)"
    otherwise = _clocked_otherwise(estimate, reference) or "; frame numbers as stamps match too"
    return f"{start}{times}{otherwise}"


def in_milliseconds(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory whose time stamps, or frame numbers, are taken for milliseconds."""
    stamps = trajectory.indices if trajectory.has_indices else trajectory.times_s
    return replace(trajectory, times_s=stamps / _MS_PER_S, has_indices=False)


def _clocked_otherwise(estimate: Trajectory, reference: Trajectory) -> str:
    """Return that time stamps would match if those of one side were milliseconds, in words; "" if not."""
    pairs = {"truth": (estimate, in_milliseconds(reference)), "trajectory": (in_milliseconds(estimate), reference)}
    shared = {whose: len(associate(*pair)[0]) for whose, pair in pairs.items()}
    whose = max(shared, key=lambda one: shared[one])
    if shared[whose] < max(MIN_MATCHED, min(len(estimate), len(reference)) / 2):
        return ""
    return f"; {shared[whose]} would match if the {whose}'s stamps were milliseconds: its first line may say # time: ms"


def _numbered_otherwise(estimate: Trajectory, reference: Trajectory) -> str:
    """Return that frame numbers would match if one side counted from another number, in words; "" if not."""
    if not (estimate.has_indices and reference.has_indices):
        return ""
    shared = {by: len(np.intersect1d(estimate.indices, reference.indices + by)) for by in (-1, 1)}
    by = max(shared, key=lambda one: shared[one])
    if shared[by] < max(MIN_MATCHED, len(estimate) / 2):
        return ""
    return f"; {shared[by]} would match with the truth's numbers one {'higher' if by > 0 else 'lower'}"


def pose_report(matched: MatchedTrajectories) -> dict[str, Any]:
    """Return the pose errors over the tracked frames that `scopemap evaluate` prints; NaN where frames are too few.

    frames, tracked : matched frames, and those of them that are not lost.
    align, scale : mode of the alignment, and the scale that it found.
    straight : "straight path" where the turn about it was fitted to the orientations; else "".
    turn : "not determined" where rotation errors after the alignment may be its own, and are NaN; else "".
    turn_bound_deg : what errors of the positions may turn the alignment by (`evaluation/turn.py`).
    ate_... : absolute translation error after the alignment; ate_hold_rmse_mm with lost frames held at the last pose.
    rotation_mean_deg, rotation_max_deg : absolute rotation error after the alignment.
    rotation_unaligned_mean_deg, rotation_unaligned_max_deg : rotation since the first tracked frame, no alignment.
    rpe_1_mm, rpe_1_deg, rpe_10_mm, rpe_10_deg : relative error over 1 and 10 frames, all pairs, RMSE, after scaling.
    tlr : estimated over reference path length, before the alignment.
    rpe_10mm_path_mm, rpe_10mm_path_deg : relative error over 10 mm (within 10 %) of reference path, all pairs, RMSE.
    ..._below_..._percent : share of frames with an absolute error strictly below 1, 2 and 5 mm or deg.
    coverage : tracked frames over the reference poses within the estimate's span, 0..1; reference_frames : in all.
    longest_tracked, frames_until_loss : matched frames in the longest run without loss, and before the first loss.
    """
    ok = matched.tracked
    held_mm = translation_errors_mm(matched.aligned, matched.reference)
    error_mm, error_deg = held_mm[ok], np.degrees(rotation_errors_rad(*matched.turned))
    ate, rotation = ErrorSummary.of(error_mm), ErrorSummary.of(error_deg)
    unaligned_rad = ErrorSummary.of(unaligned_rotation_errors_rad(matched))
    (rpe_1_mm, rpe_1_rad), (rpe_10_mm, rpe_10_rad) = rpe_over_frames(matched, 1), rpe_over_frames(matched, 10)
    rpe_path_mm, rpe_path_rad = rpe_over_path(matched, 10.0)
    return {
        "frames": len(ok),
        "tracked": int(np.count_nonzero(ok)),
        "align": matched.align,
        "straight": "straight path" if matched.similarity.straight else "",
        "turn": "" if len(error_deg) else NOT_DETERMINED,
        "turn_bound_deg": float(np.degrees(matched.turn.bound_rad)),
        "scale": matched.similarity.scale,
        "ate_rmse_mm": ate.rmse,
        "ate_hold_rmse_mm": ErrorSummary.of(held_mm).rmse,
        "ate_mean_mm": ate.mean,
        "rotation_mean_deg": rotation.mean,
        "rotation_max_deg": rotation.max,
        "rotation_unaligned_mean_deg": float(np.degrees(unaligned_rad.mean)),
        "rotation_unaligned_max_deg": float(np.degrees(unaligned_rad.max)),
        "rpe_1_mm": rpe_1_mm.rmse,
        "rpe_1_deg": float(np.degrees(rpe_1_rad.rmse)),
        "rpe_10_mm": rpe_10_mm.rmse,
        "rpe_10_deg": float(np.degrees(rpe_10_rad.rmse)),
        "tlr": length_ratio(matched),
        "ate_median_mm": ate.median,
        "ate_max_mm": ate.max,
        "rpe_10mm_path_mm": rpe_path_mm.rmse,
        "rpe_10mm_path_deg": float(np.degrees(rpe_path_rad.rmse)),
        **{f"ate_below_{limit}_mm_percent": below_percent(error_mm, limit) for limit in (1, 2, 5)},
        **{f"rotation_below_{limit}_deg_percent": below_percent(error_deg, limit) for limit in (1, 2, 5)},
        "coverage": matched.coverage,
        "reference_frames": matched.reference_frames,
        "longest_tracked": longest_run(ok),
        "frames_until_loss": frames_until_loss(ok),
    }


def unaligned_rotation_errors_rad(matched: MatchedTrajectories) -> np.ndarray:
    """Return the errors of the rotation since the first tracked frame, (N,) rad of the tracked frames, no alignment."""
    rows = np.flatnonzero(matched.tracked)
    since_first = np.stack([np.full(len(rows), rows[0]), rows], axis=1)
    return relative_errors(matched.estimated, matched.reference, since_first)[1]


def rpe_over_frames(matched: MatchedTrajectories, step: int) -> tuple[ErrorSummary, ErrorSummary]:
    """Return the relative error over `step` frames, all pairs of tracked frames: translation mm and rotation rad."""
    return _rpe(matched, frame_pairs(len(matched.tracked), step))


def rpe_over_path(matched: MatchedTrajectories, length_mm: float) -> tuple[ErrorSummary, ErrorSummary]:
    """Return the relative error over `length_mm` of reference path, all pairs of tracked frames: mm and rad.

    The pairs are chosen on the reference: on the estimate a wrong scale would change them.
    """
    return _rpe(matched, path_pairs(matched.reference[:, :3, 3], length_mm))


def _rpe(matched: MatchedTrajectories, pairs: np.ndarray) -> tuple[ErrorSummary, ErrorSummary]:
    tracked = pairs[matched.tracked[pairs].all(axis=1)]
    translation, rotation = relative_errors(matched.aligned, matched.reference, tracked)
    return ErrorSummary.of(translation), ErrorSummary.of(rotation)


def length_ratio(matched: MatchedTrajectories) -> float:
    """Return the estimated over the reference path length through the tracked frames, before any alignment (TLR)."""
    ok = matched.tracked
    reference_mm = path_length_mm(matched.reference[ok][:, :3, 3])
    estimated_mm = path_length_mm(matched.estimated[ok][:, :3, 3])
    return estimated_mm / reference_mm if reference_mm > 0 else float("nan")


def longest_run(tracked: np.ndarray) -> int:
    """Return the length of the longest run of frames (N,) bool that are all True."""
    breaks = np.flatnonzero(np.concatenate([[True], ~tracked, [True]]))
    return int(np.max(np.diff(breaks)) - 1)


def frames_until_loss(tracked: np.ndarray) -> int:
    """Return the number of frames (N,) bool before the first that is False; N where none is."""
    return len(tracked) if tracked.all() else int(np.argmin(tracked))
