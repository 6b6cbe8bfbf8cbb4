"""Polyps on the wall of a phantom: where they grow, the shape that they give it, which points are theirs.

A polyp is a body on the tangent plane of the wall; a flat one follows the wall. It is melted into the wall; its own are
the points that the wall without it has well in front of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scopemap.engine.cameras.camera import CameraModel
from scopemap.engine.errors import InputError
from scopemap_bench.phantom.march import Volume, march
from scopemap_bench.phantom.motion import REST
from scopemap_bench.phantom.spec import Polyp

_CROSS = 0.8
_RIM_MM = 0.25
_MELT_PER_MM = 4.0
_HEIGHT = {"sessile": 0.45, "flat": 0.0, "pedunculated": 1.1}  # of the diameter
# Half the height of a flat one, mm.
_FLAT_MM = 1.5
# Radius of a stalk, and of its head, over the diameter.
_STALK = 0.18
_STALK_MM = 1.0
_HEAD = 0.35
_BEHIND = 0.3
_BEHIND_MM = 2.0
_REDDER = np.array([1.0, 0.6, 0.6], np.float32)
# Where they grow: share of the picture's sides that stays free, and what the camera keeps away from them.
_MARGIN = 0.06
_LEAST_FACING = 0.5
_FARTHEST = 70
_AWAY_MM = 4.0
_BENT = 0.12


@dataclass(frozen=True)
class GrownPolyp:
    """A polyp, the point (3,) of the wall in its middle, and the rows (3, 3) along, across and away from the wall."""

    polyp: Polyp
    point_mm: np.ndarray
    axes: np.ndarray

    @property
    def height_mm(self) -> float:
        """How far it is meant to rise from the wall."""
        return max(_HEIGHT[self.polyp.kind] * self.polyp.diameter_mm, _FLAT_MM)

    @property
    def rim_mm(self) -> float:
        """How far from the wall it begins: a pedunculated one is its head."""
        head = self.polyp.kind == "pedunculated"
        return self.height_mm - 1.9 * _HEAD * self.polyp.diameter_mm if head else _RIM_MM

    @property
    def reach_mm(self) -> float:
        """Radius of the ball around its point that has all of it."""
        return 0.6 * self.polyp.diameter_mm + self.height_mm + 2.0

    def distance(self, points_mm: np.ndarray, from_wall_mm: np.ndarray) -> np.ndarray:
        """Return about the distance (N,), mm, negative inside, of points (N, 3), which are so far from the wall."""
        x, y, z = ((points_mm - self.point_mm) @ self.axes.T).T
        radius = 0.5 * self.polyp.diameter_mm
        thin = min(_CROSS * radius, self.height_mm)
        if self.polyp.kind == "flat":
            body = _rounded(x / radius, y / (_CROSS * radius), from_wall_mm / self.height_mm, True) * thin
        elif self.polyp.kind == "sessile":
            body = _rounded(x / radius, y / (_CROSS * radius), z / self.height_mm, False) * thin
        else:
            half = 2 * _HEAD * radius
            head = _rounded(x / radius, y / (_CROSS * radius), (z - self.height_mm + half) / half, False) * half
            stalk = np.hypot(x, y) - max(2 * _STALK * radius, _STALK_MM)
            body = np.minimum(head, np.maximum(stalk, z - self.height_mm + half))
        # The other side of a fold has none.
        return np.maximum(body, -z - max(_BEHIND_MM, 2 * _BEHIND * radius))


@dataclass(frozen=True)
class Polyps:
    """All polyps of a phantom, and its wall without them."""

    wall: Volume
    grown: tuple[GrownPolyp, ...]

    def heights(self, points_mm: np.ndarray) -> np.ndarray:
        """Return how far points (..., 3) are in front of the wall, mm; 0 away from the polyps."""
        flat = points_mm.reshape(-1, 3)
        height = np.zeros(len(flat))
        near = np.any([np.linalg.norm(flat - one.point_mm, axis=1) < one.reach_mm for one in self.grown], axis=0)
        height[near] = np.nan_to_num(self.wall.values_at(flat[near])[0])
        return height.reshape(points_mm.shape[:-1])

    def labels(self, points_mm: np.ndarray) -> np.ndarray:
        """Return whose points (..., 3) are, uint8: the number of a polyp, from 1; 0: the wall's."""
        nearest = np.argmin([np.linalg.norm(points_mm - one.point_mm, axis=-1) for one in self.grown], axis=0)
        rims = np.array([one.rim_mm for one in self.grown])
        return np.where(self.heights(points_mm) > rims[nearest], 1 + nearest, 0).astype(np.uint8)

    def tint(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the colour (..., 3) float32 by which that of the wall is multiplied."""
        share = np.clip(self.heights(points_mm) / (2 * _RIM_MM), 0, 1).astype(np.float32)[..., None]
        return 1 + share * (_REDDER - 1)


def grow(
    wall: Volume, polyps: tuple[Polyp, ...], poses: np.ndarray, camera: CameraModel, seed: int
) -> tuple[Volume, Polyps]:
    """Return the wall with polyps on it, each where its frame sees the wall well. Raises `InputError` where none does.

    poses : (N, 4, 4), which keep clear of them.
    """
    grown: list[GrownPolyp] = []
    for number, polyp in enumerate(polyps):
        rng = np.random.default_rng((seed, 8, number))
        pose = poses[min(polyp.frame, len(poses) - 1)]
        surface = march(wall, camera, pose, REST)
        towards = surface.rest_mm - pose[:3, 3]
        towards /= -np.linalg.norm(towards, axis=-1, keepdims=True)
        facing = ((surface.normal @ pose[:3, :3].T) * towards).sum(-1)
        span = 0.6 * polyp.diameter_mm * camera.central.fx / surface.depth_mm + _MARGIN * camera.width
        v, u = np.indices(span.shape)
        inside = np.minimum.reduce([u, v, camera.width - 1 - u, camera.height - 1 - v]) > span
        known = np.nan_to_num(surface.depth_mm, nan=np.inf)
        places = np.argwhere(inside & (facing > _LEAST_FACING) & (known < np.percentile(known, _FARTHEST)))
        for row, column in rng.permutation(places):
            normal = pose[:3, :3] @ surface.normal[row, column].astype(float)
            along = np.cross(normal, rng.normal(size=3))
            along /= np.linalg.norm(along)
            axes = np.stack([along, np.cross(normal, along), normal])
            one = GrownPolyp(polyp, surface.rest_mm[row, column].astype(float), axes)
            if _has_room(one, grown, poses) and _is_even(one, wall):
                grown.append(one)
                break
        else:
            raise InputError(f"no room for the polyp {number + 1}: name another frame than {polyp.frame}, or seed")
    return _with_polyps(wall, grown), Polyps(wall, tuple(grown))


def _has_room(one: GrownPolyp, others: list[GrownPolyp], poses: np.ndarray) -> bool:
    apart = all(np.linalg.norm(one.point_mm - o.point_mm) > one.reach_mm + o.reach_mm for o in others)
    middle = one.point_mm + 0.5 * one.height_mm * one.axes[2]
    clear = 0.6 * max(one.polyp.diameter_mm, one.height_mm) + _AWAY_MM
    return apart and float(np.linalg.norm(poses[:, :3, 3] - middle, axis=1).min()) > clear


def _is_even(one: GrownPolyp, wall: Volume) -> bool:
    """Whether the wall is, in front of the polyp's place, as far away as it should be: it is not bent much there."""
    heights = np.array([0.5, 1.0]) * max(one.height_mm, 0.25 * one.polyp.diameter_mm)
    found = wall.values_at(one.point_mm + heights[:, None] * one.axes[2])[0]
    return bool((np.abs(found / heights - 1) < _BENT).all())


def _with_polyps(wall: Volume, grown: list[GrownPolyp]) -> Volume:
    value = wall.coefficients.copy()
    for one in grown:
        low = np.floor((one.point_mm - one.reach_mm - wall.origin_mm) / wall.voxel_mm).astype(int).clip(0)
        high = np.ceil((one.point_mm + one.reach_mm - wall.origin_mm) / wall.voxel_mm).astype(int) + 1
        block = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        before = value[block]
        points = (np.indices(before.shape).reshape(3, -1).T + low) * wall.voxel_mm + wall.origin_mm
        body = one.distance(points, before.ravel()).reshape(before.shape)
        value[block] = -np.logaddexp(-_MELT_PER_MM * before, -_MELT_PER_MM * body) / _MELT_PER_MM
    return replace(wall, coefficients=value)


def _rounded(x: np.ndarray, y: np.ndarray, z: np.ndarray, steep: bool) -> np.ndarray:
    """Return the distance from a ball of radius 1, or from a disc with a steep rim."""
    round_xy = np.hypot(x, y)
    return np.asarray((round_xy**4 + z**4) ** 0.25 if steep else np.hypot(round_xy, z)) - 1
