"""The figures of the paper's tables 1 to 3 (arXiv 2508.11282, section "Evaluation Metrics"), per axis and in all.

What its text leaves open is settled by its tables. `T_avg`, though called "per-axis", is the mean of the translation
error's norm: in all rows of table 1 RMSE^2 = T_avg^2 + std^2. Its rotations are radians, since they end at 3.142. The
interval of its RPE and its alignment are not given: here 1 frame and 10 mm of true path stand beside each other, and
the alignment is the caller's. "T < T_avg" compares a method with its own mean and cannot rank methods; the shares below
fixed limits in `PoseReport` can.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.evaluation.pose_errors import (
    AxisSummaries,
    ErrorSummary,
    along_first_camera_mm,
    rotation_errors_per_axis_rad,
    rotation_errors_rad,
    translation_errors_mm,
)
from scopemap.evaluation.poses import MatchedTrajectories, length_ratio, rpe_over_frames, rpe_over_path
from scopemap.geometry.align import align_trajectories

_PATH_MM = 10.0


@dataclass(frozen=True)
class PaperReport:
    """The paper's figures over the tracked frames, after the alignment that the trajectories were matched with.

    `t_` is translation, `r_` rotation; `avg`, `std`, `rmse`, `fin`, `max` are mean, standard deviation (N), root mean
    square, the last tracked frame's, and the largest error. Rotations stand in rad (the paper's unit) and in deg.

    Attributes
    ----------
    rpe_1_frame_..., rpe_10_mm_path_... : relative error over 1 frame and over 10 mm of true path, mean and deviation.
    t_below_avg_percent, r_below_avg_percent : share of frames strictly below the mean above it.
    tlr : estimated over true path length, before the alignment; lost_percent : share of matched frames that are lost.
    t_fin_origin_mm, r_fin_origin_rad, r_fin_origin_deg : end-point drift: the last tracked frame's error with only the
        first tracked poses put onto each other, no scale; t_fin_origin_scaled_mm : the same after the scale that the
        alignment found.
    t_axes_mm : along x, y, z of the reference's first camera; r_axes_rad, r_axes_deg : about the axes of each
        reference camera, from `euler_xyz(R(Q)^T R(P))`.
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
    r_rmse_rad: float
    rpe_1_frame_rad: float
    rpe_1_frame_std_rad: float
    rpe_10_mm_path_rad: float
    rpe_10_mm_path_std_rad: float
    r_avg_deg: float
    r_std_deg: float
    r_rmse_deg: float
    r_fin_deg: float
    r_max_deg: float
    rpe_1_frame_deg: float
    rpe_1_frame_std_deg: float
    rpe_10_mm_path_deg: float
    rpe_10_mm_path_std_deg: float
    t_fin_origin_mm: float
    t_fin_origin_scaled_mm: float
    r_fin_origin_rad: float
    r_fin_origin_deg: float
    t_axes_mm: AxisSummaries
    r_axes_rad: AxisSummaries
    r_axes_deg: AxisSummaries


def paper_report(matched: MatchedTrajectories) -> PaperReport:
    """Return the figures of the paper's tables."""
    ok = matched.tracked
    aligned, reference = matched.aligned[ok], matched.reference[ok]
    error_mm = translation_errors_mm(aligned, reference)
    t = ErrorSummary.of(np.linalg.norm(error_mm, axis=1))
    r = ErrorSummary.of(rotation_errors_rad(aligned, reference))
    about_axes_rad = rotation_errors_per_axis_rad(aligned, reference)
    frame_mm, frame_rad = rpe_over_frames(matched, 1)
    path_mm, path_rad = rpe_over_path(matched, _PATH_MM)
    drift_mm, drift_rad = _drift(matched, 1.0)
    return PaperReport(
        t_avg_mm=t.mean,
        t_std_mm=t.std,
        r_avg_rad=r.mean,
        r_std_rad=r.std,
        rmse_mm=t.rmse,
        t_fin_mm=t.final,
        r_fin_rad=r.final,
        rpe_1_frame_mm=frame_mm.mean,
        rpe_1_frame_std_mm=frame_mm.std,
        rpe_10_mm_path_mm=path_mm.mean,
        rpe_10_mm_path_std_mm=path_mm.std,
        t_max_mm=t.max,
        r_max_rad=r.max,
        t_below_avg_percent=t.below_mean_percent,
        r_below_avg_percent=r.below_mean_percent,
        tlr=length_ratio(matched),
        lost_percent=float(100 * np.mean(~ok)),
        r_rmse_rad=r.rmse,
        rpe_1_frame_rad=frame_rad.mean,
        rpe_1_frame_std_rad=frame_rad.std,
        rpe_10_mm_path_rad=path_rad.mean,
        rpe_10_mm_path_std_rad=path_rad.std,
        r_avg_deg=_deg(r.mean),
        r_std_deg=_deg(r.std),
        r_rmse_deg=_deg(r.rmse),
        r_fin_deg=_deg(r.final),
        r_max_deg=_deg(r.max),
        rpe_1_frame_deg=_deg(frame_rad.mean),
        rpe_1_frame_std_deg=_deg(frame_rad.std),
        rpe_10_mm_path_deg=_deg(path_rad.mean),
        rpe_10_mm_path_std_deg=_deg(path_rad.std),
        t_fin_origin_mm=drift_mm,
        t_fin_origin_scaled_mm=_drift(matched, matched.similarity.scale)[0],
        r_fin_origin_rad=drift_rad,
        r_fin_origin_deg=_deg(drift_rad),
        t_axes_mm=AxisSummaries.of(along_first_camera_mm(error_mm, matched.reference)),
        r_axes_rad=AxisSummaries.of(about_axes_rad),
        r_axes_deg=AxisSummaries.of(np.degrees(about_axes_rad)),
    )


def _deg(angle_rad: float) -> float:
    return float(np.degrees(angle_rad))


def _drift(matched: MatchedTrajectories, scale: float) -> tuple[float, float]:
    """Return the last tracked frame's error, mm and rad, after scaling and with the first tracked poses as one."""
    estimated, reference = matched.estimated[matched.tracked], matched.reference[matched.tracked]
    scaled = estimated.copy()
    scaled[:, :3, 3] *= scale
    moved, _ = align_trajectories(scaled, reference, "origin")
    end = slice(-1, None)
    error_mm = float(np.linalg.norm(translation_errors_mm(moved[end], reference[end])))
    return error_mm, float(rotation_errors_rad(moved[end], reference[end])[0])
