"""Published pose protocols by name, each as its authors compute it; published figures compare only under their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import numpy as np
from scipy.special import stdtrit

from scopemap.engine.geometry.align import AlignMode, align_trajectories
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.evaluation.poses import (
    ErrorSummary,
    frame_pairs,
    match,
    path_pairs,
    relative_errors,
    rotation_errors_rad,
    translation_errors_mm,
)
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap_bench.climb.figures import LEAST_FRAMES, climb_figures
from scopemap_bench.evaluation.protocol_words import PROTOCOL_WORDS

_EVO_MODES: tuple[AlignMode, ...] = ("none", "se3", "sim3")
_EVO_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
_ONESLAM_PATH_MM = 1.0
_AF_MOTIONS = 4
_SURGCUT3R_FRAMES = 16


@dataclass(frozen=True)
class Protocol:
    """A published protocol: call it with estimate and reference.

    description : one sentence: alignment, pairs, unit, deviations from evo. source : the repository and file that
    define it.
    measure : from estimate and reference to figures without the name's prefix.
    """

    name: str
    description: str
    source: str
    measure: Callable[[Trajectory, Trajectory], dict[str, float]]

    def __call__(self, estimate: Trajectory, reference: Trajectory) -> dict[str, float]:
        """Return the figures over the tracked frames, named PROTOCOL_NAME_UNIT; NaN where too few frames give one.

        Raises `AlignmentError` where fewer than 3 tracked frames match or a fit is degenerate.
        """
        prefix = self.name.replace("-", "_")
        return {f"{prefix}_{name}": float(value) for name, value in self.measure(estimate, reference).items()}


def _of_poses(
    measure: Callable[[np.ndarray, np.ndarray], dict[str, float]],
) -> Callable[[Trajectory, Trajectory], dict[str, float]]:
    """Return a measure of trajectories by the matched poses of tracked frames, (N, 4, 4) each, camera-to-world, mm."""

    def measured(estimate: Trajectory, reference: Trajectory) -> dict[str, float]:
        matched = match(estimate, reference, "none")
        return measure(matched.estimated[matched.tracked], matched.reference[matched.tracked])

    return measured


def _errors(aligned: np.ndarray, reference: np.ndarray, pairs: np.ndarray) -> dict[str, ErrorSummary]:
    """Return APE over the frames and RPE over the pairs, in mm and in deg."""
    rpe_mm, rpe_rad = relative_errors(aligned, reference, pairs)
    errors = {"ape_mm": translation_errors_mm(aligned, reference), "rpe_mm": rpe_mm}
    errors |= {"ape_deg": np.degrees(rotation_errors_rad(aligned, reference)), "rpe_deg": np.degrees(rpe_rad)}
    return {name: ErrorSummary.of(values) for name, values in errors.items()}


def _evo(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return MODE_ape_STATISTIC_mm|deg, MODE_rpe_1_frame_STATISTIC_mm|deg and sim3_scale."""
    figures: dict[str, float] = {}
    for mode in _EVO_MODES:
        aligned, similarity = align_trajectories(estimated, reference, mode)
        for name, summary in _errors(aligned, reference, frame_pairs(len(aligned), 1)).items():
            measure, unit = name.replace("rpe", "rpe_1_frame").rsplit("_", 1)
            values = asdict(summary)
            figures |= {f"{mode}_{measure}_{key}_{unit}": values[key] for key in _EVO_STATISTICS}
    return figures | {"sim3_scale": similarity.scale}


