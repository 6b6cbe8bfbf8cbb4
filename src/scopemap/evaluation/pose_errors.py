"""Absolute (APE) and relative (RPE) errors of matched poses, and their statistics.

All functions take camera-to-world poses (N, 4, 4) float64, mm, matched row by row. Definitions: evo's documentation and
Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, section IV.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.geometry.se3 import inverse, rotation_angle_rad

# A pair over a path length is kept if its path differs by at most this share (evo's `rel_delta_tol`).
_PATH_TOLERANCE = 0.1


@dataclass(frozen=True)
class ErrorSummary:
    """Statistics of non-negative errors, in their unit; NaN where there are none. Definitions as evo's.

    `std` divides by N; `final` is the last error; `below_mean_percent` is the share strictly below the mean; `sse` is
    the sum of squares.
    """

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
