"""Pose errors as the CLiMB challenge (EndoVis at MICCAI 2026) computes them: every submap by its own Sim(3).

Source: EndoCartoScope/climb-challenge at 79d7435, evaluation/evaluation_utils.py, and README.md for the score. One
difference: where no two frames are as far apart as an RPE asks for, it is NaN here and 0 there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.engine.geometry.align import align_trajectories
from scopemap.evaluation.poses import ErrorSummary, associate, relative_errors, translation_errors_mm
from scopemap.input.trajectory.trajectory import Trajectory

LEAST_FRAMES = 250
"""Frames of the reference that a submap needs to count, 5 s of video; 100 before the challenge's commit 79d7435."""

# What a factor of the score adds at most, and the errors of a clip of which not more than half is found.
_MOST_ADDED = 0.5
_FAILED_MM = 25.0
_FAILED_DEG = 20.0
_LEAST_TFR_PERCENT = 50.0
_RPE_FRAMES = (1, 10, 20, 40)
_RPE_NAMES = tuple(f"rpe_{step}_mean_{unit}" for step in _RPE_FRAMES for unit in ("mm", "deg"))
_ERRORS = ("ate_mean_mm", "ate_median_mm", "ate_std_mm", *_RPE_NAMES)


def climb_figures(estimate: Trajectory, reference: Trajectory) -> dict[str, float]:
    """Return ATE, RPE, TFR and counts of the estimate and its other submaps; errors are NaN where no submap counts.

    A submap takes the reference frames that no earlier one has, and counts with at least `LEAST_FRAMES` of them. Errors
    are means over the submaps, weighted by these frames. A frame whose pose is not finite is lost. Raises
    `AlignmentError` for a submap that stands still or on a line.
    """
    known = free = _with_pose(reference)
    errors: list[list[float]] = []
    matched: list[int] = []
    for submap in (estimate, *estimate.others):
        own = _with_pose(submap)
        rows, rows_free = associate(own, free)
        if len(rows) < LEAST_FRAMES:
            continue
        errors.append(_errors(own.T_world_camera[rows], free.T_world_camera[rows_free], free.indices[rows_free]))
        matched.append(len(rows))
        free = free.rows(np.setdiff1d(np.arange(len(free)), rows_free))
    means = np.average(errors, axis=0, weights=matched) if matched else np.full(len(_ERRORS), np.nan)
    return dict(zip(_ERRORS, means.tolist(), strict=True)) | {
        "tfr_percent": 100.0 * sum(matched) / max(len(known), 1),
        "submaps": float(len(matched)),
        "matched_poses": float(sum(matched)),
        "reference_poses": float(len(known)),
    }


def _with_pose(trajectory: Trajectory) -> Trajectory:
    return trajectory.rows(trajectory.tracked & np.isfinite(trajectory.T_world_camera).all(axis=(1, 2)))


@dataclass(frozen=True)
class ClimbScore:
    """The challenge's scores of a clip, or their means over clips; lower is better.

    ate : Score_ATE, mm, which ranks. rotation : Score_Rot, degrees, which ranks where ATE scores are within 5 %.
    """

    ate: float
    rotation: float


def climb_score(ate_mean_mm: float, rpe_40_deg: float, tfr_percent: float, duration_share: float) -> ClimbScore:
    """Return the scores of a clip: ATE, and rotational RPE over 40 frames, times W_rtf W_t.

    duration_share : processing time over the clip's duration, T x fps. W_rtf = 1 + 0.5 (1 - RTF), RTF the TFR as a
    fraction; W_t = 1 + 0.5 min(1, max(0, T fps - 1)). A failed clip enters with ATE 25 mm, 20 degrees, RTF 0 and W_t
    1.5. A rotation error that was not measured (NaN) counts 20 degrees: 0, the challenge's code, would win each tie. A
    share that is not known (NaN) counts W_t 1.5. Source: README.md, "Final score and ranking".
    """
    if is_failed(ate_mean_mm, tfr_percent):
        ate_mean_mm, rpe_40_deg, tfr_percent, duration_share = _FAILED_MM, _FAILED_DEG, 0.0, np.inf
    rpe_40_deg = rpe_40_deg if np.isfinite(rpe_40_deg) else _FAILED_DEG
    duration_share = np.inf if np.isnan(duration_share) else duration_share
    weights = 1 + _MOST_ADDED * np.array([1 - tfr_percent / 100, np.clip(duration_share - 1, 0, 1)])
    return ClimbScore(float(ate_mean_mm * weights.prod()), float(rpe_40_deg * weights.prod()))


def is_failed(ate_mean_mm: float, tfr_percent: float) -> bool:
    """Return whether a clip counts as failed: its TFR is 50 % or less, or its ATE is no number."""
    return not (tfr_percent > _LEAST_TFR_PERCENT and np.isfinite(ate_mean_mm))


def _errors(estimated: np.ndarray, reference: np.ndarray, frames: np.ndarray) -> list[float]:
    """Return the errors, named by `_ERRORS`, of poses (N, 4, 4) of `frames` (N,), ascending, after Sim(3)."""
    aligned, _ = align_trajectories(estimated, reference, "sim3")
    ate = ErrorSummary.of(translation_errors_mm(aligned, reference))
    errors = [ate.mean, ate.median, ate.std]
    for step in _RPE_FRAMES:
        _, first, second = np.intersect1d(frames, frames - step, return_indices=True)
        rpe_mm, rpe_rad = relative_errors(aligned, reference, np.stack([first, second], axis=1))
        errors += [ErrorSummary.of(rpe_mm).mean, float(np.degrees(ErrorSummary.of(rpe_rad).mean))]
    return errors
