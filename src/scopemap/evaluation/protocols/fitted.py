"""Protocols that fit the whole path by Umeyama or Horn and then measure as evo does."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from scopemap.evaluation.pose_errors import (
    ErrorSummary,
    frame_pairs,
    path_pairs,
    relative_errors,
    rotation_errors_rad,
    translation_errors_mm,
)
from scopemap.evaluation.protocols.report import MatchedPoses, ProtocolReport
from scopemap.geometry.align import AlignMode, align_trajectories
from scopemap.trajectory.trajectory import Trajectory

_EVO_MODES: tuple[AlignMode, ...] = ("none", "se3", "sim3")
_EVO_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
_ONESLAM_PATH_MM = 1.0


def evo(estimate: Trajectory, reference: Trajectory) -> ProtocolReport:
    """Measure as `evo_ape` and `evo_rpe` do without alignment, with `-a` (SE3) and with `-as` (Sim3).

    Figures: `evo_MODE_ape_STATISTIC_mm|deg`, `evo_MODE_rpe_1_frame_STATISTIC_mm|deg`, `evo_sim3_scale`.
    Source: MichaelGrupp/evo, evo/core/metrics.py and geometry.py (definitions; agreement is tested against evo 1.38.1).
    """
    poses = MatchedPoses.of(estimate, reference)
    figures: dict[str, float] = {}
    for mode in _EVO_MODES:
        aligned, similarity = align_trajectories(poses.estimated, poses.reference, mode)
        for name, errors in _errors(aligned, poses.reference, frame_pairs(len(aligned), 1), "rpe_1_frame").items():
            measure, _, unit = name.rpartition("_")
            values = asdict(ErrorSummary.of(errors))
            figures |= {f"{mode}_{measure}_{key}_{unit}": values[key] for key in _EVO_STATISTICS}
    figures["sim3_scale"] = similarity.scale
    return poses.report(
        "evo",
        figures,
        "evo_ape and evo_rpe with no, SE3 (-a) and Sim3 (-as) alignment on all matched frames, mm and deg, RPE over "
        "1 frame.",
        "MichaelGrupp/evo: evo/core/metrics.py",
    )


def oneslam(estimate: Trajectory, reference: Trajectory) -> ProtocolReport:
    """Measure as OneSLAM's README does: evo after Sim3, RPE over 1 mm of path, all root mean squares.

    Its command says `--delta 1 --delta_unit m` on data in mm, so that the pairs lie 1 mm of path apart, within 10 %,
    measured along the *estimate* after alignment (evo's default).
    Source: MUZAMMILATEO/OneSLAM (as arcadelab/OneSLAM), README.md, "Minimal example".
    """
    poses = MatchedPoses.of(estimate, reference)
    aligned, similarity = align_trajectories(poses.estimated, poses.reference, "sim3")
    pairs = path_pairs(aligned[:, :3, 3], _ONESLAM_PATH_MM)
    figures = {"scale": similarity.scale, "rpe_pairs": float(len(pairs))}
    for name, errors in _errors(aligned, poses.reference, pairs, "rpe_1_mm_path").items():
        measure, _, unit = name.rpartition("_")
        figures[f"{measure}_rmse_{unit}"] = ErrorSummary.of(errors).rmse
    return poses.report(
        "oneslam",
        figures,
        "evo after Sim3 alignment on all matched frames, RMSE in mm and deg, RPE over all pairs 1 mm apart (within "
        "10 %) along the aligned estimate, not along the reference.",
        "MUZAMMILATEO/OneSLAM: README.md",
    )


def robust_pose_estimator(estimate: Trajectory, reference: Trajectory) -> ProtocolReport:
    """Measure as robust-pose-estimator does: ATE RMSE after Horn's SE3, mean RPE over 1 frame, rotation in rad.

    Its later versions leave out frames whose pose repeats the one before, as failed; here lost frames are left out by
    their status. Source: aimi-lab/robust-pose-estimator, alley_oop/metrics/trajectory_metrics.py.
    """
    poses = MatchedPoses.of(estimate, reference)
    aligned, _ = align_trajectories(poses.estimated, poses.reference, "se3")
    errors = _errors(aligned, poses.reference, frame_pairs(len(aligned), 1), "rpe")
    return poses.report(
        "robust-pose-estimator",
        {
            "ate_rmse_mm": ErrorSummary.of(errors["ape_mm"]).rmse,
            "rpe_1_frame_mean_mm": ErrorSummary.of(errors["rpe_mm"]).mean,
            "rpe_1_frame_mean_rad": float(np.radians(ErrorSummary.of(errors["rpe_deg"]).mean)),
        },
        "Horn's SE3 alignment without scale on all matched frames, RMSE of the position in mm, mean of the relative "
        "error over 1 frame in mm and rad.",
        "aimi-lab/robust-pose-estimator: alley_oop/metrics/trajectory_metrics.py",
    )


def _errors(aligned: np.ndarray, reference: np.ndarray, pairs: np.ndarray, rpe: str) -> dict[str, np.ndarray]:
    rpe_mm, rpe_rad = relative_errors(aligned, reference, pairs)
    return {
        "ape_mm": np.linalg.norm(translation_errors_mm(aligned, reference), axis=1),
        "ape_deg": np.degrees(rotation_errors_rad(aligned, reference)),
        f"{rpe}_mm": rpe_mm,
        f"{rpe}_deg": np.degrees(rpe_rad),
    }
