"""Ray marching from a camera to the surface of a volume, exact, also for tissue that moves.

Sphere tracing (J. C. Hart, The Visual Computer 12, 1996): through empty cells by their guaranteed distance, near the
surface by value over steepest slope, and at the surface by bracketed Newton steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit, prange

from scopemap.cameras.camera import CameraModel
from scopemap_bench.phantom.deformation import Displacement
from scopemap_bench.phantom.volume import Volume, inside, spline

_MAX_STEPS = 1000
_NEWTON_STEP_VOXELS = 0.5
_TOLERANCE_VOXELS = 1e-5
_LEAST_STEP_VOXELS = 1e-3

Grids = tuple[np.ndarray, np.ndarray, np.ndarray, float, float]
Moved = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class SurfaceBuffers:
    """The visible surface in each pixel, before any shading.

    depth_mm : (H, W) float32 along the optical axis, NaN where the ray hits nothing.
    distance_mm : (H, W) float32 along the ray, NaN likewise.
    normal : (H, W, 3) float32 unit vectors in camera axes, towards the camera, NaN likewise.
    rest_mm : (H, W, 3) float32, world position of the point before deformation, the texture coordinate, NaN likewise.
    """

    depth_mm: np.ndarray
    distance_mm: np.ndarray
    normal: np.ndarray
    rest_mm: np.ndarray


@njit(cache=True, nogil=True)
def _rest_point(moved: Moved, origin: np.ndarray, d: np.ndarray, t: float, here: np.ndarray) -> None:
    """Write the rest point p - u(p) of the point p at distance t (voxels) of a ray into here[1:4]."""
    px, py, pz = origin[0] + t * d[0], origin[1] + t * d[1], origin[2] + t * d[2]
    here[1], here[2], here[3] = px, py, pz
    for w in moved[0]:
        s = np.sin(w[0] * px + w[1] * py + w[2] * pz + w[6])
        here[1], here[2], here[3] = here[1] - w[3] * s, here[2] - w[4] * s, here[3] - w[5] * s
    for b in moved[1]:
        x, y, z = px - b[0], py - b[1], pz - b[2]
        s = np.exp(-b[6] * (x * x + y * y + z * z))
        here[1], here[2], here[3] = here[1] - b[3] * s, here[2] - b[4] * s, here[3] - b[5] * s


@njit(cache=True, nogil=True)
def _shape(c: np.ndarray, moved: Moved, origin: np.ndarray, d: np.ndarray, t: float, here: np.ndarray) -> float:
    """Write value, rest point and gradient in space into here[0], [1:4], [4:7]; return the slope along the ray."""
    _rest_point(moved, origin, d, t, here)
    if not inside(c, here[1], here[2], here[3]):
        here[0] = np.nan
        return 0.0
    here[0], gx, gy, gz = spline(c, here[1], here[2], here[3])
    here[4], here[5], here[6] = gx, gy, gz
    for w in moved[0]:
        phase = w[0] * (origin[0] + t * d[0]) + w[1] * (origin[1] + t * d[1]) + w[2] * (origin[2] + t * d[2]) + w[6]
        s = np.cos(phase) * (w[3] * gx + w[4] * gy + w[5] * gz)
        here[4], here[5], here[6] = here[4] - w[0] * s, here[5] - w[1] * s, here[6] - w[2] * s
    for b in moved[1]:
        x, y, z = origin[0] + t * d[0] - b[0], origin[1] + t * d[1] - b[1], origin[2] + t * d[2] - b[2]
        s = -2.0 * b[6] * np.exp(-b[6] * (x * x + y * y + z * z)) * (b[3] * gx + b[4] * gy + b[5] * gz)
        here[4], here[5], here[6] = here[4] - x * s, here[5] - y * s, here[6] - z * s
    return here[4] * d[0] + here[5] * d[1] + here[6] * d[2]


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True, parallel=True)
def _march_image(grids: Grids, moved: Moved, T_grid_camera: np.ndarray, rays: np.ndarray, out: np.ndarray) -> None:
    """Fill out (H, W, 7): distance in voxels, rest point in grid coordinates, gradient in grid axes."""
    R, origin = np.ascontiguousarray(T_grid_camera[:3, :3]), np.ascontiguousarray(T_grid_camera[:3, 3])
    for row in prange(rays.shape[0]):
        here, d = np.empty(7), np.empty(3)
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

    Depth is exact to 1e-4 mm before rounding to float32. A camera inside tissue, and a pixel beyond the field of the
    lens, see nothing (NaN).
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
