"""Which frames are fused: those that show enough tissue as no frame before them showed it.

A video shows most tissue in tens of frames from the same place. Their depth errs alike, so their mean is no better than
one of them. A frame is fused where it shows tissue for the first time, from another side, from another distance or more
sharply, and then counts for the frames that were left out before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import transform

# The first three were chosen on frames of the real clips that were kept out of fusion, as the largest with which
# coverage, depth and SSIM of these stay (`scopemap evaluate --against-video`). Step between directions, unit vectors.
_DIRECTION_STEP = 0.05
# One of so many frames is fused even where the camera rests: light and tissue change, and pixels are masked.
_LONGEST_GAP = 4
_LEAST_NEW = 0.1  # see above: share of a frame's points that must be seen anew
_LOG_DISTANCE_STEP = np.log(1.25)  # by hand: between distances
_BLOCK_SHARE = 1 / 8  # by hand: edge of a block of tissue over its distance
_SHARPER = 1.5  # by hand: ratio of qualities from which on a frame is sharper
_STEP_PX = 8  # by hand, for time: between the pixels that are looked at
_SOME = (slice(_STEP_PX // 2, None, _STEP_PX),) * 2  # such pixels, from the middle of the first cell
_SLOTS = 1 << 16  # guard: memory; a viewing cell that is forgotten is fused again
# Large primes, by which the numbers of a viewing cell are mixed.
_FACTORS = np.array([73856093, 19349663, 83492791, 49979687, 86028121, 32452843, 67867967, 15485863])


class FrameSelector:
    """Chooses the frames that are fused, in order.

    A viewing cell is a block of tissue from one direction and distance. Blocks and steps grow with the distance, so
    that the choice does not depend on the scale. every : choose every n-th frame instead; 0: by viewing cells.
    """

    def __init__(self, every: int = 0) -> None:
        self._every, self._since = every, max(every - 1, 0)  # frames since the one that was chosen last
        self._cells, self._quality = np.zeros(_SLOTS, np.int64), np.zeros(_SLOTS, np.float32)

    def chosen(self, frame: Frame, world: int = 0) -> Frame | None:
        """Return a frame with depth and pose, weighted by how many it counts for; None where it is left out.

        world : number of the one that its pose is in.
        """
        self._since += 1
        if not self._every:
            cells = _viewing_cells(frame, world)
            slots = cells & (_SLOTS - 1)
            seen = (self._cells[slots] == cells) & (_SHARPER * self._quality[slots] >= frame.quality)
            if self._since < _LONGEST_GAP and np.count_nonzero(~seen) <= _LEAST_NEW * len(seen):
                return None
            self._cells[slots[~seen]], self._quality[slots[~seen]] = cells[~seen], frame.quality
        elif self._since < self._every:
            return None
        count, self._since = self._since, 0
        if self._every or count == 1:
            return frame
        return replace(frame, weight=np.full(frame.valid.shape, count, np.float32))

    def among(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield those of the frames of one world that are chosen."""
        return (chosen for frame in frames if (chosen := self.chosen(frame)) is not None)


def _viewing_cells(frame: Frame, world: int) -> np.ndarray:
    """Return the viewing cells (N,) int64 that some usable pixels of a frame show."""
    assert frame.depth_mm is not None
    assert frame.T_world_camera is not None
    depth_mm = np.asarray(frame.depth_mm)[_SOME]
    known = frame.valid[_SOME] & (depth_mm > 0)
    in_camera = frame.camera.rays[_SOME][known] * depth_mm[known, None]
    distance_mm = np.linalg.norm(in_camera, axis=1)
    points_mm = transform(frame.T_world_camera, in_camera)
    direction = (frame.T_world_camera[:3, 3] - points_mm) / distance_mm[:, None]
    step = np.floor(np.log(distance_mm) / _LOG_DISTANCE_STEP)
    edge_mm = _BLOCK_SHARE * np.exp(_LOG_DISTANCE_STEP * step)
    worlds = np.full(len(step), world)
    place = np.column_stack([points_mm / edge_mm[:, None], direction / _DIRECTION_STEP, step, worlds])
    with np.errstate(invalid="ignore"):  # of a pose that fusion refuses
        steps = np.floor(place).astype(np.int64)
    hashed = (steps * _FACTORS).sum(1)
    found: np.ndarray = hashed ^ (hashed >> 29)
    return found
