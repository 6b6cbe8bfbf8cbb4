"""The laparoscopic scene: organs on the floor of an inflated cavity, built in front of a camera path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from scopemap_bench.phantom.volume import Volume, noise_at

_WALL_MM = 95.0
_FLOOR_MM = 62.0
_BEHIND_MM = 45.0
_VOXEL_MM = 1.25
_MELT_PER_MM = 0.8
_DEEPEST_MM = -6.0
_SLABS = 16
_RELIEF_MM = 16.0

# Linear RGB of floor (omentum fat), abdominal wall, and the organs in the order of `_organs`.
_TINTS = np.array(
    [
        [0.66, 0.40, 0.16],
        [0.52, 0.20, 0.16],
        [0.30, 0.060, 0.050],
        [0.32, 0.070, 0.055],
        [0.62, 0.44, 0.30],
        [0.62, 0.28, 0.22],
        [0.60, 0.25, 0.20],
    ],
    np.float32,
)


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


def laparoscopy_volume(poses: np.ndarray, seed: int) -> tuple[Volume, Tint]:
    """Return the free space and the colours of a cavity with organs, at least 25 mm in front of poses (N, 4, 4)."""
    frame = _frame(poses)
    local = (poses[:, :3, 3] - frame[:3, 3]) @ frame[:3, :3]
    half = _WALL_MM + float(np.linalg.norm(local[:, :2], axis=1).max())
    depth = _FLOOR_MM + float(local[:, 2].max())
    behind = _BEHIND_MM - float(local[:, 2].min())
    corners = np.stack(np.meshgrid([-half, half], [-half, half], [-behind, depth + 8.0]), -1).reshape(-1, 3)
    corners = corners @ frame[:3, :3].T + frame[:3, 3]
    origin = corners.min(0) - 6.0
    shape = np.ceil((corners.max(0) + 6.0 - origin) / _VOXEL_MM).astype(int) + 1
    value, colours = np.empty(shape, np.float32), np.empty((*shape, 3), np.uint8)
    for start in range(0, shape[0], _SLABS):
        block = slice(start, min(start + _SLABS, shape[0]))
        points = np.indices(value[block].shape, np.float32).reshape(3, -1).T * _VOXEL_MM
        points[:, 0] += start * _VOXEL_MM
        points = (points + (origin - frame[:3, 3])) @ frame[:3, :3]
        distances = _distances(points, half, depth, behind, seed)
        nearest = distances.min(0)
        melt = np.exp(-_MELT_PER_MM * (distances - nearest))
        total = melt.sum(0)
        value[block] = np.maximum(nearest - np.log(total) / _MELT_PER_MM, _DEEPEST_MM).reshape(value[block].shape)
        colours[block] = np.rint(255 * (melt / total).T @ _TINTS).reshape(colours[block].shape)
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


def _distances(p: np.ndarray, half: float, depth: float, behind: float, seed: int) -> np.ndarray:
    """Distance (K, N), mm, roughly, from points (N, 3) in cavity axes to floor, wall and each organ."""
    radii = np.array([half, half, 0.5 * (depth + behind) + 30.0])
    wall = -_ellipsoid(p, np.array([0.0, 0.0, 0.5 * (depth - behind)]), radii, 0.0)
    distances = np.stack([depth - p[:, 2], wall, *_organs(p, depth, seed)])
    # Noise costs most of the time; away from the surface it would not be seen.
    near = np.abs(distances.min(0)) < _RELIEF_MM
    distances[:, near] += _relief(p[near], len(distances) - 2, seed)
    return distances


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
