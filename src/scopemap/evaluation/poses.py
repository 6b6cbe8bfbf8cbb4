"""Trajectories against the truth: which frames belong together, alignment, and the figures.

`match` does the first two once; each report is a function of what it returns: `pose_report` here, the paper's own
figures in `paper`, other people's named protocols in `protocols`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from scopemap.errors import AlignmentError
from scopemap.evaluation.pose_errors import (
    ErrorSummary,
    below_percent,
    frame_pairs,
    path_pairs,
    relative_errors,
    rotation_errors_rad,
    translation_errors_mm,
)
from scopemap.geometry.align import AlignMode, Similarity, align_trajectories
from scopemap.trajectory.trajectory import Trajectory, path_length_mm

Association = Literal["auto", "index", "time"]
MIN_MATCHED = 3

# A hair beyond the limit counts as on it: decimal time stamps are not exact in binary.
_TIME_HAIR_S = 1e-9


@dataclass(frozen=True)
class MatchedTrajectories:
    """An estimate and its reference, frame by frame, and the alignment between them.

    Attributes
    ----------
    estimated : (N, 4, 4) as estimated, mm; lost frames hold the last tracked pose.
    aligned : (N, 4, 4) the same after the alignment, which is fitted on the tracked frames.
    reference : (N, 4, 4), mm.
    tracked : (N,) bool, False where the estimate is lost.
    align : the mode; similarity : what it found.
    fitted_frames : tracked frames that the alignment was taken from: 0 for `none`, 1 for `origin`.
    associated_by : "index" or "time".
    reference_frames, reference_in_span : frames whose true pose is known, and those of them that lie between the
        estimate's first and last frame and so could be matched.
    """

    estimated: np.ndarray
    aligned: np.ndarray
    reference: np.ndarray
    tracked: np.ndarray
    align: AlignMode
    similarity: Similarity
    fitted_frames: int
    associated_by: Association
    reference_frames: int
    reference_in_span: int

    @property
    def coverage(self) -> float:
        """Tracked frames over those that could be matched, 0..1; frames without an estimate count as lost do."""
        return float(np.count_nonzero(self.tracked) / self.reference_in_span)

    def tracked_pairs(self, pairs: np.ndarray) -> np.ndarray:
        """Return those of the row pairs (M, 2) of which both frames are tracked."""
        return pairs[self.tracked[pairs].all(axis=1)]


@dataclass(frozen=True)
class PoseReport:
    """Pose errors of one trajectory. NaN where too few frames give a figure.

    Attributes
    ----------
    frames, tracked : matched frames, and those of them that are not lost. All figures but the next are over these.
    ate_hold_rmse_mm : over all matched frames, lost ones filled with the last tracked pose.
    align, scale : mode of the alignment, and the scale that it found.
    ate_rmse_mm, ate_mean_mm, ate_median_mm, ate_max_mm : absolute translation error after the alignment.
    rotation_mean_deg, rotation_max_deg : absolute rotation error after the alignment.
    rotation_unaligned_mean_deg, rotation_unaligned_max_deg : rotation since the first tracked frame, no alignment.
    rpe_1_mm, rpe_1_deg, rpe_10_mm, rpe_10_deg : relative error over 1 and 10 frames, all pairs, RMSE, after scaling.
    tlr : estimated over true path length, before the alignment.
    rpe_10mm_path_mm, rpe_10mm_path_deg : relative error over 10 mm (within 10 %) of the true path, all pairs, RMSE.
    ate_below_1_mm_percent, ... : share of frames with an absolute error strictly below 1, 2, 5 mm and 1, 2, 5 deg.
    coverage, reference_frames : tracked frames over the true poses within the estimate's span, 0..1, and the number of
        true poses in all; a run that ended early has full coverage and few frames.
    longest_tracked : matched frames in the longest run without loss.
    frames_until_loss : matched frames before the first lost one; all where none is lost.
    """

    frames: int
    tracked: int
    align: AlignMode
    scale: float
    ate_rmse_mm: float
    ate_hold_rmse_mm: float
    ate_mean_mm: float
    rotation_mean_deg: float
    rotation_max_deg: float
    rotation_unaligned_mean_deg: float
    rotation_unaligned_max_deg: float
    rpe_1_mm: float
    rpe_1_deg: float
    rpe_10_mm: float
    rpe_10_deg: float
    tlr: float
    ate_median_mm: float
    ate_max_mm: float
    rpe_10mm_path_mm: float
    rpe_10mm_path_deg: float
    ate_below_1_mm_percent: float
    ate_below_2_mm_percent: float
    ate_below_5_mm_percent: float
    rotation_below_1_deg_percent: float
    rotation_below_2_deg_percent: float
    rotation_below_5_deg_percent: float
    coverage: float
    reference_frames: int
    longest_tracked: int
    frames_until_loss: int


def associate(
    estimate: Trajectory, reference: Trajectory, *, by: Association = "auto", max_gap_s: float = 0.01
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the estimate and of the reference that belong together, both (N,) int64, in time order.

    By frame index where both have one (`auto`), else by the nearest time stamp, one to one, at most `max_gap_s` apart.
    Raises `AlignmentError` where "index" is asked for and a trajectory has none.
    """
    if _by_index(estimate, reference, by):
        _, rows_estimate, rows_reference = np.intersect1d(estimate.indices, reference.indices, return_indices=True)
        return rows_estimate, rows_reference
    return _associate_by_time(estimate.times_s, reference.times_s, max_gap_s)


