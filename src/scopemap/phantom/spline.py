"""Uniform cubic B-spline over a 3-D grid: value and gradient at a point, in numba.

Coordinates are in voxels: coefficient (i, j, k) is at (i, j, k). M. Unser, "Splines: a perfect fit for signal and
image processing", IEEE Signal Processing Magazine 16(6), 1999, eq. 9.
"""

from __future__ import annotations

import numpy as np
from numba import njit

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
