"""Where a keyframe's depth is wrong, and by how much: one smooth factor over the image and over depth.

Predicted depth is wrong by patches: a bright organ comes out too near, a far wall too far. Points that keyframes see
from several places know better, but only where there are corners. Between them a coarse grid is fitted, over place in
the image and, since errors stop at the edges of organs and folds where depth jumps, over ln depth as well: a bilateral
grid (Chen, Paris and Durand, SIGGRAPH 2007) that holds a correction instead of a picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import sparse

ROWS, COLUMNS, LEVELS = _SHAPE = 6, 7, 4
# ln of the largest factor either way: what points ask for beyond that is no error of depth.
LARGEST_LOG_FACTOR = 0.7
# From one node to the next, over the rows and columns and over the levels, in units of the setting.
_STEP_SHARES = (1.0, 1.0, 2.0)
# How far a correction is expected to go at all, in the same units; what no point tells of stays near 0.
_SIZE_SHARE = 3.0
# Flow errs alike on neighbouring points, and poses err too: no point is more certain than this.
_LEAST_SIGMA = 0.03
_CAUCHY = 2.0
_ROUNDS = 3
_LEAST_POINTS = 10
# Levels lie between these percentiles of the points' depths.
_ENDS = (1, 99)


@dataclass(frozen=True)
class DepthGrid:
    """ln of the factor that a keyframe's depth is to be multiplied by, trilinear between nodes.

    Attributes
    ----------
    values : (6, 7, 4) over rows, columns and ln depth, the first and last nodes at the image's borders.
    nearest, farthest : ln mm of the first and the last level; what lies beyond is corrected as there.
    """

    values: np.ndarray
    nearest: float
    farthest: float

    def log_factor(self, depth_mm: np.ndarray) -> np.ndarray:
        """Return ln of the factor (H, W) float32 for depth (H, W) mm as it was estimated; NaN where that is unknown."""
        height, width = depth_mm.shape
        x, y = np.meshgrid(_places(width, COLUMNS), _places(height, ROWS))
        flat = cv2.remap(self.values.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        with np.errstate(divide="ignore", invalid="ignore"):
            level = _level(np.log(depth_mm), self.nearest, self.farthest).astype(np.float32)
        below = np.minimum(np.nan_to_num(level), LEVELS - 2).astype(int)
        low, high = (np.take_along_axis(flat, n[..., None], -1)[..., 0] for n in (below, below + 1))
        return low + (level - below.astype(np.float32)) * (high - low)


def fit_grid(
    places: np.ndarray, log_depth: np.ndarray, error: np.ndarray, sigma: np.ndarray, step_sigma: float
) -> DepthGrid:
    """Return the grid that corrects a keyframe's depth by what its points tell.

    places : (n, 2), x and y over the image's width and height, 0..1. log_depth : (n,) ln mm as estimated. error : (n,)
    what is to be added to it. sigma : (n,) standard deviation of `error`; infinite: it says nothing. step_sigma : how
    far the correction may change from node to node, standard deviation.

    Least squares with Cauchy's weights, as tissue that moved has points that lie:

        sum of rho((f(p) - error_p) / s_p)  +  sum over neighbours ((f_a - f_b) / step)^2  +  sum of (f_a / size)^2

    Nothing is corrected with fewer than ten points.
    """
    known = np.isfinite(sigma)
    if known.sum() < _LEAST_POINTS:
        return DepthGrid(np.zeros(_SHAPE), 0.0, 1.0)
    nearest, farthest = (float(end) for end in np.percentile(log_depth[known], _ENDS))
    farthest = max(farthest, nearest + 1e-3)
    at = _mixing(places[known], _level(log_depth[known], nearest, farthest))
    variance, wanted = sigma[known] ** 2 + _LEAST_SIGMA**2, error[known]
    held, weight = _held(step_sigma), 1 / variance
    for _ in range(_ROUNDS):
        values = np.linalg.solve((held + at.T @ sparse.diags(weight) @ at).toarray(), at.T @ (weight * wanted))
        off = at @ values - wanted
        weight = 1 / (variance + (off / _CAUCHY) ** 2)
    return DepthGrid(np.clip(values, -LARGEST_LOG_FACTOR, LARGEST_LOG_FACTOR).reshape(_SHAPE), nearest, farthest)


def _places(size: int, nodes: int) -> np.ndarray:
    """Position of each pixel of a line among the nodes, 0..nodes - 1, float32."""
    return ((np.arange(size) + 0.5) / size * (nodes - 1)).astype(np.float32)


def _level(log_depth: np.ndarray, nearest: float, farthest: float) -> np.ndarray:
    return np.clip((log_depth - nearest) / (farthest - nearest), 0, 1) * (LEVELS - 1)


def _mixing(places: np.ndarray, level: np.ndarray) -> sparse.csr_matrix:
    """Matrix (n, nodes) that interpolates the grid at points."""
    x, y = np.clip(places, 0, 1).T
    coordinates = (y * (ROWS - 1), x * (COLUMNS - 1), level)
    below = [np.minimum(c.astype(int), nodes - 2) for c, nodes in zip(coordinates, _SHAPE, strict=True)]
    share = [c - b for c, b in zip(coordinates, below, strict=True)]
    matrix = sparse.csr_matrix((len(level), ROWS * COLUMNS * LEVELS))
    for corner in np.ndindex(2, 2, 2):
        node = np.ravel_multi_index([b + c for b, c in zip(below, corner, strict=True)], _SHAPE)
        weight = np.prod([s if c else 1 - s for s, c in zip(share, corner, strict=True)], axis=0)
        matrix += sparse.csr_matrix((weight, (np.arange(len(level)), node)), shape=matrix.shape)
    return matrix


def _held(step_sigma: float) -> sparse.csr_matrix:
    """Normal matrix (nodes, nodes) of what is believed beforehand: neighbours alike, everything near 0."""
    number = np.arange(ROWS * COLUMNS * LEVELS).reshape(_SHAPE)
    held = sparse.identity(number.size, format="csr") / (_SIZE_SHARE * step_sigma) ** 2
    for axis, share in enumerate(_STEP_SHARES):
        before, after = (np.take(number, n, axis).ravel() for n in (range(_SHAPE[axis] - 1), range(1, _SHAPE[axis])))
        rows, ones = np.arange(len(before)), np.ones(len(before))
        step = sparse.csr_matrix(
            (np.append(ones, -ones), (np.append(rows, rows), np.append(after, before))), shape=(len(rows), number.size)
        )
        held += step.T @ step / (share * step_sigma) ** 2
    return held
