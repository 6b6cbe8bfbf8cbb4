"""The figures of tables 1 to 3 of the paper (arXiv 2508.11282, section "Evaluation Metrics"), per axis and in all.

The tables settle what the text leaves open: `T_avg` is the mean norm of the translation error, since RMSE^2 = T_avg^2 +
std^2, and rotations are radians. The interval of the RPE is not given: here 1 frame and 10 mm of reference path.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.geometry.align import Similarity, align_trajectories
from scopemap.evaluation.poses import (
    ErrorSummary,
    MatchedTrajectories,
    length_ratio,
    rotation_errors,
    rotation_errors_rad,
    rpe_over_frames,
    rpe_over_path,
    translation_errors_mm,
    unaligned_rotation_errors_rad,
)

_PATH_MM = 10.0


def paper_figures(matched: MatchedTrajectories) -> dict[str, Any]:
    """Return the paper's figures over the tracked frames, after the alignment of `matched`.

    `t_` is translation, `r_` rotation; `avg`, `std`, `rmse`, `fin`, `max` are mean, standard deviation (by N), root
    mean square, the last tracked frame's, and the largest error; `below_avg_percent` the share strictly below the mean.
    rpe_1_frame_, rpe_10_mm_path_ with mm, std_mm, rad, std_rad, deg, std_deg : relative error, mean and deviation.
    tlr : estimated over reference path length before the alignment; lost_percent : share of matched frames lost.
    t_fin_origin_mm, r_fin_origin_rad, r_fin_origin_deg : the last error after aligning the first tracked poses, without
    scale;
    t_fin_origin_scaled_mm : with that of the alignment.
    t_axes_mm : along x, y, z of the reference's first camera; r_axes_rad, r_axes_deg : about the axes of each reference
    camera, `R = R_z R_y R_x`.
    """
    ok = matched.tracked
    aligned, reference = matched.aligned[ok], matched.reference[ok]
    t = ErrorSummary.of(translation_errors_mm(aligned, reference))
    r = ErrorSummary.of(rotation_errors_rad(*matched.turned))
    r_unaligned = ErrorSummary.of(unaligned_rotation_errors_rad(matched))
    drift_mm, drift_rad = _end_point_drift(matched, 1.0)
    figures: dict[str, Any] = {
        "t_avg_mm": t.mean,
        "t_std_mm": t.std,
        "rmse_mm": t.rmse,
        "t_fin_mm": t.final,
        "t_max_mm": t.max,
        "t_below_avg_percent": t.below_mean_percent,
        "r_below_avg_percent": r.below_mean_percent,
        "tlr": length_ratio(matched),
        "lost_percent": float(100 * np.mean(~ok)),
        "t_fin_origin_mm": drift_mm,
        "t_fin_origin_scaled_mm": _end_point_drift(matched, matched.similarity.scale)[0],
    }
    angles_rad = {"r_avg": r.mean, "r_std": r.std, "r_rmse": r.rmse, "r_fin": r.final, "r_max": r.max}
    angles_rad |= {"r_unaligned": r_unaligned.mean, "r_unaligned_std": r_unaligned.std, "r_fin_origin": drift_rad}
    rpe = {"rpe_1_frame": rpe_over_frames(matched, 1), "rpe_10_mm_path": rpe_over_path(matched, _PATH_MM)}
    for name, (translation, rotation) in rpe.items():
        figures |= {f"{name}_mm": translation.mean, f"{name}_std_mm": translation.std}
        angles_rad |= {name: rotation.mean, f"{name}_std": rotation.std}
    figures |= {f"{name}_rad": angle for name, angle in angles_rad.items()}
    figures |= {f"{name}_deg": float(np.degrees(angle)) for name, angle in angles_rad.items()}
    along_axes_mm = (aligned[:, :3, 3] - reference[:, :3, 3]) @ matched.reference[0, :3, :3]
    about_axes_rad = _euler_xyz_rad(rotation_errors(*matched.turned))
    return figures | {
        "t_axes_mm": _per_axis(along_axes_mm),
        "r_axes_rad": _per_axis(about_axes_rad),
        "r_axes_deg": _per_axis(np.degrees(about_axes_rad)),
    }


def _euler_xyz_rad(R: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(R).as_euler("xyz") if len(R) else np.empty((0, 3))


def _per_axis(errors: np.ndarray) -> dict[str, dict[str, float]]:
    """Return the statistics of the absolute errors (N, 3) for x, y and z."""
    return {axis: asdict(ErrorSummary.of(column)) for axis, column in zip("xyz", np.abs(errors).T, strict=True)}


def _end_point_drift(matched: MatchedTrajectories, scale: float) -> tuple[float, float]:
    """Return the last tracked frame's error, mm and rad, after scaling and aligning the first tracked poses."""
    estimated, reference = matched.estimated[matched.tracked], matched.reference[matched.tracked]
    scaled = Similarity(scale, np.eye(3), np.zeros(3)).transform_poses(estimated)
    moved, _ = align_trajectories(scaled, reference, "origin")
    error_mm, error_rad = translation_errors_mm(moved, reference), rotation_errors_rad(moved, reference)
    return float(error_mm[-1]), float(error_rad[-1])
