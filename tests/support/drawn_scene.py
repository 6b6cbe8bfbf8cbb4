"""A wavy wall before a camera that moves and turns: what a data set is to hold, apart from how it stores it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.cameras.camera import CameraModel
from scopemap.engine.geometry.se3 import se3_exp
from tests.support.drawn_inputs import picture

COUNT = 7
RATE_HZ = 25
DISTANCE_MM, DEEP_MM = 45.0, 2.5
STEP = np.array([0.008, -0.012, 0.02, 0.5, -0.4, 1.0])
Damage = Callable[[bytes], bytes]


@dataclass
class Content:
    """What a copy holds, by frame number; a planted fault changes it, or damages what is stored of it.

    camera : of pictures and depth. rgb : (h, w, 3) uint8. poses : camera to world, mm, NaN = stored as
    NaN. depth_mm : (h, w). times_s : time stamps. depth_unit_mm : mm per unit of depth files. shallow : frames whose
    depth is stored with 8 bit. own : another camera, and mm per unit of depth files. *_damage : what happens to a
    stored picture, to the file that holds all pictures, and to a depth map. names_again : frames whose number a second
    picture carries, too.
    """

    camera: CameraModel
    rgb: dict[int, np.ndarray]
    poses: dict[int, np.ndarray]
    depth_mm: dict[int, np.ndarray]
    times_s: dict[int, float]
    depth_unit_mm: float = 1.0
    shallow: set[int] = field(default_factory=set)
    own: tuple[CameraModel, float | None] | None = None
    rgb_damage: dict[int, Damage] = field(default_factory=dict)
    stream_damage: Damage | None = None
    depth_damage: dict[int, Damage] = field(default_factory=dict)
    names_again: list[int] = field(default_factory=list)

    @property
    def numbers(self) -> list[int]:
        return sorted(self.rgb)


def content(camera: CameraModel, scale: float, depth_unit_mm: float) -> Content:
    """The scene, `scale` times as large."""
    poses = {number: se3_exp(STEP * number) for number in range(COUNT)}
    depth_mm = {number: scale * seen_depth_mm(pose, camera) for number, pose in poses.items()}
    for pose in poses.values():
        pose[:3, 3] *= scale
    rgb = {number: picture(number, (camera.width, camera.height)) for number in poses}
    times_s = {number: number / RATE_HZ for number in poses}
    return Content(camera, rgb, poses, depth_mm, times_s, depth_unit_mm)


def seen_depth_mm(T_world_camera: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Depth (h, w) of the wall along the camera's axis; 0 where the lens sees nothing."""
    rays = _rays(camera) @ T_world_camera[:3, :3].T
    depth_mm = np.full(rays.shape[:2], DISTANCE_MM)
    for _ in range(20):
        x, y, _ = np.moveaxis(T_world_camera[:3, 3] + depth_mm[..., None] * rays, -1, 0)
        wall_mm = DISTANCE_MM + 0.15 * x - 0.1 * y + DEEP_MM * np.sin(x / 9) * np.cos(y / 8)
        depth_mm = 0.5 * depth_mm + 0.5 * (wall_mm - T_world_camera[2, 3]) / rays[..., 2]
    return np.where(np.isfinite(depth_mm) & (depth_mm > 0) & (depth_mm < 2 * DISTANCE_MM), depth_mm, 0)


@cache
def _rays(camera: CameraModel) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.unproject(np.stack([u, v], -1).astype(float))


def quaternion(T: np.ndarray) -> np.ndarray:
    """Scalar last; NaN for NaN, and zeros for what is no rotation, which quaternions cannot say."""
    if not np.isfinite(T).all():
        return np.full(4, np.nan)
    return Rotation.from_matrix(T[:3, :3]).as_quat() if np.linalg.det(T[:3, :3]) > 0 else np.zeros(4)
