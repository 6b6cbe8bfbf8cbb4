"""A scene's shape as a smooth function on a grid, noise, and ray marching from a camera to the surface.

The shape is the zero set of a uniform cubic B-spline (M. Unser, IEEE Signal Processing Magazine 16(6), 1999, eq. 9),
positive in the free space and negative in tissue. In a cell it stays within the range of the 4x4x4 coefficients around
it (convex hull), and its slope within that of their differences. Sphere tracing (J. C. Hart, The Visual Computer 12,
1996) crosses empty cells by their guaranteed distance, goes by value over steepest slope near the surface, and ends in
bracketed Newton steps. Noise is gradient noise (K. Perlin, "Improving noise", SIGGRAPH 2002) on a hashed lattice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numba import njit, prange
from scipy import ndimage

from scopemap.engine.cameras.camera import CameraModel
from scopemap.engine.geometry.kernels import IS_CACHED
from scopemap_bench.phantom.motion import Displacement
from scopemap_bench.phantom.slit import gap_at, shift_at

_MARGIN = 2
_MAX_STEPS = 1000
_NEWTON_STEP_VOXELS = 0.5
_TOLERANCE_VOXELS = 1e-5
_LEAST_STEP_VOXELS = 1e-3

Grids = tuple[np.ndarray, np.ndarray, np.ndarray, float, float]
Moved = tuple[np.ndarray, np.ndarray, np.ndarray]


@njit(cache=IS_CACHED, nogil=True, inline="always")
def _weights(f: float) -> tuple[float, float, float, float]:
    g = 1.0 - f
    low, high = (4.0 - 3.0 * f * f * (1.0 + g)) / 6.0, (4.0 - 3.0 * g * g * (1.0 + f)) / 6.0
    return g * g * g / 6.0, low, high, f * f * f / 6.0


@njit(cache=IS_CACHED, nogil=True, inline="always")
def _slopes(f: float) -> tuple[float, float, float, float]:
    g = 1.0 - f
    return -0.5 * g * g, 1.5 * f * f - 2.0 * f, 0.5 + f - 1.5 * f * f, 0.5 * f * f


@njit(cache=IS_CACHED, nogil=True)
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


@njit(cache=IS_CACHED, nogil=True, inline="always")
def inside(c: np.ndarray, x: float, y: float, z: float) -> bool:
    """Tell whether the spline is defined at grid coordinates (a NaN is not inside)."""
    m, n, p = c.shape
    return _MARGIN <= x < m - _MARGIN - 1 and _MARGIN <= y < n - _MARGIN - 1 and _MARGIN <= z < p - _MARGIN - 1


@njit(cache=IS_CACHED, nogil=True)
def evaluate(c: np.ndarray, grid: np.ndarray, out: np.ndarray) -> None:
    """Write value and gradient at grid coordinates (N, 3) into out (N, 4); points outside are left as they are."""
    for n in range(grid.shape[0]):
        x, y, z = grid[n]
        if inside(c, x, y, z):
            out[n, 0], out[n, 1], out[n, 2], out[n, 3] = spline(c, x, y, z)


@dataclass(frozen=True)
class Volume:
    """Shape of the free space on a grid of spacing `voxel_mm`, whose axes are those of the world.

    coefficients : (X, Y, Z) float32, mm: about the distance to the tissue where positive, below 0 in tissue.
    origin_mm : (3,) float64, world position of coefficient (0, 0, 0).
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


@njit(cache=IS_CACHED, nogil=True, inline="always")
def _corner(ix: int, iy: int, iz: int, seed: int, x: float, y: float, z: float) -> float:
    key = (ix * 73856093) ^ (iy * 19349663) ^ (iz * 83492791) ^ (seed * 2654435761)
    key = ((key ^ (key >> 13)) * 1274126177) & 0xFFFFFFFF
    key = ((key ^ (key >> 16)) * 2246822519) & 0xFFFFFFFF
    h = (key >> 15) & 15
    u = x if h < 8 else y
    v = y if h < 4 else (x if h == 12 or h == 14 else z)
    return (u if h & 1 == 0 else -u) + (v if h & 2 == 0 else -v)


@njit(cache=IS_CACHED, nogil=True, inline="always")
def _fade(a: float) -> float:
    return a * a * a * (a * (6.0 * a - 15.0) + 10.0)


@njit(cache=IS_CACHED, nogil=True)
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


@njit(cache=IS_CACHED, nogil=True, parallel=True)
def _fill(points: np.ndarray, period: float, seed: int, out: np.ndarray) -> None:
    for i in prange(points.shape[0]):
        x, y, z = points[i, 0] / period, points[i, 1] / period, points[i, 2] / period
        out[i] = _noise(x, y, z, seed) if np.isfinite(x + y + z) else 0.0


def noise_at(points_mm: np.ndarray, period_mm: float, seed: int) -> np.ndarray:
    """Return smooth noise (...) float32, within -1..1 (deviation 0.3), at points (..., 3); NaN points give 0."""
    points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 3)
    out = np.empty(len(points), np.float32)
    _fill(points, float(period_mm), int(seed), out)
    return out.reshape(points_mm.shape[:-1])


