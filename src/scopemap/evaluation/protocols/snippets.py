"""Protocols over short stretches: each window is scaled on its own, so that drift hardly shows."""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from scopemap.errors import check_shape
from scopemap.evaluation.pose_errors import ErrorSummary
from scopemap.evaluation.protocols.report import MatchedPoses, ProtocolReport
from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap.trajectory.trajectory import Trajectory

_AF_MOTIONS = 4
_AF_DESCRIPTION = (
    "Snippets of 5 frames from every frame on (shorter at the end), relative motions multiplied without inverting "
    "them, each snippet scaled by least squares, root of the summed squares divided by the number of positions (not by "
    "its root) in mm, rotation as the mean angle with the first identity in rad, mean and deviation over snippets."
)
_AF_SOURCE = "ShuweiShao/AF-SfMLearner: evaluate_pose.py; BeileiCui/EndoDAC: evaluate_pose.py"
_SURGCUT3R_FRAMES = 16


def af(estimate: Trajectory, reference: Trajectory) -> ProtocolReport:
    """Measure as AF-SfMLearner, EndoDAC and MonoPCC do, after `T_k = w2c_{k+1} w2c_k^-1`; see `af_from_relative`.

    A lost frame is left out: the motion then spans the gap, in estimate and reference alike.
    """
    poses = MatchedPoses.of(estimate, reference)
    figures = _af_figures(_target_from_source(poses.estimated), _target_from_source(poses.reference))
    return poses.report("af", figures, _AF_DESCRIPTION, _AF_SOURCE)


def af_from_relative(estimated: np.ndarray, reference: np.ndarray) -> ProtocolReport:
    """Measure relative poses as networks of this family put out, both (K, 4, 4), target frame <- source frame, mm.

    K poses make K - 1 windows of up to 4. The chain `c <- c T` from the identity gives positions and rotations that are
    no camera path, as T is not inverted; the published figures are made so. With positions p, q of a window of n:
    `ATE = sqrt(sum (s p - q)^2) / n`, `s = sum(p q) / sum(p p)`; `RE = mean angle(R_q R_p^-1)`, rad. `ci95` bounds the
    mean ATE by Student's t as EndoDAC does.
    Source: ShuweiShao/AF-SfMLearner, evaluate_pose.py; BeileiCui/EndoDAC, evaluate_pose.py.
    """
    check_shape("estimated", estimated, (None, 4, 4))
    check_shape("reference", reference, (len(estimated), 4, 4))
    figures = {f"af_{name}": value for name, value in _af_figures(estimated, reference).items()}
    return ProtocolReport("af", figures, len(estimated) + 1, 0, _AF_DESCRIPTION, _AF_SOURCE)


def _target_from_source(T_world_camera: np.ndarray) -> np.ndarray:
    return inverse(T_world_camera[1:]) @ T_world_camera[:-1]


def _af_figures(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    windows = [slice(start, start + _AF_MOTIONS) for start in range(len(estimated) - 1)]
    errors = [_snippet_errors(_chain(estimated[window]), _chain(reference[window])) for window in windows]
    ate_mm, re_rad = np.array(errors, dtype=np.float64).reshape(-1, 2).T
    ate, re = ErrorSummary.of(ate_mm), ErrorSummary.of(re_rad)
    half_width = _confidence_half_width(ate_mm)
    return {
        "ate_mean_mm": ate.mean,
        "ate_std_mm": ate.std,
        "ate_ci95_low_mm": ate.mean - half_width,
        "ate_ci95_high_mm": ate.mean + half_width,
        "re_mean_rad": re.mean,
        "re_std_rad": re.std,
        "windows": float(len(windows)),
    }


def _chain(motions: np.ndarray) -> np.ndarray:
    """Return the running products of (n, 4, 4) motions, beginning with the identity, (n + 1, 4, 4)."""
    chained = [np.eye(4)]
    for motion in motions:
        chained.append(chained[-1] @ motion)
    return np.stack(chained)


def _snippet_errors(estimated: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    positions, truth = estimated[:, :3, 3], reference[:, :3, 3]
    residual = least_squares_scale(positions, truth) * positions - truth
    # Inverted, not transposed: rotations out of a network in single precision are not quite orthogonal.
    turn = reference[:, :3, :3] @ np.linalg.inv(estimated[:, :3, :3])
    return float(np.linalg.norm(residual)) / len(positions), float(np.mean(rotation_angle_rad(turn)))


def _confidence_half_width(values: np.ndarray) -> float:
    """Half the width of the 95 % interval of the mean, Student's t; NaN for fewer than 2 values."""
    if len(values) < 2:
        return float("nan")
    return float(stdtrit(len(values) - 1, 0.975) * np.std(values, ddof=1) / np.sqrt(len(values)))


def least_squares_scale(positions: np.ndarray, reference: np.ndarray) -> float:
    """Return the s that minimises `sum (s p - q)^2` over (N, 3) rows; 1 where nothing moves and any s does."""
    squares = float(np.sum(positions**2))
    return float(np.sum(positions * reference)) / squares if squares > 0 else 1.0


def surgcut3r(estimate: Trajectory, reference: Trajectory) -> ProtocolReport:
    """Measure as SurgCUT3R does: first position aligned, nothing turned, least-squares scale, RMSE.

    Global over the whole path; local over windows of 16 frames that follow one another, each aligned on its own, mean
    and deviation of their RMSE; what is left at the end is not used. Since nothing is turned, both worlds must have the
    same axes. SCARED's have, for its world is the first camera; elsewhere read `surgcut3r_first_camera_...`, where both
    worlds are moved there first, which their code does not do.
    Source: chumo-xu/SurgCUT3R, unified_evaluation_framework/core/pose_evaluator.py.
    """
    poses = MatchedPoses.of(estimate, reference)
    theirs = _surgcut3r_figures(poses.estimated, poses.reference)
    moved = _surgcut3r_figures(*(inverse(T[0]) @ T for T in (poses.estimated, poses.reference)))
    return poses.report(
        "surgcut3r",
        theirs | {f"first_camera_{name}": value for name, value in moved.items()},
        "First position aligned without any rotation (first_camera: both worlds moved to the first camera before), "
        "least-squares scale, RMSE in mm: global over the path, local over successive windows of 16 frames, each "
        "aligned on its own, the rest dropped.",
        "chumo-xu/SurgCUT3R: unified_evaluation_framework/core/pose_evaluator.py",
    )


def _surgcut3r_figures(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    positions, truth = estimated[:, :3, 3], reference[:, :3, 3]
    global_rmse_mm, scale = _from_first_position(positions, truth)
    starts = range(0, len(positions) - _SURGCUT3R_FRAMES + 1, _SURGCUT3R_FRAMES)
    windows = [slice(start, start + _SURGCUT3R_FRAMES) for start in starts]
    local = ErrorSummary.of(np.array([_from_first_position(positions[w], truth[w])[0] for w in windows]))
    return {
        "global_ate_rmse_mm": global_rmse_mm,
        "global_scale": scale,
        "local_ate_rmse_mean_mm": local.mean,
        "local_ate_rmse_std_mm": local.std,
        "local_windows": float(len(windows)),
    }


def _from_first_position(positions: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    moved, truth = positions - positions[0], reference - reference[0]
    scale = least_squares_scale(moved, truth)
    return ErrorSummary.of(np.linalg.norm(scale * moved - truth, axis=1)).rmse, scale
