"""Frames in the state of the surface: what each saw of moving tissue, moved to where that is in one state of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.mapping.tissue_states import TissueStates
from scopemap.engine.notices import Notice

_STEP_PX = 8  # by hand: between the pixels whose motion is computed
_SEARCHES = 4  # by hand: fixed-point steps by which a place is found
_FOUND_PX = 1.0  # by hand: a place that is not found so well is behind an edge of depth


@dataclass(frozen=True)
class SurfaceState:
    """The state of moving tissue in which its frames are fused."""

    states: TissueStates

    @property
    def notice(self) -> Notice:
        """Which state it is."""
        return Notice("fusion-in-one-state", {"second": self.states.reference_s})

    def fused(self, frame: Frame) -> Frame:
        """Return a frame as it is fused."""
        return in_surface_state(frame, self.states)


def in_surface_state(frame: Frame, states: TissueStates) -> Frame:
    """Return a frame with depth and pose as its camera would have seen the tissue in the state of the surface.

    Picture, depth and masks are moved; what comes into view by that is not usable. Depth edges are moved as they are.
    """
    assert frame.depth_mm is not None
    assert frame.T_world_camera is not None
    depth_mm, known = np.asarray(frame.depth_mm, np.float32), frame.depth_mm > 0
    if not known.any() or not states.change(frame.index).any():
        return frame
    rays, size = frame.camera.rays, depth_mm.shape[::-1]
    filled_mm = np.where(known, depth_mm, np.float32(np.median(depth_mm[known])))
    moved = rays * filled_mm[..., None] - cv2.resize(_motion(frame, filled_mm, states), size)
    ahead = moved[..., 2] > 0
    moved[~ahead] = (0, 0, 1)
    pixel = np.stack(np.meshgrid(*map(np.arange, size)), -1).astype(np.float32)
    flow = frame.camera.project(moved).astype(np.float32) - pixel
    source = pixel
    for _ in range(_SEARCHES):
        source = pixel - _sampled(flow, source)
    found = np.linalg.norm(source + _sampled(flow, source) - pixel, axis=-1) < _FOUND_PX
    usable = known & ahead

    def mask(values: np.ndarray) -> np.ndarray:
        return found & (_sampled(values.astype(np.float32), source) > 0.5)

    changed: dict[str, Any] = {}
    for name in ("highlights", "instruments", "depth_sigma_mm", "weight"):
        if (values := getattr(frame, name)) is not None:
            changed[name] = mask(values) if values.dtype == bool else _sampled(values, source)
    moved_mm = _sampled(moved[..., 2].astype(np.float32), source)
    changed |= {"depth_mm": np.where(mask(usable), moved_mm, np.float32(np.nan)), "valid": mask(frame.valid & usable)}
    return replace(frame, rgb=_sampled(frame.rgb, source), **changed)


def _motion(frame: Frame, filled_mm: np.ndarray, states: TissueStates) -> np.ndarray:
    """Return the motion (h, w, 3) float32, mm, in the camera, from the surface's state to a frame's, of some pixels."""
    assert frame.T_world_camera is not None
    some = (slice(_STEP_PX // 2, None, _STEP_PX),) * 2
    points, change = (frame.camera.rays[some] * filled_mm[some][..., None]).reshape(-1, 3), states.change(frame.index)
    seen = transform(frame.T_world_camera, points)
    # The motion is known where tissue is in the surface's state, and the frame has its places after it.
    motion = np.tensordot(change, states.motion(seen), 1)
    motion = np.tensordot(change, states.motion(seen - motion), 1) @ inverse(frame.T_world_camera)[:3, :3].T
    return motion.reshape(*filled_mm[some].shape, 3).astype(np.float32)


def _sampled(values: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Return values (H, W, ...) at pixels (H, W, 2), interpolated; beyond the border those at it."""
    x, y = np.ascontiguousarray(pixel[..., 0]), np.ascontiguousarray(pixel[..., 1])
    found: np.ndarray = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found
