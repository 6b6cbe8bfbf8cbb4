"""The scenes, built around a camera path: a laparoscopic cavity with organs, a folded colon, a straight tube.

A lumen is a smooth union of balls along the path and beyond it, so the camera is always in free space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from scipy import ndimage
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.distance import cdist

from scopemap.engine.geometry.kernels import IS_CACHED
from scopemap_bench.phantom.march import Volume, noise_at

_WALL_MM = 95.0
_FLOOR_MM = 62.0
_BEHIND_MM = 45.0
_VOXEL_MM = 1.25
_SLABS = 16
_MELT_PER_MM = 0.8
_DEEPEST_MM = -6.0
_RELIEF_MM = 16.0

# Linear RGB of floor (omentum fat), abdominal wall, and the organs in the order of `_organs`.
_TINTS = np.array(
    [
        *([0.66, 0.40, 0.16], [0.52, 0.20, 0.16], [0.30, 0.060, 0.050], [0.32, 0.070, 0.055]),
        *([0.62, 0.44, 0.30], [0.62, 0.28, 0.22], [0.60, 0.25, 0.20]),
    ],
    np.float32,
)
# A third of the floor's fat: what is full of blood is as dark.
_OMENTUM_RGB = _TINTS[0] / 3
# Its middle line below the view's, and its half widths along and across the lower edge.
_OMENTUM_DOWN_MM = 26.0
_OMENTUM_ALONG_MM = 70.0
_OMENTUM_ACROSS_MM = 20.0
_SPACING_MM = 4.0
_AHEAD_MM = 84.0
_RADIUS_MM = 18.0
_SHARPNESS_PER_MM = 0.35
_OUTSIDE_MM = -8.0
_BRICK = 8
_VOXEL_BUDGET = 20e6
_TUBE_RADIUS_MM = 16.0
_TUBE_AHEAD_MM = 130.0


@dataclass(frozen=True)
class Tint:
    """Base colour of tissue in space: linear RGB (X, Y, Z, 3) uint8 (255 = 1) on a volume's grid."""

    colours: np.ndarray
    origin_mm: np.ndarray
    voxel_mm: float

    def at(self, points_mm: np.ndarray) -> np.ndarray:
        """Return linear RGB (..., 3) float32 at points (..., 3); NaN points give the colour of the origin."""
        grid = np.moveaxis(np.nan_to_num((points_mm - self.origin_mm) / self.voxel_mm), -1, 0)
        channels = [
            ndimage.map_coordinates(self.colours[..., c], grid, np.float32, order=1, mode="nearest") for c in range(3)
        ]
        return np.stack(channels, -1) / 255


def laparoscopy_volume(poses: np.ndarray, seed: int, rise: float = 1.0, omentum_mm: float = 0.0) -> tuple[Volume, Tint]:
    """Return the free space and the colours of a cavity with organs, at least 25 mm in front of poses (N, 4, 4).

    rise : how far organs and relief rise from the floor, share of the usual; a small one makes it nearly plane.
    omentum_mm : how far a dark omentum rises from the floor below the middle of the view; 0: there is none.
    """
    frame = _frame(poses)
    local = (poses[:, :3, 3] - frame[:3, 3]) @ frame[:3, :3]
    half = _WALL_MM + float(np.linalg.norm(local[:, :2], axis=1).max())
    depth = _FLOOR_MM + float(local[:, 2].max())
    behind = _BEHIND_MM - float(local[:, 2].min())
    corners = np.stack(np.meshgrid([-half, half], [-half, half], [-behind, depth + 8.0]), -1).reshape(-1, 3)
    corners = corners @ frame[:3, :3].T + frame[:3, 3]
    origin = corners.min(0) - 6.0
    shape = np.ceil((corners.max(0) + 6.0 - origin) / _VOXEL_MM).astype(int) + 1
    tints = np.vstack([_TINTS, _OMENTUM_RGB]) if omentum_mm > 0 else _TINTS
    value, colours = np.empty(shape, np.float32), np.empty((*shape, 3), np.uint8)
    for start in range(0, shape[0], _SLABS):
        block = slice(start, min(start + _SLABS, shape[0]))
        points = np.indices(value[block].shape, np.float32).reshape(3, -1).T * _VOXEL_MM
        points[:, 0] += start * _VOXEL_MM
        points = (points + (origin - frame[:3, 3])) @ frame[:3, :3]
        distances = _distances(points, half, depth, behind, seed, rise)
        if omentum_mm > 0:
            distances = np.vstack([distances, _omentum(points, depth, omentum_mm, seed)])
        nearest = distances.min(0)
        melt = np.exp(-_MELT_PER_MM * (distances - nearest))
        total = melt.sum(0)
        value[block] = np.maximum(nearest - np.log(total) / _MELT_PER_MM, _DEEPEST_MM).reshape(value[block].shape)
        colours[block] = np.rint(255 * (melt / total).T @ tints).reshape(colours[block].shape)
    return Volume(value, origin, _VOXEL_MM), Tint(colours, origin, _VOXEL_MM)


def _frame(poses: np.ndarray) -> np.ndarray:
    """Motion from the cavity's axes to the world: the first camera's axes, z turned to the mean view."""
    view = poses[:, :3, 2].mean(0)
    view /= np.linalg.norm(view)
    right = poses[0, :3, 0] - view * (poses[0, :3, 0] @ view)
    right /= np.linalg.norm(right)
    T_world_cavity = np.eye(4)
    T_world_cavity[:3, :3] = np.stack([right, np.cross(view, right), view], -1)
    T_world_cavity[:3, 3] = poses[:, :3, 3].mean(0)
    return T_world_cavity


