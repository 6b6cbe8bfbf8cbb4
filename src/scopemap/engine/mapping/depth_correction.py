"""Depth correction field: a smooth factor of a keyframe's depth over the image and over depth; how depths disagree.

Errors of predicted depth vary over the image: a bright organ is too near, a far wall too far. Triangulated points
measure them, but only at corners. A coarse grid interpolates between the points. Its axes are row, column and ln depth,
because errors change abruptly at depth edges: a bilateral grid (Chen, Paris and Durand, SIGGRAPH 2007) of corrections.

Whether an adjustment helps is judged by depth that it has not used, away from the corners: keyframes that see the same
surface must agree on it (`depth_disagreement`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from scipy import sparse

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.kernels import Float32_2d, Float32_3d, inner_kernel, kernel
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.mapping.bundle_problem import Points

ROWS = 6  # by hand, with the two below: patches of a network's error, not blurred edges (docs/method.md)
COLUMNS = 7  # by hand: of the image
LEVELS = 4  # by hand: of ln depth
_SHAPE = (ROWS, COLUMNS, LEVELS)
MAX_LOG_FACTOR = 0.7  # by hand
"""Bound of |ln factor|: larger errors of points are not errors of depth."""

# Standard deviation of the change between neighbouring nodes of rows, columns and levels, in units of the setting.
_STEP_SHARES = (1.0, 1.0, 2.0)  # by hand
# Standard deviation of the correction itself, in the same units; nodes without points stay near 0.
_SIZE_SHARE = 3.0  # by hand
# Errors of flow and poses are correlated between neighbouring points: no point is more certain than this.
_MIN_SIGMA = 0.03  # by hand
_CAUCHY = 2.0  # by hand: residuals of that many standard deviations get half the weight
_ITERATIONS = 3  # by hand: reweightings
_MIN_POINTS = 10  # by hand: of a keyframe; fewer fit no field
# The first and the last level are these percentiles of the points' ln depths.
_LEVEL_PERCENTILES = (1, 99)  # by hand
_GRID_PX = 8  # by hand: between the pixels whose depth is compared between keyframes
_F32 = np.float32


@dataclass(frozen=True)
class DepthCorrectionField:
    """ln of the factor of a keyframe's depth, trilinear between the nodes of a grid.

    values : (6, 7, 4) over rows, columns and ln depth; the first and last nodes are at the image's borders. nearest,
    farthest : ln mm of the first and the last level; the field is constant beyond them.
    """

    values: np.ndarray
    nearest: float
    farthest: float

    def log_factor(self, depth_mm: np.ndarray) -> np.ndarray:
        """Return ln of the factor (H, W) float32 for estimated depth (H, W) mm; NaN where that is unknown."""
        with np.errstate(divide="ignore", invalid="ignore"):
            log_depth = np.log(depth_mm, dtype=np.float32)
        return _interpolated(self.values.astype(np.float32), log_depth, self.nearest, self.farthest)

    def log_factor_before(self, corrected_mm: np.ndarray) -> np.ndarray:
        """Return ln of the factor (H, W) float32 that depth (H, W) mm was multiplied by: the inverse of `log_factor`.

        Where several depths were corrected to the same one, that of the nearest.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            log_depth = np.log(corrected_mm, dtype=np.float32)
        return _inverted(self.values.astype(np.float32), log_depth, self.nearest, self.farthest)


def fit_depth_correction(
    position: np.ndarray, log_depth: np.ndarray, error: np.ndarray, sigma: np.ndarray, step_sigma: float
) -> DepthCorrectionField:
    """Return the correction field that fits a keyframe's triangulated points.

    position : (n, 2), x and y over the image's width and height, 0..1. log_depth : (n,) ln mm as estimated. error :
    (n,) triangulated minus estimated ln depth. sigma : (n,) standard deviation of `error`; infinite: the point is not
    used. step_sigma : standard deviation of the change from node to node, above 0.

    Least squares with Cauchy's weights, because points on tissue that moved are outliers:

        sum of rho((f(p) - error_p) / s_p)  +  sum over neighbours ((f_a - f_b) / step)^2  +  sum of (f_a / size)^2

    With fewer than ten points the field is 0.
    """
    known = np.isfinite(sigma)
    if known.sum() < _MIN_POINTS:
        return DepthCorrectionField(np.zeros(_SHAPE), 0.0, 1.0)
    nearest, farthest = (float(end) for end in np.percentile(log_depth[known], _LEVEL_PERCENTILES))
    farthest = max(farthest, nearest + 1e-3)
    level = np.clip((log_depth[known] - nearest) / (farthest - nearest), 0, 1) * (LEVELS - 1)
    at = _interpolation(position[known], level)
    variance, target = sigma[known] ** 2 + _MIN_SIGMA**2, error[known]
    prior, weight = _prior(step_sigma), 1 / variance
    for _ in range(_ITERATIONS):
        normal = prior + (at.T @ at.multiply(weight[:, None])).toarray()
        values = np.linalg.solve(normal, at.T @ (weight * target))
        residual = at @ values - target
        weight = 1 / (variance + (residual / _CAUCHY) ** 2)
    return DepthCorrectionField(np.clip(values, -MAX_LOG_FACTOR, MAX_LOG_FACTOR).reshape(_SHAPE), nearest, farthest)


