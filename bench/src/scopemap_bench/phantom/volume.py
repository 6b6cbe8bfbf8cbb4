"""Smooth functions of space: a scene's shape on a grid, and noise, the source of all irregular shape and texture.

The shape is the zero set of a uniform cubic B-spline (M. Unser, IEEE Signal Processing Magazine 16(6), 1999, eq. 9),
positive in the free space and negative in tissue. In a cell it stays within the range of the 4x4x4 coefficients around
it (convex hull), and its slope within that of their differences. Noise is gradient noise after K. Perlin, "Improving
noise", SIGGRAPH 2002; the lattice is hashed, so it never repeats.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit, prange
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


@njit(cache=True, nogil=True, inline="always")
def _corner(ix: int, iy: int, iz: int, seed: int, x: float, y: float, z: float) -> float:
    key = (ix * 73856093) ^ (iy * 19349663) ^ (iz * 83492791) ^ (seed * 2654435761)
    key = ((key ^ (key >> 13)) * 1274126177) & 0xFFFFFFFF
    key = ((key ^ (key >> 16)) * 2246822519) & 0xFFFFFFFF
    h = (key >> 15) & 15
    u = x if h < 8 else y
    v = y if h < 4 else (x if h == 12 or h == 14 else z)
    return (u if h & 1 == 0 else -u) + (v if h & 2 == 0 else -v)


@njit(cache=True, nogil=True, inline="always")
def _fade(a: float) -> float:
    return a * a * a * (a * (6.0 * a - 15.0) + 10.0)


@njit(cache=True, nogil=True)
def _noise(x: float, y: float, z: float, seed: int) -> float:
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    x, y, z = x - fx, y - fy, z - fz
    sx, sy, sz = _fade(x), _fade(y), _fade(z)
    total = 0.0
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, (corner >> 2) & 1
        weight = (sx if a else 1.0 - sx) * (sy if b else 1.0 - sy) * (sz if c else 1.0 - sz)
        total += weight * _corner(ix + a, iy + b, iz + c, seed, x - a, y - b, z - c)
    return total


@njit(cache=True, nogil=True, parallel=True)
def _fill(points: np.ndarray, period: float, seed: int, out: np.ndarray) -> None:
    for i in prange(points.shape[0]):
        x, y, z = points[i, 0] / period, points[i, 1] / period, points[i, 2] / period
        out[i] = _noise(x, y, z, seed) if np.isfinite(x + y + z) else 0.0


def noise_at(points_mm: np.ndarray, period_mm: float, seed: int) -> np.ndarray:
    """Return smooth noise (...) float32, within -1..1, at points (..., 3); NaN points give 0.

    `period_mm` is the lattice spacing. The standard deviation is about 0.3; equal on every machine.
    """
    points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 3)
    out = np.empty(len(points), np.float32)
    _fill(points, float(period_mm), int(seed), out)
    return out.reshape(points_mm.shape[:-1])
