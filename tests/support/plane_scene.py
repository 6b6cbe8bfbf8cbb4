"""A textured plane at z = 50 mm of the world, seen by any camera pose: picture, depth and flow in closed form."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, se3, so3_exp, transform
from scopemap.engine.mapping import Backend, FrameCorrection
from scopemap.engine.mapping.segments import Segment

CAMERA = PinholeCamera(150.0, 150.0, 119.5, 89.5, 240, 180)
PLANE_MM = 50.0
# At this distance 2 mm are exactly 6 px.
SIX_PIXELS_MM = 2.0
EVERYWHERE = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
_TEXELS_PER_MM = 3.0
_TEXTURE = 600


@dataclass(frozen=True)
class PlaneImage:
    """What one pose sees: rgb (H, W, 3) uint8, depth (H, W) float32 mm."""

    rgb: np.ndarray
    depth_mm: np.ndarray
    T_world_camera: np.ndarray


def pose(
    *, at_mm: tuple[float, float, float] = (0.0, 0.0, 0.0), turn_rad: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    return se3(so3_exp(np.array(turn_rad)), np.array(at_mm))


def see(T_world_camera: np.ndarray) -> PlaneImage:
    rays = CAMERA.rays.astype(np.float64) @ T_world_camera[:3, :3].T
    depth = (PLANE_MM - T_world_camera[2, 3]) / rays[..., 2]
    on_plane = T_world_camera[:3, 3] + depth[..., None] * rays
    texel = (on_plane[..., :2] * _TEXELS_PER_MM + _TEXTURE / 2).astype(np.float32)
    rgb = cv2.remap(_texture(), texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return PlaneImage(rgb, depth.astype(np.float32), T_world_camera)


def true_flow(view: PlaneImage, other: PlaneImage) -> np.ndarray:
    """Where each pixel of `view` is seen in `other`, minus the pixel: (H, W, 2) float32."""
    T_other_camera = inverse(other.T_world_camera) @ view.T_world_camera
    points = transform(T_other_camera, CAMERA.rays.astype(np.float64) * view.depth_mm[..., None])
    return (CAMERA.project(points) - CAMERA.project(CAMERA.rays)).astype(np.float32)


@cache
def _texture() -> np.ndarray:
    noise = np.random.default_rng(7).normal(size=(_TEXTURE, _TEXTURE, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def frame(
    T_world_camera: np.ndarray, index: int = 0, T_tracked: np.ndarray | None = None, factor: float = 1.0
) -> Frame:
    """The view from a pose, tracked at `T_tracked`, None: there; its depth times `factor`."""
    view = see(T_world_camera)
    depth_mm = (factor * view.depth_mm).astype(np.float32)
    T = T_world_camera if T_tracked is None else T_tracked
    return Frame(index, index / 30, view.rgb, CAMERA, EVERYWHERE, depth_mm, T)


def only(segments: list[Segment]) -> FrameCorrection:
    """The correction of the only segment: one scene explains all keyframes, or the map is too short to be divided."""
    (segment,) = segments
    assert segment.correction is not None
    return segment.correction


def adjusted(frames: Iterable[Frame], settings: MappingSettings | None = None) -> FrameCorrection:
    """The back end's correction of keyframes, tracked one after the other."""
    backend = Backend(settings or MappingSettings(), DisFlow())
    for keyframe in frames:
        backend.add(keyframe)
    return only(backend.adjust())
