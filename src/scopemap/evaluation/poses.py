"""Trajectories against the truth: which frames belong together, alignment, and the figures.

`match` does the first two once; each report is a function of what it returns, so that further protocols can be added
beside each other without matching again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from scopemap.errors import AlignmentError
from scopemap.evaluation.pose_errors import (
    ErrorSummary,
    frame_pairs,
    path_pairs,
    relative_errors,
    rotation_errors_rad,
    translation_errors_mm,
)
from scopemap.geometry.align import AlignMode, Similarity, align_trajectories
from scopemap.trajectory import Trajectory, path_length_mm

Association = Literal["auto", "index", "time"]
MIN_MATCHED = 3


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
    """

    estimated: np.ndarray
    aligned: np.ndarray
    reference: np.ndarray
    tracked: np.ndarray
    align: AlignMode
    similarity: Similarity

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
    ate_rmse_mm, ate_mean_mm : absolute translation error after the alignment.
    rotation_mean_deg, rotation_max_deg : absolute rotation error after the alignment.
    rotation_unaligned_mean_deg, rotation_unaligned_max_deg : rotation since the first tracked frame, no alignment.
    rpe_1_mm, rpe_1_deg, rpe_10_mm, rpe_10_deg : relative error over 1 and 10 frames, all pairs, RMSE, after scaling.
    tlr : estimated over true path length, before the alignment.
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


@dataclass(frozen=True)
class PaperReport:
    """The figures of the paper's table 1 (arXiv 2508.11282, section "Evaluation Metrics"), over the tracked frames.

    `t_avg_mm`, despite the paper's "per-axis", is the mean norm of the translation error: in all rows of its table 1
    RMSE^2 = T_avg^2 + std^2. Rotations are radians, as its values show. The interval of its RPE is not given: 1 frame
    and 10 mm of reference path stand here, mean and standard deviation of the translation.
    """

    t_avg_mm: float
    t_std_mm: float
    r_avg_rad: float
    r_std_rad: float
    rmse_mm: float
    t_fin_mm: float
    r_fin_rad: float
    rpe_1_frame_mm: float
    rpe_1_frame_std_mm: float
    rpe_10_mm_path_mm: float
    rpe_10_mm_path_std_mm: float
    t_max_mm: float
    r_max_rad: float
    t_below_avg_percent: float
    r_below_avg_percent: float
    tlr: float
    lost_percent: float