def fit_depth_corrections(
    camera: PinholeCamera, points: Points, count: int, error: np.ndarray, sigma: np.ndarray, step_sigma: float
) -> tuple[DepthCorrectionField, ...]:
    """Return the correction field of each of `count` keyframes, hosts of points with error, sigma (P,).

    step_sigma : as `fit_depth_correction` takes it; 0: there is no field, and () is returned.
    """
    if step_sigma == 0:
        return ()
    pixels = points.pixel * [1.0, camera.fy / camera.fx] + [camera.cx, camera.cy]
    position, fields = (pixels + 0.5) / [camera.width, camera.height], []
    for k in range(count):
        own = slice(*np.searchsorted(points.host, (k, k + 1)))
        fields.append(fit_depth_correction(position[own], points.log_depth[own], error[own], sigma[own], step_sigma))
    return tuple(fields)


def depth_grid(depth_mm: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return a keyframe's depth (H, W) mm at every eighth usable pixel, (h, w) float32; NaN elsewhere."""
    some = (slice(_GRID_PX // 2, None, _GRID_PX),) * 2
    return np.where(valid[some], depth_mm[some], np.nan).astype(np.float32)


def depth_disagreement(
    camera: PinholeCamera, T_world_camera: np.ndarray, grids: Sequence[np.ndarray], gaps: Collection[int]
) -> tuple[float, float]:
    """Return how much the depths of keyframes disagree: of all compared keyframes, and of the farthest compared.

    T_world_camera : (K, 4, 4). grids : K depths, mm, as `depth_grid` gives them. gaps : keyframes so many apart are
    compared. A disagreement is the median of |ln(depth / transformed depth of the other keyframe)| over their pixels;
    NaN where none sees what another sees. Neighbours share the depth of the frames between them: only far ones tell
    whether the scale drifts.
    """
    errors = [
        np.concatenate([depth_log_ratios(camera, T_world_camera, grids, k, k + step) for k, step in pairs])
        for gap in sorted(set(gaps))
        if (pairs := [(k, s) for s in (gap, -gap) for k in range(len(grids)) if 0 <= k + s < len(grids)])
    ]
    compared = [np.abs(error) for error in errors if error.size]
    if not compared:
        return float("nan"), float("nan")
    return float(np.median(np.concatenate(compared))), float(np.median(compared[-1]))


def depth_log_ratios(
    camera: PinholeCamera, T_world_camera: np.ndarray, grids: Sequence[np.ndarray], one: int, other: int
) -> np.ndarray:
    """Return ln of a keyframe's depth over that of another one's points there, (n,), where both are known."""
    rows, columns = np.nonzero(grids[one] > 0)
    if not len(rows):
        return np.zeros(0)
    rays = camera.unproject(_GRID_PX * np.column_stack([columns, rows]) + _GRID_PX // 2)
    points = transform(inverse(T_world_camera[other]) @ T_world_camera[one], grids[one][rows, columns, None] * rays)
    # Beyond the border, behind the camera and beside unknown depth there is nothing to compare with.
    x, y = (np.full(grids[one].shape, -_GRID_PX, np.float32) for _ in range(2))
    x[rows, columns], y[rows, columns] = (camera.project(points).T - _GRID_PX // 2) / _GRID_PX
    there_mm = cv2.remap(grids[other], x, y, cv2.INTER_LINEAR, borderValue=float("nan"))[rows, columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = np.log(there_mm / points[:, 2])
    known: np.ndarray = ratios[np.isfinite(ratios)]
    return known


@inner_kernel
def _first_columns(width: int) -> np.ndarray:
    """Return the first column of the image that lies beyond each node of columns but the last; then the width."""
    first = np.full(COLUMNS, width)
    for col in range(width - 1, -1, -1):
        first[min(int((_F32(col) + _F32(0.5)) * _F32((COLUMNS - 1) / width)), COLUMNS - 2)] = col
    for node in range(COLUMNS - 2, -1, -1):
        first[node] = min(first[node], first[node + 1])
    return first


@inner_kernel
def _along_row(values: np.ndarray, row: int, height: int, line: np.ndarray) -> None:
    """Put the values (6, 7, 4) of a field along an image's row into `line` (7, 4)."""
    y = (row + 0.5) / height * (ROWS - 1)
    above = min(int(y), ROWS - 2)
    for k in range(COLUMNS):
        for level in range(LEVELS):
            low, high = values[above, k, level], values[above + 1, k, level]
            line[k, level] = low + _F32(y - above) * (high - low)


@kernel
def _inverted(values: Float32_3d, log_depth: Float32_2d, nearest: float, farthest: float) -> np.ndarray:
    """Return a field's values (6, 7, 4) at what the ln depth (H, W) was before their addition, (H, W) float32."""
    height, width = log_depth.shape
    found, line = np.empty((height, width), np.float32), np.empty((COLUMNS, LEVELS), np.float32)
    step, columns = float(_F32((farthest - nearest) / (LEVELS - 1))), _first_columns(width)
    for row in range(height):
        _along_row(values, row, height, line)
        for left in range(COLUMNS - 1):
            # Between two nodes and without branches, so that it is compiled to vector instructions.
            for col in range(columns[left], columns[left + 1]):
                s = (_F32(col) + _F32(0.5)) * _F32((COLUMNS - 1) / width) - _F32(left)
                place = log_depth[row, col] - _F32(nearest)
                far = line[left, LEVELS - 1] + s * (line[left + 1, LEVELS - 1] - line[left, LEVELS - 1])
                value = float(far)
                # Piecewise linear: the first piece that ends beyond the depth holds it.
                for level in range(LEVELS - 2, -1, -1):
                    near = line[left, level] + s * (line[left + 1, level] - line[left, level])
                    begin, end = step * level + near, step * (level + 1) + far
                    value = near + (place - begin) / (end - begin) * (far - near) if place <= end else value
                    far = near
                value = value if place > far else float(far)
                found[row, col] = value if place == place else np.nan
    return found


@kernel
def _interpolated(values: Float32_3d, log_depth: Float32_2d, nearest: float, farthest: float) -> np.ndarray:
    """Return a field's values (6, 7, 4) at each pixel's ln depth (H, W), (H, W) float32; NaN where that is NaN."""
    height, width = log_depth.shape
    found, line = np.empty((height, width), np.float32), np.empty((COLUMNS, LEVELS), np.float32)
    first, per_level, columns = _F32(nearest), _F32((LEVELS - 1) / (farthest - nearest)), _first_columns(width)
    per_column, last = _F32((COLUMNS - 1) / width), _F32(LEVELS - 1)
    for row in range(height):
        _along_row(values, row, height, line)
        for left in range(COLUMNS - 1):
            # Between two nodes, in single precision and without branches: compiled to vector instructions.
            for col in range(columns[left], columns[left + 1]):
                s, z = (_F32(col) + _F32(0.5)) * per_column - _F32(left), (log_depth[row, col] - first) * per_level
                z = z if z > _F32(0) else _F32(0)  # unknown depth, too
                z = z if z < last else last
                near, value = line[left, 0] + s * (line[left + 1, 0] - line[left, 0]), _F32(0)
                for below in range(LEVELS - 1):
                    low, high = line[left, below + 1], line[left + 1, below + 1]
                    far = low + s * (high - low)
                    value = near + (z - _F32(below)) * (far - near) if z >= _F32(below) else value
                    near = far
                found[row, col] = value if log_depth[row, col] == log_depth[row, col] else _F32(np.nan)
    return found


def _interpolation(position: np.ndarray, level: np.ndarray) -> sparse.csr_matrix:
    """Matrix (n, nodes) of trilinear interpolation at points."""
    x, y = np.clip(position, 0, 1).T
    coordinates = (y * (ROWS - 1), x * (COLUMNS - 1), level)
    below = [np.minimum(c.astype(int), nodes - 2) for c, nodes in zip(coordinates, _SHAPE, strict=True)]
    share = [c - b for c, b in zip(coordinates, below, strict=True)]
    corners = list(np.ndindex(2, 2, 2))
    nodes = [np.ravel_multi_index([b + c for b, c in zip(below, corner, strict=True)], _SHAPE) for corner in corners]
    weights = [np.prod([s if c else 1 - s for s, c in zip(share, corner, strict=True)], axis=0) for corner in corners]
    starts = np.arange(0, len(corners) * len(level) + 1, len(corners))
    entries = np.column_stack(weights).ravel(), np.column_stack(nodes).ravel(), starts
    return sparse.csr_matrix(entries, shape=(len(level), math.prod(_SHAPE)))


@cache
def _prior(step_sigma: float) -> np.ndarray:
    """Normal matrix (nodes, nodes) of the prior: neighbouring nodes are similar, all are near 0."""
    number = np.arange(ROWS * COLUMNS * LEVELS).reshape(_SHAPE)
    prior = sparse.identity(number.size, format="csr") / (_SIZE_SHARE * step_sigma) ** 2
    for axis, share in enumerate(_STEP_SHARES):
        before, after = (np.take(number, n, axis).ravel() for n in (range(_SHAPE[axis] - 1), range(1, _SHAPE[axis])))
        rows, ones = np.arange(len(before)), np.ones(len(before))
        step = sparse.csr_matrix(
            (np.append(ones, -ones), (np.append(rows, rows), np.append(after, before))), shape=(len(rows), number.size)
        )
        prior += step.T @ step / (share * step_sigma) ** 2
    found: np.ndarray = prior.toarray()
    return found
