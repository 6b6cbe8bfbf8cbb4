"""Solid shapes of tissue and space as implicit functions, evaluated directly at a point (no voxel grid).

Every function returns (nearly) a distance, so that rays can be traced by it: exact primitives and the smooth minimum
after I. Quilez ("distance functions", "smooth minimum", public articles); tube coordinates of our own: the centre line
is straight pieces and circular arcs, so that along-tube and across-tube lengths stay true on the centre line.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

ELLIPSOID, CONE, BOX, TORUS, SHEET = 0, 1, 2, 3, 4
CARVE, SOLID = 0, 1
# Columns of a row of shapes.
TYPE, OP, JOINS, BLEND, PART, RELIEF = 0, 1, 2, 3, 4, 5
CENTRE, ROTATION, SIZE, RING, REACH = 6, 9, 18, 22, 24
COLUMNS = 25
# Without nnan and ninf: a NaN stays one.
_FAST: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz", "reassoc"},
}


@njit(**_FAST)
def sine(x):
    """Return sin(x) to 4e-6 with its slope to 1e-5, at a third of the cost: Taylor's series to the ninth power."""
    turns = np.floor(x * 0.15915494309189535 + 0.25)
    x -= 6.283185307179586 * turns
    if x > 1.5707963267948966:
        x = 3.141592653589793 - x
    q = x * x
    return x * (1.0 - q * (0.16666666 - q * (0.008333333 - q * (0.00019841 - q * 2.7526e-6))))


