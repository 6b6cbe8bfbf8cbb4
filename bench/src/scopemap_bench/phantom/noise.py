"""Smooth 3-D noise: the one source of irregular shape and texture in a phantom.

Gradient noise after K. Perlin, "Improving noise", SIGGRAPH 2002; the lattice is hashed, so it never repeats.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange


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