@dataclass(frozen=True)
class SurfaceBuffers:
    """The visible surface in each pixel, float32, before any shading; NaN where the ray hits nothing.

    depth_mm : (H, W) along the optical axis. distance_mm : (H, W) along the ray. normal : (H, W, 3) unit vectors in
    camera axes, towards the camera. rest_mm : (H, W, 3) world position before deformation, the texture coordinate.
    """

    depth_mm: np.ndarray
    distance_mm: np.ndarray
    normal: np.ndarray
    rest_mm: np.ndarray


@njit(cache=IS_CACHED, nogil=True)
def _rest_point(moved: Moved, origin: np.ndarray, d: np.ndarray, t: float, here: np.ndarray) -> None:
    """Write p - u(p) of the point p at distance t (voxels) of a ray into here[7:10], its rest point into here[1:4]."""
    px, py, pz = origin[0] + t * d[0], origin[1] + t * d[1], origin[2] + t * d[2]
    here[1], here[2], here[3] = px, py, pz
    for w in moved[0]:
        s = np.sin(w[0] * px + w[1] * py + w[2] * pz + w[6])
        here[1], here[2], here[3] = here[1] - w[3] * s, here[2] - w[4] * s, here[3] - w[5] * s
    for b in moved[1]:
        x, y, z = px - b[0], py - b[1], pz - b[2]
        s = np.exp(-b[6] * (x * x + y * y + z * z))
        here[1], here[2], here[3] = here[1] - b[3] * s, here[2] - b[4] * s, here[3] - b[5] * s
    here[7], here[8], here[9] = here[1], here[2], here[3]
    for c in moved[2]:
        across, gap, _, _, _, _ = gap_at(c, here[7], here[8], here[9])
        s = shift_at(c, across, gap)
        here[1], here[2], here[3] = here[1] - c[3] * s, here[2] - c[4] * s, here[3] - c[5] * s


@njit(cache=IS_CACHED, nogil=True)
def _part(c: np.ndarray, here: np.ndarray) -> None:
    """Turn value and gradient at the rest point, in here[0] and [4:7], into those at here[7:10] with a slit."""
    x, gap, deep, gap_y, gap_z, deep_y = gap_at(c, here[7], here[8], here[9])
    if gap == 0.0:
        return
    side = 1.0 if x >= 0.0 else -1.0
    within, fall = gap - abs(x), np.exp(min(gap - abs(x), 0.0) / c[13])
    # Slopes of the shift along the slit's axes.
    over = 0.0 if within >= 0.0 else side * fall * (1.0 + gap / c[13])
    shift_x = 1.0 if within >= 0.0 else -gap * fall / c[13]
    down = here[4] * c[3] + here[5] * c[4] + here[6] * c[5]
    along_x, along_y, along_z = -shift_x * down, -over * gap_y * down, -over * gap_z * down
    if within * c[19] > here[0] + deep:
        here[0] += deep
        along_y += deep_y
    elif within * c[19] > here[0]:
        here[0] = within * c[19]
        here[4] = here[5] = here[6] = 0.0
        along_x, along_y, along_z = -side * c[19], gap_y * c[19], gap_z * c[19]
    for axis in range(3):
        here[4 + axis] += along_x * c[3 + axis] + along_y * c[6 + axis] + along_z * c[9 + axis]


@njit(cache=IS_CACHED, nogil=True)
def _shape(c: np.ndarray, moved: Moved, origin: np.ndarray, d: np.ndarray, t: float, here: np.ndarray) -> float:
    """Write value, rest point and gradient in space into here[0], [1:4], [4:7]; return the slope along the ray."""
    _rest_point(moved, origin, d, t, here)
    if not inside(c, here[1], here[2], here[3]):
        here[0] = np.nan
        return 0.0
    here[0], gx, gy, gz = spline(c, here[1], here[2], here[3])
    here[4], here[5], here[6] = gx, gy, gz
    for s in moved[2]:
        _part(s, here)
        gx, gy, gz = here[4], here[5], here[6]
    for w in moved[0]:
        phase = w[0] * (origin[0] + t * d[0]) + w[1] * (origin[1] + t * d[1]) + w[2] * (origin[2] + t * d[2]) + w[6]
        s = np.cos(phase) * (w[3] * gx + w[4] * gy + w[5] * gz)
        here[4], here[5], here[6] = here[4] - w[0] * s, here[5] - w[1] * s, here[6] - w[2] * s
    for b in moved[1]:
        x, y, z = origin[0] + t * d[0] - b[0], origin[1] + t * d[1] - b[1], origin[2] + t * d[2] - b[2]
        s = -2.0 * b[6] * np.exp(-b[6] * (x * x + y * y + z * z)) * (b[3] * gx + b[4] * gy + b[5] * gz)
        here[4], here[5], here[6] = here[4] - x * s, here[5] - y * s, here[6] - z * s
    return here[4] * d[0] + here[5] * d[1] + here[6] * d[2]