@njit(**_FAST)
def _slope(key, x, y, z):
    """Gradient of a lattice point with that hash, times the offset (x, y, z) from it; about +-1024 per component."""
    key = np.uint32((key ^ (key >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    key = np.uint32((key ^ (key >> np.uint32(12))) * np.uint32(0x297A2D39))
    bits = np.int64(key ^ (key >> np.uint32(15)))
    a, b = np.float64((bits >> 21) & 2047) - 1023.5, np.float64((bits >> 10) & 2047) - 1023.5
    return a * x + b * y + (2.0 * np.float64(bits & 1023) - 1023.0) * z


@njit(**_FAST)
def _ease(a):
    return a * a * a * (a * (6.0 * a - 15.0) + 10.0)


@njit(**_FAST)
def bump(x, y, z, seed):
    """Return smooth noise of period 1: standard deviation 0.27, hardly ever beyond -1..1.

    As `scopemap_bench.phantom.march` (Perlin 2002), with gradients straight from the bits of the hash: a quarter of
    the time.
    """
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    x, y, z = x - fx, y - fy, z - fz
    ax = np.uint32(np.uint32(np.int32(fx)) * np.uint32(73856093))
    ay = np.uint32(np.uint32(np.int32(fy)) * np.uint32(19349663))
    az = np.uint32((np.uint32(np.int32(fz)) + np.uint32(seed)) * np.uint32(83492791))
    bx, by, bz = np.uint32(ax + 73856093), np.uint32(ay + 19349663), np.uint32(az + 83492791)
    sx, sy, sz = _ease(x), _ease(y), _ease(z)
    n00 = _slope(ax ^ ay ^ az, x, y, z)
    n00 += sx * (_slope(bx ^ ay ^ az, x - 1.0, y, z) - n00)
    n10 = _slope(ax ^ by ^ az, x, y - 1.0, z)
    n10 += sx * (_slope(bx ^ by ^ az, x - 1.0, y - 1.0, z) - n10)
    n01 = _slope(ax ^ ay ^ bz, x, y, z - 1.0)
    n01 += sx * (_slope(bx ^ ay ^ bz, x - 1.0, y, z - 1.0) - n01)
    n11 = _slope(ax ^ by ^ bz, x, y - 1.0, z - 1.0)
    n11 += sx * (_slope(bx ^ by ^ bz, x - 1.0, y - 1.0, z - 1.0) - n11)
    n00 += sy * (n10 - n00)
    n01 += sy * (n11 - n01)
    return (n00 + sz * (n01 - n00)) * 1.4e-3


@njit(cache=True, nogil=True)
def noise_channels(eye, rays, distances, seed, periods, pixel_rad, out):
    """Write smooth noise (H, W, C) at the hits: eye (3,), rays (H, W, 3), scene axes; distances (H, W), NaN: none.

    periods (C, 2): in scene units, and 1 where the noise fades as pixels get too coarse to show it.
    """
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            t = distances[row, column]
            if not np.isfinite(t):
                continue
            x = eye[0] + t * rays[row, column, 0]
            y = eye[1] + t * rays[row, column, 1]
            z = eye[2] + t * rays[row, column, 2]
            for n in range(len(periods)):
                p = periods[n, 0]
                share = min(max(p / (2.0 * pixel_rad * t) - 0.5, 0.0), 1.0) if periods[n, 1] > 0.0 else 1.0
                if share > 0.0:
                    out[row, column, n] = share * bump(x / p, y / p, z / p, seed + 17 * n)


@njit(**_FAST)
def smooth_min(a, b, k):
    """Minimum of a and b (floats, mm) whose edge is rounded over the length k > 0."""
    h = max(k - abs(a - b), 0.0)
    return min(a, b) - 0.25 * h * h / k


@njit(**_FAST)
def _ellipsoid(x, y, z, a, b, c, inside_only):
    k0 = np.sqrt((x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2)
    k1 = np.sqrt((x / (a * a)) ** 2 + (y / (b * b)) ** 2 + (z / (c * c)) ** 2)
    if k0 < 1.0 or inside_only:
        # Near the centre k0 / k1 may be the longest half axis: far more than the distance to the wall.
        least = min(a, min(b, c))
        return (k0 - 1.0) * min((k0 + 1e-9) / (k1 + 1e-12), 1.6 * least)
    return k0 * (k0 - 1.0) / k1


@njit(**_FAST)
def _cone(x, y, z, length, r0, r1):
    """Ball of radius r0 at the origin swept along x to radius r1 at `length`."""
    s = min(max(x / length, 0.0), 1.0)
    return np.sqrt((x - s * length) ** 2 + y * y + z * z) - (r0 + (r1 - r0) * s * s * (3.0 - 2.0 * s))


@njit(**_FAST)
def _box(x, y, z, a, b, c, r):
    qx, qy, qz = abs(x) - a + r, abs(y) - b + r, abs(z) - c + r
    outside = np.sqrt(max(qx, 0.0) ** 2 + max(qy, 0.0) ** 2 + max(qz, 0.0) ** 2)
    return outside + min(max(qx, max(qy, qz)), 0.0) - r


@njit(**_FAST)
def shape_distance(rows, n, x, y, z):
    """Distance (mm) of a point to the surface of shape n, negative inside; rows as the columns above say."""
    px, py, pz = x - rows[n, CENTRE], y - rows[n, CENTRE + 1], z - rows[n, CENTRE + 2]
    lx = rows[n, ROTATION] * px + rows[n, ROTATION + 1] * py + rows[n, ROTATION + 2] * pz
    ly = rows[n, ROTATION + 3] * px + rows[n, ROTATION + 4] * py + rows[n, ROTATION + 5] * pz
    lz = rows[n, ROTATION + 6] * px + rows[n, ROTATION + 7] * py + rows[n, ROTATION + 8] * pz
    a, b, c, d = rows[n, SIZE], rows[n, SIZE + 1], rows[n, SIZE + 2], rows[n, SIZE + 3]
    kind = rows[n, TYPE]
    if kind == 0:
        return _ellipsoid(lx, ly, lz, a, b, c, False)
    if kind == 1:
        plain = _cone(lx, ly, lz, a, b, c)
        ring = rows[n, RING]
        near = 1.0 - abs(plain) / (3.0 * abs(ring) + 1.0)
        if ring == 0.0 or near <= 0.0:
            return plain
        # Rings that are open on one side, as of the trachea; they fade away from the wall.
        there = min(max(0.75 - ly / (abs(ly) + abs(lz) + 1e-6), 0.0), 1.0)
        return plain + ring * near * there * sine(6.2831853 * lx / rows[n, RING + 1])
    if kind == 2:
        return _box(lx, ly, lz, a, b, c, d)
    if kind == 3:
        return np.sqrt((np.sqrt(lx * lx + ly * ly) - a) ** 2 + lz * lz) - b
    # A sheet a x b, c thick, that waves and curls across its plane.
    bend = rows[n, RING] * sine(lx / rows[n, RING + 1] + 1.3 * ly / rows[n, RING + 1] + d)
    steep = rows[n, RING] / rows[n, RING + 1]
    return 0.95 / np.sqrt(1.0 + 2.7 * steep * steep) * _box(lx, ly, lz - bend, a, b, c, 0.99 * c)


@njit(**_FAST)
def _straighten(bends, x, y, z):
    """Tube coordinates (u, v, w) of a point and the greatest stretch of lengths there."""
    stretch = 1.0
    for n in range(bends.shape[0]):
        start, radius, c, s = bends[n, 0], bends[n, 1], bends[n, 3], bends[n, 4]
        v, w = c * y + s * z, c * z - s * y
        ahead, across = x - start, radius - v
        # Sine (times distance from the bend's centre) of the angle beyond the bend's end, and beyond its middle.
        beyond = ahead * bends[n, 5] - across * bends[n, 6]
        if ahead > 0.0 and beyond <= 0.0:
            rho = np.sqrt(ahead * ahead + across * across)
            x, v = start + radius * np.arctan2(ahead, across), radius - rho
            stretch *= max(1.0, min(radius / (rho + 1e-6), 6.0))
        elif ahead * bends[n, 7] - across * bends[n, 8] > 0.0:
            x, v = start + radius * bends[n, 2] + beyond, radius - across * bends[n, 5] - ahead * bends[n, 6]
        y, z = c * v - s * w, s * v + c * w
    return x, y, z, stretch


@njit(**_FAST)
def bend_back(bends, u, v, w):
    """Point (x, y, z) of tube coordinates (u, v, w), both mm: the inverse of straightening near the centre line."""
    x, y, z = u, v, w
    for n in range(bends.shape[0] - 1, -1, -1):
        start, radius, most, c, s = bends[n, 0], bends[n, 1], bends[n, 2], bends[n, 3], bends[n, 4]
        a, b = c * y + s * z, c * z - s * y
        if x > start:
            angle = min((x - start) / radius, most)
            rest = max(x - start - radius * most, 0.0)
            x = start + (radius - a) * np.sin(angle) + rest * np.cos(angle)
            a = radius - (radius - a) * np.cos(angle) + rest * np.sin(angle)
        y, z = c * a - s * b, s * a + c * b
    return x, y, z


@njit(**_FAST)
def centre_line(base, u):
    """Offsets (v, w) of the winding centre line from the straight axis at station u of a tube; see `scene_tubes`."""
    return base[9] * sine(base[10] * u + base[11]), base[12] * sine(base[13] * u + base[14])


@njit(**_FAST)
def tube_radius(base, u, c3):
    """Radius of a tube at station u where the cosine of thrice the angle to a taenia is c3; see `scene_tubes`."""
    wave = base[2] * sine(base[3] * u + base[4]) + base[5] * sine(base[6] * u + base[7])
    return base[1] * (1.0 + wave) * (1.0 - base[8] * (0.5 + 0.5 * c3))


@njit(**_FAST)
def tube(base, bends, folds, x, y, z):
    """Free distance (mm, positive in the lumen) inside a winding tube with crescent folds; see `scene_tubes`."""
    u, v, w, stretch = _straighten(bends, x, y, z)
    dv, dw = centre_line(base, u)
    v, w = v - dv, w - dw
    r = np.sqrt(v * v + w * w) + 1e-9
    cv, cw = v / r, w / r
    angle = base[15] + base[16] * u
    c1 = cv * sine(angle + 1.5707963) + cw * sine(angle)
    wall = tube_radius(base, u, c1 * (4.0 * c1 * c1 - 3.0))
    free = wall - r
    if base[21] > 0.0 and free < 6.0 * base[21] + 2.0:
        tilted = u + base[23] * c1 + base[24] * cv
        free -= base[21] * sine(6.2831853 * tilted / base[22]) * (0.5 + 0.5 * sine(0.13 * u + 3.0 * cw))
    free = smooth_min(free, u - base[17], base[20])
    free = smooth_min(free, base[18] - u, base[20])
    if r > wall - base[26]:
        free = _with_folds(base, folds, free, (u, r, cv, cw, wall))
    else:
        # Folds are no nearer than their tips; base[27] is the margin that base[26] holds beyond these.
        free = min(free, wall - base[26] - r + base[27])
    return free / stretch


@njit(**_FAST)
def _with_folds(base, folds, free, at):
    u, r, cv, cw, wall = at
    cell = int(np.floor((u - base[17]) / base[19]))
    for i in range(max(cell - 1, 0), min(cell + 2, folds.shape[0])):
        height = folds[i, 1]
        if height <= 0.0:
            continue
        facing = cv * folds[i, 4] + cw * folds[i, 5]
        share = (facing - folds[i, 6]) / (1.0 - folds[i, 6])
        if share <= 0.0:
            continue
        share = min(1.5 * share, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        tip = wall - height * share + folds[i, 2]
        along = u - folds[i, 0] - folds[i, 7] * facing + folds[i, 8] * (wall - r)
        away = np.sqrt(along * along + max(tip - r, 0.0) ** 2) - folds[i, 2] - folds[i, 3] * max(r - tip, 0.0)
        free = smooth_min(free, 0.85 * away, base[25] * (0.1 + share))
    return free


@njit(**_FAST)
def floor(base, x, y, z):
    """Free distance (mm) above a waved, stepped, curved floor and below a dome; see `scene_abdomen`."""
    h = 0.0
    for n in range(3):
        h += base[1 + 4 * n] * sine(base[2 + 4 * n] * x + base[3 + 4 * n] * y + base[4 + 4 * n])
    along = base[13] * x + base[14] * y
    h += base[15] * (np.sqrt(1.0 + ((along - base[17]) / base[16]) ** 2) - 1.0)
    across = base[14] * x - base[13] * y - base[20] + 2.0 * sine(along / base[21])
    h += 0.5 * base[18] * np.tanh(across / base[19])
    dome = base[22] - np.sqrt(x * x + y * y + z * z)
    return min((z - h) * base[23], dome)


def shape_row(
    kind: int,
    centre: np.ndarray,
    rotation: np.ndarray,
    size: tuple[float, ...],
    *,
    solid: bool = True,
    part: int = 0,
    blend: float = 1.0,
) -> np.ndarray:
    """Return the row (COLUMNS,) of one shape.

    `rotation` (3, 3), shape <- scene axes. `size`: half axes (ellipsoid); length, radius at the start and
    at the end (cone, from `centre` along x); half sides, rounding (box); radii of ring and bulge (torus); half sides,
    phase (sheet). `blend` > 0 is the length over which it merges with what is there already.
    """
    row = np.zeros(COLUMNS)
    row[TYPE], row[OP], row[BLEND], row[PART], row[RELIEF] = kind, float(solid), max(blend, 1e-3), part, 1.0
    row[CENTRE : CENTRE + 3], row[ROTATION : ROTATION + 9] = centre, np.ravel(rotation)
    row[SIZE : SIZE + len(size)] = size
    row[RING + 1] = 1.0
    extent = {
        ELLIPSOID: max(size[:3]),
        CONE: size[0] + max(size[1:3]) if kind == CONE else 0.0,
        TORUS: size[0] + size[1],
    }
    row[REACH] = extent.get(kind, float(np.linalg.norm(size[:3])))
    return row


def joined(rows: list[np.ndarray], blend: float) -> list[np.ndarray]:
    """Return the rows as one group: they merge with each other over the length `blend` before they meet the scene."""
    for row in rows[1:]:
        row[JOINS], row[BLEND] = 1.0, max(blend, 1e-3)
    return rows


def waved(row: np.ndarray, height: float, length: float) -> np.ndarray:
    """Return the row of a sheet that waves (or of a cone with rings) with that height and wave length."""
    row[RING], row[RING + 1] = height, length
    row[REACH] += abs(height)
    return row
