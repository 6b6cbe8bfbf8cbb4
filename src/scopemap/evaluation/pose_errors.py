"""Errors between matched poses: absolute (APE), relative (RPE), and their statistics.

All functions take camera-to-world poses of shape (N, 4, 4) float64, mm, matched row by row. Definitions as evo's
documentation and Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, section IV.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scopemap.errors import check_shape
from scopemap.geometry.se3 import inverse, rotation_angle_rad

# Share by which a pair's path may differ from the wanted length.
_PATH_TOLERANCE = 0.1


@dataclass(frozen=True)
class ErrorSummary:
    """Statistics of a row of non-negative errors, in their unit; NaN where there are none.

    `std` divides by N; `final` is the last error; `below_mean_percent` is the share strictly below the mean; `sse` is
    the sum of squares. The others as their names say, all as evo has them.
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
        mean = float(np.mean(errors))
        return cls(
            mean=mean,
            std=float(np.std(errors)),
            rmse=float(np.sqrt(np.mean(np.square(errors)))),
            final=float(errors[-1]),
            max=float(np.max(errors)),
            below_mean_percent=float(100 * np.mean(errors < mean)),
            median=float(np.median(errors)),
            min=float(np.min(errors)),
            sse=float(np.sum(np.square(errors))),
        )


@dataclass(frozen=True)
class AxisSummaries:
    """Statistics of the absolute error along, or about, each axis."""

    x: ErrorSummary
    y: ErrorSummary
    z: ErrorSummary

    @classmethod
    def of(cls, errors: np.ndarray) -> AxisSummaries:
        """Summarise the absolute values of errors of shape (N, 3)."""
        check_shape("errors", errors, (None, 3))
        return cls(*(ErrorSummary.of(column) for column in np.abs(errors).T))


def below_percent(errors: np.ndarray, limit: float) -> float:
    """Return the share of errors (N,) strictly below `limit`, in percent; NaN where there are none.

    Unlike the share below a method's own mean it can rank methods.
    """
    return float(100 * np.mean(errors < limit)) if len(errors) else float("nan")


def translation_errors_mm(estimated: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return `p_i - q_i`, (N, 3) mm in world axes; its norms are the absolute pose error (APE) in translation."""
    return estimated[:, :3, 3] - reference[:, :3, 3]


def along_first_camera_mm(errors_mm: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return errors (N, 3) mm in world axes, turned into the axes of the first reference camera: `R(Q_0)^T d`.

    World axes differ from data set to data set; x right, y down, z forward of the first view do not.
    """
    return errors_mm @ reference[0, :3, :3]


def euler_xyz_rad(R: np.ndarray) -> np.ndarray:
    """Return the angles about x, y, z, (N, 3) rad in -pi..pi, of rotations (N, 3, 3) `R = R_z R_y R_x`."""
    about_x = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    about_y = np.arctan2(-R[:, 2, 0], np.hypot(R[:, 2, 1], R[:, 2, 2]))
    about_z = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return np.stack([about_x, about_y, about_z], axis=1)


def rotation_errors_per_axis_rad(estimated: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return `|euler_xyz(R(Q_i)^T R(P_i))|`, (N, 3) rad in 0..pi: the turn about each axis of the reference camera."""
    return np.abs(euler_xyz_rad(np.swapaxes(reference[:, :3, :3], 1, 2) @ estimated[:, :3, :3]))


def rotation_errors_rad(estimated: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the angle of `R(Q_i)^T R(P_i)`, (N,) rad in 0..pi: the absolute pose error (APE) in rotation."""
    return rotation_angle_rad(np.swapaxes(reference[:, :3, :3], 1, 2) @ estimated[:, :3, :3])


def relative_errors(estimated: np.ndarray, reference: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return translation (M,) mm and rotation (M,) rad of `(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)` for pairs (M, 2) of rows.

    A rigid alignment changes neither; its scale changes the translation.
    """
    first, second = pairs[:, 0], pairs[:, 1]
    motion_estimated = inverse(estimated[first]) @ estimated[second]
    motion_reference = inverse(reference[first]) @ reference[second]
    error = inverse(motion_reference) @ motion_estimated
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angle_rad(error[:, :3, :3])


def frame_pairs(count: int, step: int, *, consecutive: bool = False) -> np.ndarray:
    """Return row pairs (M, 2) that lie `step` rows apart: all of them, or only those that follow one another."""
    first = np.arange(0, count - step, step if consecutive else 1)
    return np.stack([first, first + step], axis=1)


def path_pairs(positions_mm: np.ndarray, length_mm: float, *, consecutive: bool = False) -> np.ndarray:
    """Return row pairs (M, 2) with `length_mm` of path between them, measured along `positions_mm` (N, 3).

    All: for each row the later one that comes closest, kept within 10 %. Consecutive: a mark wherever the path since
    the last mark reaches the length, beginning at the first row, and the pairs of successive marks.
    """
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions_mm, axis=0), axis=1))])
    if consecutive:
        return _successive_marks(travelled, length_mm)
    pairs = []
    for i in range(len(travelled) - 1):
        miss = np.abs(travelled[i + 1 :] - travelled[i] - length_mm)
        nearest = int(np.argmin(miss))
        if miss[nearest] <= _PATH_TOLERANCE * length_mm:
            pairs.append((i, i + 1 + nearest))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _successive_marks(travelled: np.ndarray, length_mm: float) -> np.ndarray:
    marks = [0]
    for i, distance in enumerate(travelled):
        if distance - travelled[marks[-1]] >= length_mm:
            marks.append(i)
    return np.array(list(pairwise(marks)), dtype=np.int64).reshape(-1, 2)
