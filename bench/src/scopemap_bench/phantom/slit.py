"""A slit that is cut into tissue and gapes: points beside it move apart, and what is between them is free space.

With x across the slit, y along it and z into the tissue, from a point of its surface, it gapes to the half-width

    g = gape (1 - y^2 / length^2) s exp(-z^2 / 2 reach^2)

where s goes smoothly from 0 to 1 behind the blade. A point at x is that of the rest point x - v, with v = x within the
slit and sign(x) g exp(-(|x| - g) / fade) beside it. No point of one side comes from the other.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from scopemap.engine.geometry.kernels import IS_CACHED

_GAPE_MM = 2.2
_FADE_MM = 8.0
_REACH_MM = 5.0
_DEEP_MM = 3.5
_LENGTH_MM = 14.0
_RAMP_MM = 10.0
_COLUMNS = 20
_BLADE = 18
_UNIT = 19
_INVERSE_STEPS = 30
_WOUND_MM = 0.02
UNCUT = np.zeros((0, _COLUMNS))
"""No slit. Rows: a point, axes x, y and z (3 each), gape, fade, reach, depth (mm), length, ramp, blade, mm per unit."""


def slit(point_mm: np.ndarray, across: np.ndarray, normal: np.ndarray, size: float) -> np.ndarray:
    """Return a slit (1, 20), mm, at a point (3,) of a surface, `size` times the usual, before the blade has come."""
    axes = [across, np.cross(normal, across), normal]
    sizes = size * np.array([_GAPE_MM, _FADE_MM, _REACH_MM, _DEEP_MM, _LENGTH_MM, _RAMP_MM, -_LENGTH_MM])
    return np.concatenate([point_mm, *axes, sizes, [1.0]])[None]


def cut_until(slits: np.ndarray, share: float) -> np.ndarray:
    """Return slits (S, 20) with the blade at a share of its way, from one end to beyond the other."""
    moved = slits.copy()
    length, ramp = moved[:, 16], moved[:, 17]
    moved[:, _BLADE] = -length + share * (2 * length + ramp)
    return moved


def in_grid(slits: np.ndarray, origin_mm: np.ndarray, voxel_mm: float) -> np.ndarray:
    """Return slits (S, 20) for coordinates in voxels from `origin_mm`; their depth stays in mm."""
    moved = slits.copy()
    moved[:, :3] -= origin_mm
    moved[:, [0, 1, 2, 12, 13, 14, 16, 17, _BLADE]] /= voxel_mm
    moved[:, _UNIT] = voxel_mm
    return moved


def stretch(slits: np.ndarray) -> float:
    """Return an upper bound of the slope from points to rest points."""
    steep = 1.0
    for gape, fade, reach, _, length, ramp in slits[:, 12:_BLADE]:
        slope = gape * (2 / length + 1.5 / ramp + np.exp(-0.5) / reach)
        steep *= 1 + gape / fade + (1 + gape / fade) * slope
    return float(steep)


@njit(cache=IS_CACHED, nogil=True)
def gap_at(s: np.ndarray, px: float, py: float, pz: float) -> tuple[float, float, float, float, float, float]:
    """Return x, g and the depth of the cut at a point, and their slopes: g along y and z, the depth along y."""
    dx, dy, dz = px - s[0], py - s[1], pz - s[2]
    x, y, z = dx * s[3] + dy * s[4] + dz * s[5], dx * s[6] + dy * s[7] + dz * s[8], dx * s[9] + dy * s[10] + dz * s[11]
    behind = min(max((s[18] - y) / s[17], 0.0), 1.0)
    window = 1.0 - (y / s[16]) ** 2
    if window <= 0.0 or behind <= 0.0:
        return x, 0.0, 0.0, 0.0, 0.0, 0.0
    smooth = behind * behind * (3.0 - 2.0 * behind)
    open_, slope = window * smooth, -2.0 * y / s[16] ** 2 * smooth - window * 6.0 * behind * (1.0 - behind) / s[17]
    near = np.exp(-0.5 * (z / s[14]) ** 2)
    return (
        x,
        s[12] * open_ * near,
        s[15] * open_,
        s[12] * slope * near,
        -z / s[14] ** 2 * s[12] * open_ * near,
        s[15] * slope,
    )


@njit(cache=IS_CACHED, nogil=True)
def shift_at(s: np.ndarray, x: float, g: float) -> float:
    """Return v at x where the slit gapes by g."""
    return x if abs(x) <= g else np.sign(x) * g * np.exp((g - abs(x)) / s[13])


@njit(cache=IS_CACHED, nogil=True)
def opened(s: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return where rest points (N, 3) are after the cut."""
    moved = rest.copy()
    for n in range(len(rest)):
        x, g, _, _, _, _ = gap_at(s, rest[n, 0], rest[n, 1], rest[n, 2])
        if g > 0.0:
            far = abs(x) + g
            for _ in range(_INVERSE_STEPS):
                far = abs(x) + g * np.exp((g - far) / s[13])
            side = -1.0 if x < 0.0 else 1.0
            moved[n] += (side * far - x) * s[3:6]
    return moved


def crossed(slits: np.ndarray, rest_mm: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return which faces (F, 3) of rest points (N, 3) a slit parts, (F,) bool."""
    parted = np.zeros(len(faces), bool)
    for s in slits:
        gaps = np.array([gap_at(s, *point)[:2] for point in rest_mm])[faces]
        parted |= (gaps[..., 0].min(1) < 0) & (gaps[..., 0].max(1) >= 0) & (gaps[..., 1].max(1) > 0)
    return parted


def in_wound(slits: np.ndarray, rest_mm: np.ndarray) -> np.ndarray:
    """Return which visible rest points (..., 3) belong to a slit's walls or its floor, (...) bool."""
    wound = np.zeros(rest_mm.shape[:-1], bool)
    for s in slits:
        x, y = ((rest_mm - s[:3]) @ s[axis : axis + 3] for axis in (3, 6))
        wound |= (np.abs(x) < _WOUND_MM) & (np.abs(y) < s[16]) & (y < s[_BLADE])
    return wound