def associate(
    estimate: Trajectory, reference: Trajectory, *, by: Association = "auto", max_gap_s: float = 0.01
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the estimate and of the reference that belong together, both (N,) int64, in time order.

    By frame index where both have one (`auto`), else by the nearest time stamp, one to one, at most `max_gap_s` apart.
    Raises `AlignmentError` where "index" is asked for and a trajectory has none.
    """
    have_indices = estimate.has_indices and reference.has_indices
    if by == "index" and not have_indices:
        raise AlignmentError("cannot match by frame index: one of the trajectories gives only time stamps")
    if by == "index" or (by == "auto" and have_indices):
        _, rows_estimate, rows_reference = np.intersect1d(estimate.indices, reference.indices, return_indices=True)
        return rows_estimate, rows_reference
    return _associate_by_time(estimate.times_s, reference.times_s, max_gap_s)


def _associate_by_time(times_s: np.ndarray, reference_s: np.ndarray, max_gap_s: float) -> tuple[np.ndarray, np.ndarray]:
    if not len(times_s) or not len(reference_s):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    gaps, nearest = cKDTree(reference_s[:, None]).query(times_s[:, None])
    order = np.argsort(gaps, kind="stable")
    # The first of the sorted rows that claims a reference frame is the nearest one; the others go empty.
    rows_reference, claim = np.unique(nearest[order], return_index=True)
    rows_estimate = order[claim]
    # A hair beyond the limit counts as on it: decimal time stamps are not exact in binary.
    near = gaps[rows_estimate] <= max_gap_s + 1e-9
    return rows_estimate[near], rows_reference[near]


def match(estimate: Trajectory, reference: Trajectory, align: AlignMode) -> MatchedTrajectories:
    """Associate, fill lost frames with the last tracked pose, and align on the tracked frames.

    Frames that the reference itself calls lost are left out. Raises `AlignmentError` where fewer than 3 tracked frames
    match or the fit is degenerate.
    """
    known = reference.rows(reference.tracked)
    rows_estimate, rows_reference = associate(estimate, known)
    tracked = estimate.tracked[rows_estimate]
    if np.count_nonzero(tracked) < MIN_MATCHED:
        raise AlignmentError(_too_few(estimate, known, int(np.count_nonzero(tracked))))
    estimated = _held(estimate)[rows_estimate]
    truth = known.T_world_camera[rows_reference]
    _, similarity = align_trajectories(estimated[tracked], truth[tracked], align)
    return MatchedTrajectories(estimated, similarity.transform_poses(estimated), truth, tracked, align, similarity)


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


def evaluate_poses(estimate: Trajectory, reference: Trajectory, align: AlignMode) -> PoseReport:
    """Return the pose errors of `estimate` against `reference`; raises as `match`."""
    return pose_report(match(estimate, reference, align))


def pose_report(matched: MatchedTrajectories) -> PoseReport:
    """Return the figures that `scopemap evaluate` prints."""
    ok = matched.tracked
    distance = np.linalg.norm(translation_errors_mm(matched.aligned, matched.reference), axis=1)
    rotation = ErrorSummary.of(np.degrees(rotation_errors_rad(matched.aligned[ok], matched.reference[ok])))
    unaligned = ErrorSummary.of(np.degrees(_rotation_since_start_rad(matched)))
    rpe_1_mm, rpe_1_rad = _rpe(matched, 1)
    rpe_10_mm, rpe_10_rad = _rpe(matched, 10)
    return PoseReport(
        frames=len(ok),
        tracked=int(np.count_nonzero(ok)),
        align=matched.align,
        scale=matched.similarity.scale,
        ate_rmse_mm=ErrorSummary.of(distance[ok]).rmse,
        ate_hold_rmse_mm=ErrorSummary.of(distance).rmse,
        ate_mean_mm=ErrorSummary.of(distance[ok]).mean,
        rotation_mean_deg=rotation.mean,
        rotation_max_deg=rotation.max,
        rotation_unaligned_mean_deg=unaligned.mean,
        rotation_unaligned_max_deg=unaligned.max,
        rpe_1_mm=rpe_1_mm.rmse,
        rpe_1_deg=float(np.degrees(rpe_1_rad.rmse)),
        rpe_10_mm=rpe_10_mm.rmse,
        rpe_10_deg=float(np.degrees(rpe_10_rad.rmse)),
        tlr=_length_ratio(matched),
    )


def paper_report(matched: MatchedTrajectories) -> PaperReport:
    """Return the figures of the paper's table 1, in its units."""
    ok = matched.tracked
    aligned, reference = matched.aligned[ok], matched.reference[ok]
    t = ErrorSummary.of(np.linalg.norm(translation_errors_mm(aligned, reference), axis=1))
    r = ErrorSummary.of(rotation_errors_rad(aligned, reference))
    rpe_frame, _ = _rpe(matched, 1)
    # Pairs from the reference: a wrong scale must not choose its own pairs.
    by_path = relative_errors(aligned, reference, path_pairs(reference[:, :3, 3], 10.0))
    rpe_path = ErrorSummary.of(by_path[0])
    return PaperReport(
        t_avg_mm=t.mean,
        t_std_mm=t.std,
        r_avg_rad=r.mean,
        r_std_rad=r.std,
        rmse_mm=t.rmse,
        t_fin_mm=t.final,
        r_fin_rad=r.final,
        rpe_1_frame_mm=rpe_frame.mean,
        rpe_1_frame_std_mm=rpe_frame.std,
        rpe_10_mm_path_mm=rpe_path.mean,
        rpe_10_mm_path_std_mm=rpe_path.std,
        t_max_mm=t.max,
        r_max_rad=r.max,
        t_below_avg_percent=t.below_mean_percent,
        r_below_avg_percent=r.below_mean_percent,
        tlr=_length_ratio(matched),
        lost_percent=float(100 * np.mean(~ok)),
    )


def _rpe(matched: MatchedTrajectories, step: int) -> tuple[ErrorSummary, ErrorSummary]:
    pairs = matched.tracked_pairs(frame_pairs(len(matched.tracked), step))
    translation, rotation = relative_errors(matched.aligned, matched.reference, pairs)
    return ErrorSummary.of(translation), ErrorSummary.of(rotation)


def _rotation_since_start_rad(matched: MatchedTrajectories) -> np.ndarray:
    rows = np.flatnonzero(matched.tracked)
    pairs = np.stack([np.full(len(rows), rows[0]), rows], axis=1)
    return relative_errors(matched.estimated, matched.reference, pairs)[1]


def _length_ratio(matched: MatchedTrajectories) -> float:
    ok = matched.tracked
    reference_mm = path_length_mm(matched.reference[ok][:, :3, 3])
    estimated_mm = path_length_mm(matched.estimated[ok][:, :3, 3])
    return estimated_mm / reference_mm if reference_mm > 0 else float("nan")
