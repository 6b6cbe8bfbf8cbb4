"""Frames with exact depth of spheres and planes."""

from __future__ import annotations

from typing import Any

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import FusionSettings
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import se3, so3_exp

WIDE = PinholeCamera(46.0, 47.0, 59.3, 60.2, 120, 121)
VIEW = PinholeCamera(150.0, 150.0, 79.5, 59.5, 160, 120)
GREY = (120, 110, 100)


def lenient(**changes: Any) -> FusionSettings:
    """Settings of fusion with which one frame makes a surface."""
    return FusionSettings(voxel_mm=1.0, truncation_mm=5.0, max_depth_mm=150.0, **changes)


LENIENT = lenient()
AHEAD = np.array([0.0, 0.0, 1.0])


def _rays(camera: PinholeCamera, T: np.ndarray) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.unproject(np.stack([u, v], -1)) @ T[:3, :3].T


def frame_of(camera: PinholeCamera, T: np.ndarray, depth_mm: np.ndarray, rgb: np.ndarray | tuple = GREY) -> Frame:
    picture = np.broadcast_to(np.asarray(rgb, np.uint8), (*depth_mm.shape, 3))
    return Frame(0, 0.0, picture, camera, np.ones(depth_mm.shape, bool), depth_mm.astype(np.float32), T)


def sphere_frame(T: np.ndarray, radius_mm: float, centre_mm: np.ndarray | None = None) -> Frame:
    """See a sphere from inside: the far root of the ray's quadratic."""
    rays, origin = _rays(WIDE, T), T[:3, 3] - (np.zeros(3) if centre_mm is None else centre_mm)
    a, b, c = (rays**2).sum(-1), rays @ origin, origin @ origin - radius_mm**2
    return frame_of(WIDE, T, (np.sqrt(b * b - a * c) - b) / a)


def plane_frame(normal: np.ndarray, offset_mm: float) -> Frame:
    """See the plane normal . X = offset."""
    T = np.eye(4)
    depth = offset_mm / (_rays(VIEW, T) @ normal)
    return frame_of(VIEW, T, np.where(depth > 0, depth, np.nan))


def all_around(centre_mm: np.ndarray | None = None) -> list[np.ndarray]:
    """Twelve poses near the centre: the six directions of the cube, twice, from different places."""
    rng = np.random.default_rng(5)
    turns = [(0, k * np.pi / 2, 0) for k in range(4)] + [(np.pi / 2, 0, 0), (-np.pi / 2, 0, 0)]
    centre = np.zeros(3) if centre_mm is None else centre_mm
    return [
        se3(so3_exp(np.array(turn) + rng.normal(0, 0.05, 3)), centre + rng.uniform(-4.0, 4.0, 3)) for turn in turns * 2
    ]
