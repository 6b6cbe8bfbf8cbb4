"""Lumens built around a camera path: the colon with folds and haustra, and the straight featureless tube.

A lumen is a smooth union of balls along the path and beyond it, so the camera is always in free space.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import cdist

from scopemap_bench.phantom.volume import Volume, noise_at

_SPACING_MM = 4.0
_AHEAD_MM = 84.0
_RADIUS_MM = 18.0
_SHARPNESS_PER_MM = 0.35
_OUTSIDE_MM = -8.0
_BRICK = 8
_VOXEL_BUDGET = 20e6
_TUBE_RADIUS_MM = 16.0
_TUBE_AHEAD_MM = 130.0


def colon_volume(poses: np.ndarray, seed: int) -> Volume:
    """Return a colon-like lumen around camera poses (N, 4, 4): at least 6 mm of free space, a blind end ahead."""
    rng = np.random.default_rng((seed, 2))
    centres = backbone(poses, rng)
    along = _distances_along(centres)
    radii = _RADIUS_MM * (1.0 + 0.1 * np.sin(along / 17.0 + rng.uniform(0, 6)) + 0.06 * np.sin(along / 7.3))
    origin, shape, voxel = _box(centres, margin_mm=_RADIUS_MM + 14.0)
    value, station = np.full(shape, _OUTSIDE_MM, np.float32), np.zeros(shape, np.float32)
    balls = np.column_stack([(centres - origin) / voxel, radii / voxel, along])
    _balls(balls, _SHARPNESS_PER_MM * voxel, _OUTSIDE_MM / voxel, value, station)
    value *= voxel
    # Far inside nothing is changed: rays cross the empty middle by the distance map alone.
    wall = (value > _OUTSIDE_MM + 0.5) & (value < 14.0)
    points = np.argwhere(wall) * voxel + origin
    value[wall] -= _relief(points, station[wall], seed)
    return Volume(value, origin, voxel)


def tube_volume(poses: np.ndarray) -> Volume:
    """Return a straight round tube, open at both ends far away, around camera poses (N, 4, 4)."""
    positions, axis = poses[:, :3, 3], poses[:, :3, 2].mean(0)
    axis = axis / np.linalg.norm(axis)
    centre = positions.mean(0)
    offsets = positions - centre
    beside = offsets - np.outer(offsets @ axis, axis)
    radius = _TUBE_RADIUS_MM + float(np.linalg.norm(beside, axis=1).max())
    reach = float(np.abs(offsets @ axis).max()) + _TUBE_AHEAD_MM
    origin, shape, voxel = _box(centre + np.outer([-reach, reach], axis), margin_mm=radius + 4.0)
    grids = np.ogrid[tuple(slice(n) for n in shape)]
    relative = [(g * voxel + o - c).astype(np.float32) for g, o, c in zip(grids, origin, centre, strict=True)]
    along = sum(r * a for r, a in zip(relative, axis.astype(np.float32), strict=True))
    squared = sum(r**2 for r in relative) - along**2
    return Volume(np.float32(radius) - np.sqrt(np.maximum(squared, 0)), origin, voxel)


def backbone(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the lumen's centres (M, 3), mm: the path thinned to 4 mm, and a bent piece ahead of its open end."""
    kept = [poses[0, :3, 3]]
    for position in poses[1:, :3, 3]:
        if np.linalg.norm(np.array(kept) - position, axis=1).min() > _SPACING_MM:
            kept.append(position)
    visited = np.array(kept)
    views = poses[:, :3, 3] + 30.0 * poses[:, :3, 2]
    end = poses[int(cdist(views, visited).min(1).argmax())]
    return np.vstack([visited, _extension(end, rng)])


