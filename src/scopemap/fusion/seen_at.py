"""The surface as seen at a time: where tissue moves, frames count the less the farther they are from it in time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.frame import Frame
from scopemap.fusion.moving import STEP_PX, MovingTissue, block_keys
from scopemap.geometry.se3 import inverse, transform
from scopemap.notices import Notice

_WINDOW_S = 0.5  # standard deviation of the weights
_CORNERS = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
_AROUND = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)


class _View(NamedTuple):
    """Usable depth of every n-th pixel of a frame, mm, NaN = unknown, its pose, and its distance from the time, s."""

    depth_mm: np.ndarray
    camera: PinholeCamera
    T_world_camera: np.ndarray
    gap_s: float


class SeenAt:
    """Weights of the pixels of frames for the surface as seen at a time.

    Blocks of space in which tissue moves, and those around them, are as in the frame next to that time in whose view
    they are, tissue or not: what moved away does not stay. All frames count alike elsewhere.
    """

    def __init__(self, frames: Iterable[Frame], at_s: float, edge_mm: float) -> None:
        """Look at all frames with pose and depth; at_s : time, s. edge_mm : of a block."""
        moving, views = MovingTissue(edge_mm), list[_View]()
        for frame in frames:
            if frame.T_world_camera is None or frame.depth_mm is None:
                continue
            depth_mm = np.where(frame.valid, frame.depth_mm, np.float32(np.nan))
            if frame.nonrigidity is not None:
                moving.put(depth_mm, frame.nonrigidity, frame.camera, frame.T_world_camera)
            some_mm = depth_mm[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX].astype(np.float32)
            views.append(_View(some_mm, frame.camera, frame.T_world_camera, abs(frame.time_s - at_s)))
        self._at_s, self._edge_mm = at_s, edge_mm
        blocks = moving.moving_blocks()
        blocks = np.unique((blocks[:, None] + _AROUND).reshape(-1, 3), axis=0)
        order = np.argsort(keys := block_keys(blocks))
        self._keys, blocks = keys[order], blocks[order]
        self._gap_s = np.full(len(blocks), np.inf)
        for view in views if len(blocks) else []:
            # A block at the border of a view is in it if one of its corners is.
            corners = (blocks[:, None] + _CORNERS).reshape(-1, 3) * edge_mm
            seen = self._in_view(corners, view).reshape(len(blocks), -1).any(1)
            self._gap_s[seen] = np.minimum(self._gap_s[seen], view.gap_s)

    @property
    def notice(self) -> Notice:
        """What was done."""
        where = f"{len(self._keys)} blocks of {self._edge_mm:.3g} mm" if len(self._keys) else "nowhere"
        return Notice("fusion-at-one-moment", {"second": self._at_s, "where": where})

    def weighted(self, frame: Frame) -> Frame:
        """Return a frame with depth and pose with the weights of its pixels."""
        assert frame.depth_mm is not None
        assert frame.T_world_camera is not None
        return replace(frame, weight=self._weights(frame.depth_mm, frame.camera, frame.T_world_camera, frame.time_s))

    def _weights(
        self, depth_mm: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray, time_s: float
    ) -> np.ndarray | None:
        """Return the weights of a frame's pixels, 0..1, (H, W) float32; None: all 1."""
        some_mm = depth_mm[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX]
        place, moves = self._blocks_of(some_mm, camera, T_world_camera)
        if not moves.any():
            return None
        later_s = np.maximum(abs(time_s - self._at_s) - self._gap_s[place], 0.0)
        weight = np.where(moves, np.exp(-0.5 * (later_s / _WINDOW_S) ** 2), 1.0).astype(np.float32)
        grown: np.ndarray = cv2.resize(weight, depth_mm.shape[::-1])
        return grown

    def _blocks_of(
        self, some_mm: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the places (h, w) of the blocks that every n-th pixel shows, and whether (h, w) they are such."""
        if not len(self._keys):
            return np.zeros(some_mm.shape, int), np.zeros(some_mm.shape, bool)
        rays = camera.rays[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX]
        points = transform(T_world_camera, (rays * some_mm[..., None]).reshape(-1, 3))
        known, keys = np.isfinite(points[:, 0]), np.full(len(points), -1, np.int64)
        keys[known] = block_keys(np.floor(points[known] / self._edge_mm))
        place = np.clip(np.searchsorted(self._keys, keys), 0, len(self._keys) - 1).reshape(some_mm.shape)
        return place, self._keys[place] == keys.reshape(some_mm.shape)

    def _in_view(self, points_mm: np.ndarray, view: _View) -> np.ndarray:
        """Return which points (N, 3) a frame sees, sees through, or has behind tissue that moves, (N,) bool.

        What was behind that is the same tissue at another time.
        """
        own = transform(inverse(view.T_world_camera), points_mm)
        height, width = view.depth_mm.shape
        with np.errstate(invalid="ignore", divide="ignore"):
            place = np.floor(view.camera.project(own) / STEP_PX)
        inside = (own[:, 2] > 0) & (place >= 0).all(1) & (place < [width, height]).all(1)
        column, row = np.where(inside[:, None], place, 0).astype(int).T
        _, moves = self._blocks_of(view.depth_mm, view.camera, view.T_world_camera)
        return inside & (moves[row, column] | (view.depth_mm[row, column] > own[:, 2] - self._edge_mm))