def _by_index(estimate: Trajectory, reference: Trajectory, by: Association) -> bool:
    have_indices = estimate.has_indices and reference.has_indices
    if by == "index" and not have_indices:
        raise AlignmentError("cannot match by frame index: one of the trajectories gives only time stamps")
    return by == "index" or (by == "auto" and have_indices)


def _associate_by_time(times_s: np.ndarray, reference_s: np.ndarray, max_gap_s: float) -> tuple[np.ndarray, np.ndarray]:
    if not len(times_s) or not len(reference_s):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    gaps, nearest = cKDTree(reference_s[:, None]).query(times_s[:, None])
    order = np.argsort(gaps, kind="stable")
    # The first of the sorted rows that claims a reference frame is the nearest one; the others go empty.
    rows_reference, claim = np.unique(nearest[order], return_index=True)
    rows_estimate = order[claim]
    near = gaps[rows_estimate] <= max_gap_s + _TIME_HAIR_S
    return rows_estimate[near], rows_reference[near]


def match(
    estimate: Trajectory,
    reference: Trajectory,
    align: AlignMode,
    *,
    first: int | None = None,
    by: Association = "auto",
    max_gap_s: float = 0.01,
) -> MatchedTrajectories:
    """Associate, fill lost frames with the last tracked pose, and align on the tracked frames.

    `first` fits the alignment on the first so many tracked frames only; `by` and `max_gap_s` as `associate` takes them.
    Frames that the reference itself calls lost are left out. Raises `AlignmentError` where fewer than 3 tracked frames
    match or the fit is degenerate.
    """
    known = reference.rows(reference.tracked)
    rows_estimate, rows_reference = associate(estimate, known, by=by, max_gap_s=max_gap_s)
    tracked = estimate.tracked[rows_estimate]
    if np.count_nonzero(tracked) < MIN_MATCHED:
        raise AlignmentError(_too_few(estimate, known, int(np.count_nonzero(tracked))))
    estimated = _held(estimate)[rows_estimate]
    truth = known.T_world_camera[rows_reference]
    _, similarity = align_trajectories(estimated[tracked], truth[tracked], align, first=first)
    by_index = _by_index(estimate, known, by)
    return MatchedTrajectories(
        estimated=estimated,
        aligned=similarity.transform_poses(estimated),
        reference=truth,
        tracked=tracked,
        align=align,
        similarity=similarity,
        fitted_frames=_fitted(align, int(np.count_nonzero(tracked)), first),
        associated_by="index" if by_index else "time",
        reference_frames=len(known),
        reference_in_span=_in_span(estimate, known, None if by_index else max_gap_s),
    )


def _fitted(align: AlignMode, tracked: int, first: int | None) -> int:
    if align in ("none", "origin"):
        return int(align == "origin")
    return tracked if first is None else min(first, tracked)


def _in_span(estimate: Trajectory, reference: Trajectory, max_gap_s: float | None) -> int:
    """Count the reference frames between the estimate's first and last: by index, or by time where a gap is given."""
    if max_gap_s is None:
        inside = (reference.indices >= estimate.indices[0]) & (reference.indices <= estimate.indices[-1])
    else:
        first_s, last_s = estimate.times_s.min() - max_gap_s, estimate.times_s.max() + max_gap_s
        inside = (reference.times_s >= first_s - _TIME_HAIR_S) & (reference.times_s <= last_s + _TIME_HAIR_S)
    return int(np.count_nonzero(inside))


def _held(trajectory: Trajectory) -> np.ndarray:
    """Return all poses, lost ones replaced by the last tracked before them (by the first tracked at the start)."""
    rows = np.where(trajectory.tracked, np.arange(len(trajectory)), -1)
    last = np.maximum.accumulate(rows)
    first_tracked = int(np.argmax(trajectory.tracked))
    return trajectory.T_world_camera[np.where(last < 0, first_tracked, last)]


def _too_few(estimate: Trajectory, reference: Trajectory, found: int) -> str:
    start = f"cannot compare the trajectories: {found} tracked frames match, at least {MIN_MATCHED} are needed; "
    if estimate.has_indices and reference.has_indices:
        return f"{start}frame numbers are {_span(estimate.indices)} and {_span(reference.indices)}"
    spans = f"{_span(estimate.times_s)} s and {_span(reference.times_s)} s"
    return f"{start}time stamps are {spans} (30 frames per s where a file has none); frame numbers as stamps match too"


def _span(values: np.ndarray) -> str:
    return f"{values[0]:.10g}..{values[-1]:.10g}" if len(values) else "none"


