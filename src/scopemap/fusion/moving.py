"""Where in the world tissue moves on its own: blocks of space with the frames that see them, and see them move."""

from __future__ import annotations

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.frame import Rows
from scopemap.fusion.tsdf import pack, unpack
from scopemap.geometry.se3 import transform
from scopemap.tracking.track import MOVING_SIGMAS

STEP_PX = 8
"""Between the pixels that are looked at."""

_SEEN = np.dtype([("key", np.int64), ("seen", np.int64), ("moving", np.int64)])
_EDGE_SHARE = 0.13
_MOST_ROWS = 1_000_000
_LEAST_FRAMES, _LEAST_SHARE = 3, 0.05  # in which a block moves
_NEIGHBOURS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)


def block_edge_mm(median_depth_mm: float | None) -> float:
    """Return the edge of blocks that suits a scene: larger than errors of depth, smaller than regions of pictures."""
    return _EDGE_SHARE * (median_depth_mm or 1.0)


class MovingTissue:
    """Counts in which frames blocks of space are seen, and in which their tissue moves, by `Frame.nonrigidity`.

    edge_mm : of a block.
    """

    def __init__(self, edge_mm: float) -> None:
        self._edge_mm = edge_mm
        self._rows = Rows(_SEEN)

    def put(
        self, depth_mm: np.ndarray, nonrigidity: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray
    ) -> None:
        """Count a frame, by its depth (H, W), NaN = unknown or not usable, and its `Frame.nonrigidity`."""
        some = (slice(STEP_PX // 2, None, STEP_PX),) * 2
        depth_mm, sigmas = depth_mm[some], _at_pixels(nonrigidity, depth_mm.shape)[some]
        known = (depth_mm > 0) & np.isfinite(sigmas)
        points = transform(T_world_camera, camera.rays[some][known] * depth_mm[known, None])
        keys, place = np.unique(block_keys(np.floor(points / self._edge_mm)), return_inverse=True)
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
        """Return in which share of the frames that see them points (N, 3), world mm, move, (N,) float64.

        Interpolated between the middles of blocks; 0 where nothing was measured.
        """
        rows = self._counted()
        if not len(rows):
            return np.zeros(len(points_mm))
        place = np.asarray(points_mm) / self._edge_mm - 0.5
        low = np.floor(place)
        total, weights = np.zeros(len(place)), np.zeros(len(place))
        for corner in _NEIGHBOURS:
            keys = block_keys(low + corner)
            found = np.clip(np.searchsorted(rows["key"], keys), 0, len(rows) - 1)
            weight = np.abs(1 - corner - (place - low)).prod(1) * (rows["key"][found] == keys)
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


def _at_pixels(nonrigidity: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the value of each pixel's region, of this shape (H, W)."""
    places = (np.arange(side) * count // side for side, count in zip(shape, nonrigidity.shape, strict=True))
    return nonrigidity[np.ix_(*places)]


def block_keys(blocks: np.ndarray) -> np.ndarray:
    """Return the keys (N,) int64 of blocks (N, 3)."""
    x, y, z = np.ascontiguousarray(blocks, np.int64).T
    return np.asarray(pack.py_func(x, y, z))
