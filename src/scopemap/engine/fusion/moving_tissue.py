"""Where in the world tissue moves on its own, in blocks of space; weights of frames for the surface at a time."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Frame, Rows
from scopemap.engine.fusion.tsdf import pack, unpack
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.notices import Notice
from scopemap.engine.tracking.track import MOVING_SIGMAS

_STEP_PX = 8  # by hand: between the pixels that are used
_SOME = (slice(_STEP_PX // 2, None, _STEP_PX),) * 2  # such pixels, from the middle of the first cell
_SEEN = np.dtype([("key", np.int64), ("seen", np.int64), ("moving", np.int64)])
_EDGE_SHARE = 0.13  # by hand: edge of a block over the clip's median depth
_MOST_ROWS = 1_000_000  # guard: memory; rows are summed up above
_LEAST_FRAMES = 3  # by hand: in which a block moves
_LEAST_SHARE = 0.05  # by hand: of the frames that see a block
_WINDOW_S = 0.5  # by hand: standard deviation of the weights
_CORNERS = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)  # of a block
_AROUND = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)  # a block and its 26 neighbours


def block_edge_mm(median_depth_mm: float | None) -> float:
    """Return the edge of blocks that suits a scene: larger than errors of depth, smaller than regions of pictures."""
    return _EDGE_SHARE * (median_depth_mm or 1.0)


class MovingTissue:
    """Counts in which frames blocks of space, `edge_mm` wide, are seen, and in which their tissue moves."""

    def __init__(self, edge_mm: float) -> None:
        self._edge_mm = edge_mm
        self._rows = Rows(_SEEN)

    def put(
        self, depth_mm: np.ndarray, nonrigidity: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray
    ) -> None:
        """Count a frame, by its depth (H, W), NaN = unknown or not usable, and its `Frame.nonrigidity`."""
        regions = (
            np.arange(side) * count // side for side, count in zip(depth_mm.shape, nonrigidity.shape, strict=True)
        )
        depth_mm, sigmas = depth_mm[_SOME], nonrigidity[np.ix_(*regions)][_SOME]
        known = (depth_mm > 0) & np.isfinite(sigmas)
        points = transform(T_world_camera, camera.rays[_SOME][known] * depth_mm[known, None])
        keys, place = np.unique(_block_keys(np.floor(points / self._edge_mm)), return_inverse=True)
        seen = np.bincount(place, minlength=len(keys))
        moving = np.bincount(place, sigmas[known] > MOVING_SIGMAS, len(keys))
        rows = np.zeros(len(keys), _SEEN)
        rows["key"], rows["seen"], rows["moving"] = keys, 1, 2 * moving >= seen
        self._rows.append(rows)
        if len(self._rows) > _MOST_ROWS:
            counted = self._counted()
            self._rows = Rows(_SEEN)
            self._rows.append(counted)

    def shares(self, points_mm: np.ndarray) -> np.ndarray:
        """Return in which share of the frames that see them points (N, 3), world mm, move, (N,); 0: not measured."""
        rows = self._counted()
        if not len(rows):
            return np.zeros(len(points_mm))
        place = np.asarray(points_mm) / self._edge_mm - 0.5
        low = np.floor(place)
        total, weights = np.zeros(len(place)), np.zeros(len(place))
        for corner in _CORNERS:
            found, known = _found(rows["key"], _block_keys(low + corner))
            weight = np.abs(1 - corner - (place - low)).prod(1) * known
            total += weight * rows["moving"][found] / rows["seen"][found]
            weights += weight
        shares: np.ndarray = total / np.maximum(weights, 1e-9)
        return shares

    def moving_blocks(self) -> np.ndarray:
        """Return the blocks (B, 3) int64 whose tissue moves in more frames than by chance, whole numbers of edges."""
        rows = self._counted()
        often = (rows["moving"] >= _LEAST_FRAMES) & (rows["moving"] >= _LEAST_SHARE * rows["seen"])
        return unpack(rows["key"][often])

    def _counted(self) -> np.ndarray:
        """Return one row for each block, by key."""
        rows = self._rows.read()
        keys, place = np.unique(rows["key"], return_inverse=True)
        counted = np.zeros(len(keys), _SEEN)
        counted["key"] = keys
        for name in ("seen", "moving"):
            counted[name] = np.bincount(place, rows[name], len(keys))
        return counted


class _View(NamedTuple):
    """Usable depth of some pixels of a frame, mm, NaN = unknown, its pose, and its distance from the time, s."""

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
            some_mm = depth_mm[_SOME].astype(np.float32)
            views.append(_View(some_mm, frame.camera, frame.T_world_camera, abs(frame.time_s - at_s)))
        self._at_s, self._edge_mm = at_s, edge_mm
        blocks = np.unique((moving.moving_blocks()[:, None] + _AROUND).reshape(-1, 3), axis=0)
        order = np.argsort(keys := _block_keys(blocks))
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

    def fused(self, frame: Frame) -> Frame:
        """Return a frame with depth and pose, its pixels (H, W) weighted by 0..1 where tissue moves."""
        assert frame.depth_mm is not None
        assert frame.T_world_camera is not None
        place, moves = self._blocks_of(frame.depth_mm[_SOME], frame.camera, frame.T_world_camera)
        if not moves.any():
            return frame
        later_s = np.maximum(abs(frame.time_s - self._at_s) - self._gap_s[place], 0.0)
        weight = np.where(moves, np.exp(-0.5 * (later_s / _WINDOW_S) ** 2), 1.0).astype(np.float32)
        of_pixels = cv2.resize(weight, frame.depth_mm.shape[::-1])
        return replace(frame, weight=of_pixels if frame.weight is None else of_pixels * frame.weight)

    def _blocks_of(
        self, some_mm: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the places (h, w) of the blocks that some pixels show, and whether (h, w) they are such."""
        if not len(self._keys):
            return np.zeros(some_mm.shape, int), np.zeros(some_mm.shape, bool)
        points = transform(T_world_camera, (camera.rays[_SOME] * some_mm[..., None]).reshape(-1, 3))
        known, keys = np.isfinite(points[:, 0]), np.full(len(points), -1, np.int64)
        keys[known] = _block_keys(np.floor(points[known] / self._edge_mm))
        return _found(self._keys, keys.reshape(some_mm.shape))

    def _in_view(self, points_mm: np.ndarray, view: _View) -> np.ndarray:
        """Return which points (N, 3) a frame sees, sees through, or has behind tissue that moves, (N,) bool."""
        in_camera = transform(inverse(view.T_world_camera), points_mm)
        height, width = view.depth_mm.shape
        with np.errstate(invalid="ignore", divide="ignore"):
            place = np.floor(view.camera.project(in_camera) / _STEP_PX)
        inside = (in_camera[:, 2] > 0) & (place >= 0).all(1) & (place < [width, height]).all(1)
        column, row = np.where(inside[:, None], place, 0).astype(int).T
        _, moves = self._blocks_of(view.depth_mm, view.camera, view.T_world_camera)
        return inside & (moves[row, column] | (view.depth_mm[row, column] > in_camera[:, 2] - self._edge_mm))


def _found(known: np.ndarray, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of keys among known ones, sorted, at least one, and which of them are known."""
    place = np.clip(np.searchsorted(known, keys), 0, len(known) - 1)
    return place, known[place] == keys


def _block_keys(blocks: np.ndarray) -> np.ndarray:
    """Return the keys (N,) int64 of blocks (N, 3)."""
    x, y, z = np.ascontiguousarray(blocks, np.int64).T
    return np.asarray(pack.py_func(x, y, z))