@njit(cache=IS_CACHED, nogil=True)
def _refine(
    c: np.ndarray, moved: Moved, origin: np.ndarray, d: np.ndarray, near: float, far: float, here: np.ndarray
) -> float:
    """Root between `near` (free) and `far` (tissue): Newton from the middle, kept inside the bracket."""
    t = 0.5 * (near + far)
    for _ in range(60):
        slope = _shape(c, moved, origin, d, t, here)
        if here[0] > 0.0:
            near = t
        else:
            far = t
        step = -here[0] / slope if slope < 0.0 else np.inf
        if abs(step) < _TOLERANCE_VOXELS or far - near < _TOLERANCE_VOXELS:
            break
        t = t + step if near < t + step < far else 0.5 * (near + far)
    return t


@njit(cache=IS_CACHED, nogil=True)
def _march(grids: Grids, moved: Moved, origin: np.ndarray, d: np.ndarray, here: np.ndarray) -> float:
    """Distance (voxels) to the first surface, NaN if none; `here` is left as `_shape` fills it at the hit."""
    c, skip, steepest, slope_unit, stretch = grids
    t = before = 0.0
    for _ in range(_MAX_STEPS):
        _rest_point(moved, origin, d, t, here)
        if not inside(c, here[1], here[2], here[3]):
            return np.nan
        i, j, k = int(here[1]), int(here[2]), int(here[3])
        if skip[i, j, k] > 1:
            t += (skip[i, j, k] - 1) / stretch
            continue
        slope = _shape(c, moved, origin, d, t, here)
        value = here[0]
        if value <= 0.0:
            return _refine(c, moved, origin, d, before, t, here) if t > 0.0 else np.nan
        newton = -value / slope if slope < 0.0 else np.inf
        if newton < _TOLERANCE_VOXELS:
            return t
        before = t
        # The least step carries a ray past a surface that it merely grazes.
        safe = max(min(value / (steepest[i, j, k] * slope_unit), 1.0) / stretch, _LEAST_STEP_VOXELS)
        if safe < newton < _NEWTON_STEP_VOXELS:
            _shape(c, moved, origin, d, t + newton, here)
            if here[0] < 0.5 * value:
                t += newton
                continue
        t += safe
    return np.nan


@njit(cache=IS_CACHED, nogil=True, parallel=True)
def _march_image(grids: Grids, moved: Moved, T_grid_camera: np.ndarray, rays: np.ndarray, out: np.ndarray) -> None:
    """Fill out (H, W, 7): distance in voxels, rest point in grid coordinates, gradient in grid axes."""
    R, origin = np.ascontiguousarray(T_grid_camera[:3, :3]), np.ascontiguousarray(T_grid_camera[:3, 3])
    for row in prange(rays.shape[0]):
        here, d = np.empty(10), np.empty(3)
        for column in range(rays.shape[1]):
            ray = rays[row, column]
            if np.isnan(ray[0]):
                out[row, column] = np.nan
                continue
            length = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
            for axis in range(3):
                d[axis] = (R[axis, 0] * ray[0] + R[axis, 1] * ray[1] + R[axis, 2] * ray[2]) / length
            distance = _march(grids, moved, origin, d, here)
            out[row, column, 0] = distance
            for n in range(1, 7):
                out[row, column, n] = here[n] if np.isfinite(distance) else np.nan


def rays_of(camera: CameraModel) -> np.ndarray:
    """Return the rays (H, W, 3) float64, z = 1, of a camera's pixels; NaN beyond the field of its lens."""
    key: Any = camera  # every camera can be one, though the protocol does not say so
    return _rays_of(key)


@lru_cache(maxsize=2)
def _rays_of(camera: Any) -> np.ndarray:
    rays: np.ndarray = camera.unproject(np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1))
    return rays


def march(
    volume: Volume, camera: CameraModel, T_world_camera: np.ndarray, displacement: Displacement
) -> SurfaceBuffers:
    """Return the surface of `volume` seen by `camera` from `T_world_camera` (4, 4) while the tissue is displaced.

    Depth is exact to 1e-4 mm. A camera inside tissue, and a pixel beyond the field of the lens, see nothing (NaN).
    """
    T_grid_camera = np.array(T_world_camera, dtype=np.float64)
    T_grid_camera[:3, 3] = (T_grid_camera[:3, 3] - volume.origin_mm) / volume.voxel_mm
    rays = rays_of(camera)
    out = np.empty((camera.height, camera.width, 7))
    grids = (volume.coefficients, volume.skip, *volume.steepest, displacement.stretch)
    _march_image(grids, displacement.in_grid(volume.origin_mm, volume.voxel_mm), T_grid_camera, rays, out)
    distance = out[..., 0] * volume.voxel_mm
    normal = out[..., 4:] @ T_world_camera[:3, :3]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return SurfaceBuffers(
        depth_mm=(distance / np.linalg.norm(rays, axis=-1)).astype(np.float32),
        distance_mm=distance.astype(np.float32),
        normal=normal.astype(np.float32),
        rest_mm=(out[..., 1:4] * volume.voxel_mm + volume.origin_mm).astype(np.float32),
    )