def _extension(T_world_camera: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    heading, sideways = T_world_camera[:3, 2], T_world_camera[:3, :2] @ rng.normal(size=2)
    bend = sideways / np.linalg.norm(sideways) / rng.uniform(70.0, 110.0)
    steps = np.arange(_SPACING_MM, _AHEAD_MM, _SPACING_MM)[:, None]
    return T_world_camera[:3, 3] + heading * steps + 0.5 * bend * steps**2


def _distances_along(centres: np.ndarray) -> np.ndarray:
    """Distance of each centre from the blind end through the lumen: a station that fits paths going to and fro."""
    distances = cdist(centres, centres)
    links = np.where(distances < 2.0 * _SPACING_MM, distances, 0)
    # A path file may jump: consecutive centres stay linked at any distance.
    for i in range(len(centres) - 1):
        links[i, i + 1] = links[i + 1, i] = distances[i, i + 1]
    return dijkstra(links, directed=False, indices=len(centres) - 1)


def _relief(points: np.ndarray, station: np.ndarray, seed: int) -> np.ndarray:
    """Height (N,) in mm of folds, wrinkles and bumps above the plain wall at points (N, 3)."""
    wobble = 5.0 * noise_at(points, 24.0, seed + 11)
    crescent = np.clip(0.5 + 1.3 * noise_at(points, 26.0, seed + 12), 0.1, 1.0)
    folds = 6.0 * crescent * np.exp(4.5 * (np.cos(2 * np.pi * (station + wobble) / 19.0) - 1))
    wrinkles = 0.35 * np.sin(2 * np.pi * (station + 1.6 * wobble) / 5.2) * (0.6 + noise_at(points, 15.0, seed + 13))
    shape = 3.5 * noise_at(points, 32.0, seed + 14)
    bumps = 1.0 * noise_at(points, 9.0, seed + 15) + 0.3 * noise_at(points, 4.0, seed + 16)
    return folds + wrinkles + shape + bumps


def _box(points: np.ndarray, margin_mm: float) -> tuple[np.ndarray, tuple[int, int, int], float]:
    """Origin, shape and spacing of a grid around points; 1 mm, coarser only above 20 million voxels."""
    low, high = points.min(0) - margin_mm, points.max(0) + margin_mm
    voxel = max(1.0, float(np.prod(high - low) / _VOXEL_BUDGET) ** (1 / 3))
    nx, ny, nz = (int(n) for n in np.ceil((high - low) / voxel) + 1)
    return low, (nx, ny, nz), voxel


@njit(cache=True, nogil=True, parallel=True)
def _balls(balls: np.ndarray, sharpness: float, outside: float, value: np.ndarray, station: np.ndarray) -> None:
    """Smooth union of balls (x, y, z, radius, station): log-sum-exp of radius minus distance, brick by brick.

    The station is a wider mean than the union, or it would run in steps from ball to ball.
    """
    nx, ny, nz = value.shape
    half = 0.5 * _BRICK * np.sqrt(3.0)
    reach = 2.0 * half + 16.0 / sharpness
    for bx in prange((nx + _BRICK - 1) // _BRICK):
        for by in range((ny + _BRICK - 1) // _BRICK):
            for bz in range((nz + _BRICK - 1) // _BRICK):
                x0, y0, z0 = bx * _BRICK, by * _BRICK, bz * _BRICK
                cx, cy, cz = x0 + 0.5 * _BRICK, y0 + 0.5 * _BRICK, z0 + 0.5 * _BRICK
                far = np.sqrt((balls[:, 0] - cx) ** 2 + (balls[:, 1] - cy) ** 2 + (balls[:, 2] - cz) ** 2)
                depth = balls[:, 3] - far
                if depth.max() < outside - half - 3.0 / sharpness:
                    continue
                near = balls[depth > depth.max() - reach]
                for x in range(x0, min(x0 + _BRICK, nx)):
                    for y in range(y0, min(y0 + _BRICK, ny)):
                        for z in range(z0, min(z0 + _BRICK, nz)):
                            total = weights = weighted = 0.0
                            for ball in near:
                                d = np.sqrt((ball[0] - x) ** 2 + (ball[1] - y) ** 2 + (ball[2] - z) ** 2)
                                weight = np.exp(sharpness * (ball[3] - d))
                                total += weight
                                weights += np.sqrt(weight)
                                weighted += np.sqrt(weight) * ball[4]
                            value[x, y, z] = max(np.log(total) / sharpness, outside)
                            station[x, y, z] = weighted / weights
