"""Volume: a scene's shape as one smooth function on a grid.

The shape is the zero set of a uniform cubic B-spline (M. Unser, IEEE Signal Processing Magazine 16(6), 1999, eq. 9),
positive in the free space and negative in tissue. In a cell it stays within the range of the 4x4x4 coefficients around
it (convex hull), and its slope within that of their differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from scipy import ndimage

_MARGIN = 2


@njit(cache=True, nogil=True, inline="always")
def _weights(f: float) -> tuple[float, float, float, float]:
    g = 1.0 - f
    return (
        g * g * g / 6.0,
        (4.0 - 3.0 * f * f * (1.0 + g)) / 6.0,
        (4.0 - 3.0 * g * g * (1.0 + f)) / 6.0,
        f * f * f / 6.0,
    )


@njit(cache=True, nogil=True, inline="always")
def _slopes(f: float) -> tuple[float, float, float, float]:
    g = 1.0 - f
    return -0.5 * g * g, 1.5 * f * f - 2.0 * f, 0.5 + f - 1.5 * f * f, 0.5 * f * f


@njit(cache=True, nogil=True)
def spline(c: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return value and gradient (per voxel) at grid coordinates; the caller has checked `inside`."""
    i, j, k = int(x), int(y), int(z)
    wx, wy, wz = _weights(x - i), _weights(y - j), _weights(z - k)
    sx, sy, sz = _slopes(x - i), _slopes(y - j), _slopes(z - k)
    value = gx = gy = gz = 0.0
    for a in range(4):
        for b in range(4):
            ia, jb = i + a - 1, j + b - 1
            c0, c1, c2, c3 = c[ia, jb, k - 1], c[ia, jb, k], c[ia, jb, k + 1], c[ia, jb, k + 2]
            line = wz[0] * c0 + wz[1] * c1 + wz[2] * c2 + wz[3] * c3
            value += wx[a] * wy[b] * line
            gx += sx[a] * wy[b] * line
            gy += wx[a] * sy[b] * line
            gz += wx[a] * wy[b] * (sz[0] * c0 + sz[1] * c1 + sz[2] * c2 + sz[3] * c3)
    return value, gx, gy, gz


@njit(cache=True, nogil=True, inline="always")
def inside(c: np.ndarray, x: float, y: float, z: float) -> bool:
    """Tell whether the spline is defined at grid coordinates (a NaN is not inside)."""
    m, n, p = c.shape
    return _MARGIN <= x < m - _MARGIN - 1 and _MARGIN <= y < n - _MARGIN - 1 and _MARGIN <= z < p - _MARGIN - 1


@njit(cache=True, nogil=True)
def evaluate(c: np.ndarray, grid: np.ndarray, out: np.ndarray) -> None:
    """Write value and gradient at grid coordinates (N, 3) into out (N, 4); points outside are left as they are."""
    for n in range(grid.shape[0]):
        x, y, z = grid[n]
        if inside(c, x, y, z):
            out[n, 0], out[n, 1], out[n, 2], out[n, 3] = spline(c, x, y, z)


@dataclass(frozen=True)
class Volume:
    """Shape of the free space.

    Attributes
    ----------
    coefficients : (X, Y, Z) float32, mm: about the distance to the tissue where positive, below 0 in tissue.
    origin_mm : (3,) float64, world position of coefficient (0, 0, 0); the grid's axes are those of the world.
    voxel_mm : grid spacing.
    """

    coefficients: np.ndarray
    origin_mm: np.ndarray
    voxel_mm: float

    @cached_property
    def skip(self) -> np.ndarray:
        """(X, Y, Z) uint8: the surface is at least `skip - 1` voxels away from any point of the cell."""
        lowest = ndimage.minimum_filter(self.coefficients, size=4, origin=-1, mode="nearest")
        return np.minimum(ndimage.distance_transform_cdt(lowest > 0, "chessboard"), 255).astype(np.uint8)

    @cached_property
    def steepest(self) -> tuple[np.ndarray, float]:
        """(X, Y, Z) uint8, a bound of the slope within a voxel of each cell, and its unit, mm per voxel."""
        squared = np.zeros(self.coefficients.shape, np.float32)
        for axis in range(3):
            last = self.coefficients.take([-1], axis)
            slope = np.abs(np.diff(self.coefficients, axis=axis, append=last))
            squared += ndimage.maximum_filter(slope, size=6, origin=-1, mode="nearest") ** 2
        bound = np.sqrt(squared)
        unit = max(float(bound.max()), 1e-6) / 255 * (1 + 1e-6)
        return np.ceil(bound / unit).astype(np.uint8), unit

    def cells_of(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the cells, three index arrays (N,), of points (..., 3); NaN points are left out."""
        points = points_mm.reshape(-1, 3)
        i, j, k = ((points[np.isfinite(points[:, 0])] - self.origin_mm) / self.voxel_mm).astype(int).T
        return i, j, k

    def values_at(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the shape function (N,) in mm and its gradient (N, 3) at points (N, 3); NaN outside the grid."""
        grid = np.ascontiguousarray((points_mm - self.origin_mm) / self.voxel_mm, dtype=np.float64)
        out = np.full((len(grid), 4), np.nan)
        evaluate(self.coefficients, grid, out)
        return out[:, 0], out[:, 1:] / self.voxel_mm