def _distances(p: np.ndarray, half: float, depth: float, behind: float, seed: int, rise: float) -> np.ndarray:
    """Distance (K, N), mm, roughly, from points (N, 3) in cavity axes to floor, wall and each organ."""
    radii = np.array([half, half, 0.5 * (depth + behind) + 30.0])
    wall = -_ellipsoid(p, np.array([0.0, 0.0, 0.5 * (depth - behind)]), radii, 0.0)
    distances = np.stack([depth - p[:, 2], wall, *(rise * d for d in _organs(p / [1, 1, rise], depth / rise, seed))])
    # Noise costs most of the time; away from the surface it would not be seen.
    near = np.abs(distances.min(0)) < _RELIEF_MM
    distances[:, near] += rise * _relief(p[near], len(distances) - 2, seed)
    return distances


def _omentum(p: np.ndarray, depth: float, rise_mm: float, seed: int) -> np.ndarray:
    """Distance (N,) from points (N, 3) in cavity axes to a lumpy ridge along the lower edge of the view (y down)."""
    radii = np.array([_OMENTUM_ALONG_MM, _OMENTUM_ACROSS_MM, rise_mm])
    ridge = _ellipsoid(p, np.array([0.0, _OMENTUM_DOWN_MM, depth]), radii, 0.0)
    near = np.abs(ridge) < _RELIEF_MM
    ridge[near] += 3.0 * noise_at(p[near], 18.0, seed + 28) + 1.2 * noise_at(p[near], 7.0, seed + 29)
    return ridge


def _relief(p: np.ndarray, organs: int, seed: int) -> np.ndarray:
    """Relief (K, N) of floor, wall and organs, mm, at points (N, 3); less than `_RELIEF_MM` everywhere."""
    lumps = 4.0 * noise_at(p, 22.0, seed + 21) + 1.6 * noise_at(p, 9.0, seed + 22) + 0.5 * noise_at(p, 4.5, seed + 26)
    floor = 9.0 * noise_at(p * [1, 1, 0], 70.0, seed + 23) + lumps
    wall = 4.0 * noise_at(p, 34.0, seed + 24) + 0.8 * lumps
    smooth = 2.0 * noise_at(p, 30.0, seed + 25) + 0.4 * noise_at(p, 7.0, seed + 27)
    return np.stack([floor, wall, *[smooth] * organs])


def _organs(p: np.ndarray, depth: float, seed: int) -> list[np.ndarray]:
    """Two lobes of a liver, a gallbladder between them, and two loops of bowel."""
    rng = np.random.default_rng((seed, 3))
    shift = rng.uniform(-6.0, 6.0, size=(5, 3)) * [1, 1, 0.5]
    turn = rng.uniform(-0.3, 0.3, size=5)
    bodies = [
        ([-46.0, -22.0, 6.0], [48.0, 40.0, 26.0], 0.3),
        ([44.0, -34.0, 8.0], [42.0, 34.0, 26.0], -0.4),
        ([0.0, -6.0, 2.0], [11.0, 28.0, 13.0], 0.25),
    ]
    shapes = [
        _ellipsoid(p, np.array(centre) + [0, 0, depth] + shift[n], np.array(radii), angle + turn[n])
        for n, (centre, radii, angle) in enumerate(bodies)
    ]
    loops = [([-24.0, 56.0, 4.0], 34.0, 11.0), ([44.0, 52.0, 5.0], 31.0, 12.0)]
    return shapes + [
        _torus(p, np.array(centre) + [0, 0, depth] + shift[n], ring, pipe)
        for n, (centre, ring, pipe) in enumerate(loops, 3)
    ]


def _ellipsoid(p: np.ndarray, centre: np.ndarray, radii: np.ndarray, angle_rad: float) -> np.ndarray:
    """Distance to an ellipsoid rotated about z, first order: exact in sign, slope 1 at the surface."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    q = (p - centre) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    scaled = np.linalg.norm(q / radii, axis=1)
    return scaled * (scaled - 1) / np.maximum(np.linalg.norm(q / radii**2, axis=1), 1e-6)


def _torus(p: np.ndarray, centre: np.ndarray, ring: float, pipe: float) -> np.ndarray:
    """Distance to a horizontal torus with haustra, mm."""
    q = p - centre
    around = np.arctan2(q[:, 1], q[:, 0])
    thickness = pipe * (1.0 + 0.06 * np.cos(11.0 * around))
    return np.hypot(np.hypot(q[:, 0], q[:, 1]) - ring, q[:, 2]) - thickness


def colon_volume(poses: np.ndarray, seed: int, fold_mm: float = 6.0) -> Volume:
    """Return a colon-like lumen around camera poses (N, 4, 4): at least 6 mm of free space, a blind end ahead.

    fold_mm : how far folds rise from the wall, at most.
    """
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
    value[wall] -= _lumen_relief(points, station[wall], seed, fold_mm)
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


def _lumen_relief(points: np.ndarray, station: np.ndarray, seed: int, fold_mm: float) -> np.ndarray:
    """Height (N,) in mm of folds, wrinkles and bumps above the plain wall at points (N, 3)."""
    wobble = 5.0 * noise_at(points, 24.0, seed + 11)
    crescent = np.clip(0.5 + 1.3 * noise_at(points, 26.0, seed + 12), 0.1, 1.0)
    folds = fold_mm * crescent * np.exp(4.5 * (np.cos(2 * np.pi * (station + wobble) / 19.0) - 1))
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


@njit(cache=IS_CACHED, nogil=True, parallel=True)
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