def _oneslam(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return evo's RMSE after Sim3; the README's `--delta 1 --delta_unit m` on data in mm makes pairs 1 mm apart."""
    aligned, similarity = align_trajectories(estimated, reference, "sim3")
    pairs = path_pairs(aligned[:, :3, 3], _ONESLAM_PATH_MM)
    errors = _errors(aligned, reference, pairs)
    return {
        "scale": similarity.scale,
        "rpe_pairs": float(len(pairs)),
        "ape_rmse_mm": errors["ape_mm"].rmse,
        "ape_rmse_deg": errors["ape_deg"].rmse,
        "rpe_1_mm_path_rmse_mm": errors["rpe_mm"].rmse,
        "rpe_1_mm_path_rmse_deg": errors["rpe_deg"].rmse,
    }


def _robust_pose_estimator(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return ATE RMSE and mean RPE after SE3; its later versions leave out repeated poses."""
    aligned, _ = align_trajectories(estimated, reference, "se3")
    errors = _errors(aligned, reference, frame_pairs(len(aligned), 1))
    return {
        "ate_rmse_mm": errors["ape_mm"].rmse,
        "rpe_1_frame_mean_mm": errors["rpe_mm"].mean,
        "rpe_1_frame_mean_rad": float(np.radians(errors["rpe_deg"].mean)),
    }


def _af(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return the figures of `T_k = w2c_{k+1} w2c_k^-1`; across a lost frame the motion spans the gap in both."""
    return af_figures(*(inverse(T[1:]) @ T[:-1] for T in (estimated, reference)))


def af_figures(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return the AF figures of relative poses, both (K, 4, 4), target frame <- source frame, mm.

    K poses make K - 1 windows of up to 4. The chain `c <- c T` from the identity is no camera path, as T is not
    inverted; the published figures are made so. With positions p, q of a window of n: `ATE = sqrt(sum (s p - q)^2) /
    n`, `s = sum(p q) / sum(p p)`; `RE = mean angle(R_q R_p^-1)`, rad. `ci95` bounds the mean ATE by Student's t as
    EndoDAC does.
    """
    windows = [slice(start, start + _AF_MOTIONS) for start in range(len(estimated) - 1)]
    errors = [_snippet_errors(_chain(estimated[window]), _chain(reference[window])) for window in windows]
    ate_mm, re_rad = np.array(errors, dtype=np.float64).reshape(-1, 2).T
    ate, re = ErrorSummary.of(ate_mm), ErrorSummary.of(re_rad)
    half_width = float("nan")
    if len(ate_mm) > 1:
        half_width = stdtrit(len(ate_mm) - 1, 0.975) * np.std(ate_mm, ddof=1) / np.sqrt(len(ate_mm))
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
    # Inverted, not transposed: a network's rotations in single precision are not exactly orthogonal.
    rotation = reference[:, :3, :3] @ np.linalg.inv(estimated[:, :3, :3])
    return float(np.linalg.norm(residual)) / len(positions), float(np.mean(rotation_angle_rad(rotation)))


def least_squares_scale(positions: np.ndarray, reference: np.ndarray) -> float:
    """Return the s that minimises `sum (s p - q)^2` over (N, 3) rows; 1 where all p are zero."""
    squares = float(np.sum(positions**2))
    return float(np.sum(positions * reference)) / squares if squares > 0 else 1.0


def _surgcut3r(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return the figures in the given worlds (of equal axes: nothing is rotated) and in those of the first cameras."""
    moved = _aligned_first_position(*(inverse(T[0]) @ T for T in (estimated, reference)))
    return _aligned_first_position(estimated, reference) | {f"first_camera_{k}": v for k, v in moved.items()}


def _aligned_first_position(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    def rmse_and_scale(rows: slice) -> tuple[float, float]:
        moved, truth = (T[rows, :3, 3] - T[rows, :3, 3][0] for T in (estimated, reference))
        scale = least_squares_scale(moved, truth)
        return ErrorSummary.of(np.linalg.norm(scale * moved - truth, axis=1)).rmse, scale

    global_rmse_mm, scale = rmse_and_scale(slice(None))
    starts = range(0, len(estimated) - _SURGCUT3R_FRAMES + 1, _SURGCUT3R_FRAMES)
    local = ErrorSummary.of(np.array([rmse_and_scale(slice(s, s + _SURGCUT3R_FRAMES))[0] for s in starts]))
    return {
        "global_ate_rmse_mm": global_rmse_mm,
        "global_scale": scale,
        "local_ate_rmse_mean_mm": local.mean,
        "local_ate_rmse_std_mm": local.std,
        "local_windows": float(len(starts)),
    }


def _simcol(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return medians, mm (the challenge prints cm), after one least-squares scale between *relative* translations."""
    estimated, reference = (inverse(T[0]) @ T for T in (estimated, reference))
    steps, true_steps = ((inverse(T[:-1]) @ T[1:])[:, :3, 3] for T in (estimated, reference))
    scale = least_squares_scale(steps, true_steps)
    scaled = estimated.copy()
    scaled[:, :3, 3] *= scale
    errors = _errors(scaled, reference, frame_pairs(len(scaled), 1))
    return {
        "ate_median_mm": errors["ape_mm"].median,
        "rte_median_mm": errors["rpe_mm"].median,
        "rot_median_deg": errors["rpe_deg"].median,
        "scale": scale,
    }


def _world_to_camera(T_world_camera: np.ndarray) -> np.ndarray:
    """Return world-to-camera matrices, world = first camera; their translation `-R^T c` depends on this choice."""
    return inverse(T_world_camera) @ T_world_camera[0]


def _endogslam(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return the mean residual of world-to-camera translations after SE3; both papers use 7 of 8 frames of C3VD."""

    def mean_mm(matrices: np.ndarray, truth: np.ndarray) -> float:
        return ErrorSummary.of(translation_errors_mm(align_trajectories(matrices, truth, "se3")[0], truth)).mean

    return {
        "ate_mean_mm": mean_mm(_world_to_camera(estimated), _world_to_camera(reference)),
        "ate_mean_as_stored_mm": mean_mm(inverse(estimated), inverse(reference)),
    }


def _free_surgs(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Return Sim3 figures of world-to-camera matrices taken as poses, and (`c2w_`) of camera-to-world poses."""
    figures: dict[str, float] = {}
    worlds = {"": (_world_to_camera(estimated), _world_to_camera(reference)), "c2w_": (estimated, reference)}
    for prefix, (matrices, truth) in worlds.items():
        aligned, _ = align_trajectories(matrices, truth, "sim3")
        errors = _errors(aligned, truth, frame_pairs(len(aligned), 1))
        figures[f"{prefix}ate_rmse_mm"] = errors["ape_mm"].rmse
        figures[f"{prefix}rpe_1_frame_mean_mm"] = errors["rpe_mm"].mean
        figures[f"{prefix}rpe_1_frame_mean_deg"] = errors["rpe_deg"].mean
    return figures


def _described(measures: dict[str, Callable[[Trajectory, Trajectory], dict[str, float]]]) -> Iterator[Protocol]:
    for name, measure in measures.items():
        words = PROTOCOL_WORDS[name]
        yield Protocol(name, words["description"].format(least_frames=LEAST_FRAMES), words["source"], measure)


_OF_POSES = {
    "evo": _evo,
    "af": _af,
    "endogslam": _endogslam,
    "surgcut3r": _surgcut3r,
    "free-surgs": _free_surgs,
    "simcol": _simcol,
    "robust-pose-estimator": _robust_pose_estimator,
    "oneslam": _oneslam,
}
_MEASURES = {name: _of_poses(measure) for name, measure in _OF_POSES.items()} | {"climb": climb_figures}
PROTOCOLS = {protocol.name: protocol for protocol in _described(_MEASURES)}
"""The protocols by name; `protocols.toml` describes them."""
