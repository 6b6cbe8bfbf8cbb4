"""Where in the world tissue moves on its own, in blocks of space."""

from __future__ import annotations

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Rows
from scopemap.engine.fusion.tsdf import pack
from scopemap.engine.geometry.se3 import transform
from scopemap.engine.tracking.track import MOVING_SIGMAS

_STEP_PX = 8  # by hand: between the pixels that are used
_SOME = (slice(_STEP_PX // 2, None, _STEP_PX),) * 2  # such pixels, from the middle of the first cell
_SEEN = np.dtype([("key", np.int64), ("seen", np.int64), ("moving", np.int64)])
_EDGE_SHARE = 0.13  # by hand: edge of a block over the clip's median depth
_MOST_ROWS = 200_000  # guard: memory; rows are summed up above. A million took 45 MB more, and as long
_CORNERS = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)  # of a block


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

    def _counted(self) -> np.ndarray:
        """Return one row for each block, by key."""
        rows = self._rows.read()
        keys, place = np.unique(rows["key"], return_inverse=True)
        counted = np.zeros(len(keys), _SEEN)
        counted["key"] = keys
        for name in ("seen", "moving"):
            counted[name] = np.bincount(place, rows[name], len(keys))
        return counted


def _found(known: np.ndarray, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of keys among known ones, sorted, at least one, and which of them are known."""
    place = np.clip(np.searchsorted(known, keys), 0, len(known) - 1)
    return place, known[place] == keys


def _block_keys(blocks: np.ndarray) -> np.ndarray:
    """Return the keys (N,) int64 of blocks (N, 3)."""
    x, y, z = np.ascontiguousarray(blocks, np.int64).T
    return np.asarray(pack.py_func(x, y, z))