def evaluate_poses(
    estimate: Trajectory, reference: Trajectory, align: AlignMode, *, first: int | None = None
) -> PoseReport:
    """Return the pose errors of `estimate` against `reference`; raises as `match`."""
    return pose_report(match(estimate, reference, align, first=first))


def pose_report(matched: MatchedTrajectories) -> PoseReport:
    """Return the figures that `scopemap evaluate` prints."""
    ok = matched.tracked
    distance = np.linalg.norm(translation_errors_mm(matched.aligned, matched.reference), axis=1)
    ate = ErrorSummary.of(distance[ok])
    turned_deg = np.degrees(rotation_errors_rad(matched.aligned[ok], matched.reference[ok]))
    unaligned = ErrorSummary.of(np.degrees(_rotation_since_start_rad(matched)))
    rpe_1_mm, rpe_1_rad = rpe_over_frames(matched, 1)
    rpe_10_mm, rpe_10_rad = rpe_over_frames(matched, 10)
    rpe_path_mm, rpe_path_rad = rpe_over_path(matched, 10.0)
    return PoseReport(
        frames=len(ok),
        tracked=int(np.count_nonzero(ok)),
        align=matched.align,
        scale=matched.similarity.scale,
        ate_rmse_mm=ate.rmse,
        ate_hold_rmse_mm=ErrorSummary.of(distance).rmse,
        ate_mean_mm=ate.mean,
        rotation_mean_deg=ErrorSummary.of(turned_deg).mean,
        rotation_max_deg=ErrorSummary.of(turned_deg).max,
        rotation_unaligned_mean_deg=unaligned.mean,
        rotation_unaligned_max_deg=unaligned.max,
        rpe_1_mm=rpe_1_mm.rmse,
        rpe_1_deg=float(np.degrees(rpe_1_rad.rmse)),
        rpe_10_mm=rpe_10_mm.rmse,
        rpe_10_deg=float(np.degrees(rpe_10_rad.rmse)),
        tlr=length_ratio(matched),
        ate_median_mm=ate.median,
        ate_max_mm=ate.max,
        rpe_10mm_path_mm=rpe_path_mm.rmse,
        rpe_10mm_path_deg=float(np.degrees(rpe_path_rad.rmse)),
        ate_below_1_mm_percent=below_percent(distance[ok], 1.0),
        ate_below_2_mm_percent=below_percent(distance[ok], 2.0),
        ate_below_5_mm_percent=below_percent(distance[ok], 5.0),
        rotation_below_1_deg_percent=below_percent(turned_deg, 1.0),
        rotation_below_2_deg_percent=below_percent(turned_deg, 2.0),
        rotation_below_5_deg_percent=below_percent(turned_deg, 5.0),
        coverage=matched.coverage,
        reference_frames=matched.reference_frames,
        longest_tracked=longest_run(ok),
        frames_until_loss=frames_until_loss(ok),
    )


def rpe_over_frames(matched: MatchedTrajectories, step: int) -> tuple[ErrorSummary, ErrorSummary]:
    """Return the relative error over `step` frames, all pairs of tracked frames: translation mm and rotation rad."""
    return _rpe(matched, frame_pairs(len(matched.tracked), step))


def rpe_over_path(matched: MatchedTrajectories, length_mm: float) -> tuple[ErrorSummary, ErrorSummary]:
    """Return the relative error over `length_mm` of the true path, all pairs of tracked frames: mm and rad.

    The pairs come from the reference: a wrong scale must not choose its own.
    """
    return _rpe(matched, path_pairs(matched.reference[:, :3, 3], length_mm))


def _rpe(matched: MatchedTrajectories, pairs: np.ndarray) -> tuple[ErrorSummary, ErrorSummary]:
    translation, rotation = relative_errors(matched.aligned, matched.reference, matched.tracked_pairs(pairs))
    return ErrorSummary.of(translation), ErrorSummary.of(rotation)


def _rotation_since_start_rad(matched: MatchedTrajectories) -> np.ndarray:
    rows = np.flatnonzero(matched.tracked)
    pairs = np.stack([np.full(len(rows), rows[0]), rows], axis=1)
    return relative_errors(matched.estimated, matched.reference, pairs)[1]


def longest_run(tracked: np.ndarray) -> int:
    """Return the length of the longest run of frames (N,) bool that are all True."""
    breaks = np.flatnonzero(np.concatenate([[True], ~tracked, [True]]))
    return int(np.max(np.diff(breaks)) - 1)


def length_ratio(matched: MatchedTrajectories) -> float:
    """Return the estimated over the true path length through the tracked frames, before any alignment (TLR)."""
    ok = matched.tracked
    reference_mm = path_length_mm(matched.reference[ok][:, :3, 3])
    estimated_mm = path_length_mm(matched.estimated[ok][:, :3, 3])
    return estimated_mm / reference_mm if reference_mm > 0 else float("nan")


def frames_until_loss(tracked: np.ndarray) -> int:
    """Return how many of the frames (N,) bool come before the first that is False; N where none is."""
    return len(tracked) if tracked.all() else int(np.argmin(tracked))
