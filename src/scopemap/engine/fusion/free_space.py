"""Free-space evidence: what other frames look through is no tissue, and is not fused.

An instrument is in front of tissue that earlier and later frames see. The points of a frame are projected into frames
around, as in space carving (Kutulakos and Seitz, IJCV 2000): a frame confirms a point where its depth is that of the
point, contradicts it where its depth is clearly larger, and tells nothing where the point is hidden.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.kernels import Float32_2d, Float32_3d, Float64_2d, inner_kernel, kernel
from scopemap.engine.geometry.median import median
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.notices import Notice

_MOST_REFERENCES = 256  # by hand: 50 KB each
_FEW_REFERENCES = 16  # by hand: of a short clip
_FRAMES_PER_REFERENCE = 4  # by hand: one frame of so many is a reference
_CELLS = 64  # by hand: along the longer side of the picture: one pixel of each cell is looked at
_ASKED = 16  # by hand: references that a frame is compared with, spread over those that show a third of its points
_SHARE = 1 / 3  # by hand: of the frame's points, and of the references that see a point
_LEAST_REFERENCES = 2  # by hand: never on the word of one
# Share of the depth by which a reference is farther that looks through a point, at least; and in robust standard
# deviations of what frame and reference differ by.
_TOLERANCE = 0.05  # by hand
_SIGMAS = 3.0  # three standard deviations: 0.3 % of Gaussian errors
# A region is left out that has so many points which at least half of the references contradict by twice that.
_LEAST_POINTS = 8  # by hand
_CERTAIN = 2.0  # by hand
# Difference of colour to the references from which on something else is there, and over that of the frame's median
# point: tissue that moved has its colour.
_OTHER_COLOUR = 0.3  # by hand
_TIMES_USUAL = 5.0  # by hand
_DARK = 8.0  # by hand: grey levels, up to which colours are noise
_SOME_POINTS = 40  # by hand: one of so many tells whether a reference sees a frame's points
_SOME_RATIOS = 8  # by hand: and what frame and reference differ by
_AROUND = np.ones((3, 3), np.uint8)  # a pixel and its eight neighbours


class _CoarseFrame(NamedTuple):
    """Smallest and largest depth around each cell of a frame, (h, w) float32, mm, 0: unknown; its number and matrix.

    colour : (h, w, 2) float32, as `_colour`. P : (3, 4), takes a point of the world, mm, to its place in cells times
    its depth, and that depth.
    """

    number: int
    nearest_mm: Float32_2d
    farthest_mm: Float32_2d
    colour: Float32_3d
    P: Float64_2d


def reference_frames(indices: Sequence[int]) -> list[int]:
    """Return the numbers of frames, spread over those of a submap, that tell what other frames look through."""
    count = min(len(indices), max(len(indices) // _FRAMES_PER_REFERENCE, _FEW_REFERENCES), _MOST_REFERENCES)
    return [indices[place] for place in np.linspace(0, len(indices) - 1, count).astype(int)]


class FreeSpace:
    """Leaves out what other frames of the same submap look through.

    references : some of these frames, with depth and pose; `reference_frames` chooses them.
    """

    def __init__(self, references: Iterable[Frame]) -> None:
        self._references = [_coarse(frame) for frame in references if frame.T_world_camera is not None]
        self._P = np.array([reference.P for reference in self._references]).reshape(-1, 3, 4)
        self._frames, self._left_out, self._pixels = 0, 0, 0

    @property
    def notice(self) -> Notice | None:
        """In how many frames so far something was left out, and how much of them; None: nowhere."""
        if not self._frames:
            return None
        return Notice("fusion-free-space", {"frames": self._frames, "share": self._left_out / self._pixels})

    def without(self, frame: Frame) -> Frame:
        """Return a frame with depth and pose whose usable pixels and highlights lack what others look through.

        Pixels next to such a region, and to instruments that the depth network found, go with it. Without references,
        none.
        """
        if not self._references:
            return frame
        self._pixels += int(np.count_nonzero(frame.valid))
        found = self._looked_through(frame)
        if not found.any():
            return frame
        step_px = _step_px(frame.valid.shape)
        height, width = frame.valid.shape
        row, column = np.arange(height) // step_px, np.arange(width) // step_px
        left_out = found[np.minimum(row, len(found) - 1)][:, np.minimum(column, found.shape[1] - 1)]
        self._frames, self._left_out = self._frames + 1, self._left_out + int(np.count_nonzero(frame.valid & left_out))
        highlights = None if frame.highlights is None else frame.highlights & ~left_out
        return replace(frame, valid=frame.valid & ~left_out, highlights=highlights)

    def _looked_through(self, frame: Frame) -> np.ndarray:
        """Return the cells (h, w) bool of instruments and of what others look through, and the blurred ones around."""
        assert frame.depth_mm is not None
        assert frame.T_world_camera is not None
        some = _centres(frame.valid.shape)
        shown = frame.valid[some] if frame.highlights is None else (frame.valid | frame.highlights)[some]
        depth_mm = np.where(shown, np.asarray(frame.depth_mm)[some], np.nan)
        known = depth_mm > 0
        points_mm = transform(frame.T_world_camera, frame.camera.rays[some][known] * depth_mm[known, None])
        colour = _colour(frame)[known]
        counts = np.zeros((len(points_mm), 4))
        for reference in self._asked(frame.index, points_mm):
            _count(points_mm, colour, reference, counts)
        seen, contradict, clearly, difference = counts.T
        difference /= np.maximum(seen, 1)
        usual = np.median(difference[seen > 0]) if seen.any() else 0.0
        other_colour = difference >= max(_OTHER_COLOUR, _TIMES_USUAL * usual)
        region, certain = np.zeros(known.shape, np.uint8), np.zeros(known.shape, bool)
        region[known] = other_colour | ((contradict >= _LEAST_REFERENCES) & (contradict >= _SHARE * seen))
        certain[known] = other_colour & (clearly >= _LEAST_REFERENCES) & (2 * clearly >= seen)
        if frame.instruments is not None:
            region, certain = region | frame.instruments[some], certain | frame.instruments[some]
        count, labels = cv2.connectedComponents(region)
        kept = np.bincount(labels[certain], minlength=count) >= _LEAST_POINTS
        kept[0] = False
        closed = cv2.morphologyEx(kept[labels].astype(np.uint8), cv2.MORPH_CLOSE, _AROUND)
        return cv2.dilate(closed, _AROUND) > 0

    def _asked(self, index: int, points_mm: np.ndarray) -> list[_CoarseFrame]:
        """Return the references to compare a frame with, whose points are (N, 3) mm, world."""
        if not len(points_mm):
            return []
        some = points_mm[::_SOME_POINTS]
        column, row, z = np.moveaxis(self._P[:, :, :3] @ some.T + self._P[:, :, 3:], 1, 0)
        shapes = np.array([reference.nearest_mm.shape for reference in self._references])[:, :, None]
        inside = (z > 0) & (column >= 0) & (row >= 0) & (column < shapes[:, 1] * z) & (row < shapes[:, 0] * z)
        sees = np.flatnonzero(inside.mean(1) >= _SHARE).tolist()
        others = [self._references[place] for place in sees if self._references[place].number != index]
        return others if len(others) <= _ASKED else [others[n * len(others) // _ASKED] for n in range(_ASKED)]


def _coarse(frame: Frame) -> _CoarseFrame:
    assert frame.depth_mm is not None
    assert frame.T_world_camera is not None
    step_px, some = _step_px(frame.valid.shape), _centres(frame.valid.shape)
    depth_mm = np.where(frame.valid & (frame.depth_mm > 0), frame.depth_mm, np.float32(np.nan))
    # The cells around, too: a pose that is off by some pixels must not look past the edge of a fold.
    around, known = np.ones((3 * step_px, 3 * step_px), np.uint8), np.isfinite(depth_mm)
    nearest = cv2.erode(np.where(known, depth_mm, np.float32(np.inf)), around)[some]
    farthest = cv2.dilate(np.where(known, depth_mm, np.float32(0)), around)[some]
    camera = frame.camera
    place = np.array([[camera.fx, 0, camera.cx + 0.5], [0, camera.fy, camera.cy + 0.5], [0, 0, step_px]]) / step_px
    seen = known[some]
    P = place @ inverse(frame.T_world_camera)[:3]
    nearest, farthest = (np.where(seen, mm, np.float32(0)) for mm in (nearest, farthest))
    return _CoarseFrame(frame.index, nearest, farthest, _colour(frame), P)


def _colour(frame: Frame) -> np.ndarray:
    """Return the colour of each cell of a frame, whatever its brightness: ln of red and blue over green, (h, w, 2)."""
    step_px = _step_px(frame.valid.shape)
    log = np.log(cv2.blur(frame.rgb, (step_px, step_px))[_centres(frame.valid.shape)] + np.float32(_DARK))
    return np.ascontiguousarray(log[..., [0, 2]] - log[..., [1]])


def _step_px(shape: tuple[int, ...]) -> int:
    return max(round(max(shape) / _CELLS), 1)


def _centres(shape: tuple[int, ...]) -> tuple[slice, slice]:
    step_px = _step_px(shape)
    return (slice(step_px // 2, None, step_px),) * 2


@inner_kernel
def _place(points_mm: np.ndarray, n: int, P: np.ndarray, nearest_mm: np.ndarray) -> tuple[int, int, float]:
    """Return row, column and depth, mm, of a point in the cells of a reference; depth 0 where that knows nothing."""
    x, y, z_mm = points_mm[n, 0], points_mm[n, 1], points_mm[n, 2]
    depth_mm = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z_mm + P[2, 3]
    if depth_mm <= 0:
        return 0, 0, 0.0
    u = P[0, 0] * x + P[0, 1] * y + P[0, 2] * z_mm + P[0, 3]
    v = P[1, 0] * x + P[1, 1] * y + P[1, 2] * z_mm + P[1, 3]
    if not (0 <= u < nearest_mm.shape[1] * depth_mm and 0 <= v < nearest_mm.shape[0] * depth_mm):
        return 0, 0, 0.0
    row, column = int(v / depth_mm), int(u / depth_mm)
    return row, column, depth_mm if nearest_mm[row, column] > 0 else 0.0


@kernel
def _count(points_mm: Float64_2d, colour: Float32_2d, other: _CoarseFrame, counts: Float64_2d) -> None:
    """Add to `counts` (N, 4) whether another confirms or contradicts points (N, 3), contradicts, clearly contradicts.

    The last is the difference to their colour (N, 2) there. What both differ by in the median is a difference of
    scale, and does not count.
    """
    P, nearest_mm, farthest_mm, other_colour = other.P, other.nearest_mm, other.farthest_mm, other.colour
    ratios, known = np.empty(len(points_mm) // _SOME_RATIOS + 1), 0
    for n in range(0, len(points_mm), _SOME_RATIOS):
        i, j, depth_mm = _place(points_mm, n, P, nearest_mm)
        if depth_mm > 0:
            ratios[known] = 0.5 * (nearest_mm[i, j] + farthest_mm[i, j]) / depth_mm
            known += 1
    if known == 0:
        return
    usual = median(ratios[:known])
    for n in range(known):
        ratios[n] = abs(ratios[n] - usual)
    tolerance = max(_TOLERANCE * usual, _SIGMAS * 1.4826 * median(ratios[:known]))
    for n in range(len(points_mm)):
        i, j, depth_mm = _place(points_mm, n, P, nearest_mm)
        if depth_mm > 0 and farthest_mm[i, j] >= (usual - tolerance) * depth_mm:
            behind = nearest_mm[i, j] / depth_mm - usual
            counts[n, 0] += 1
            counts[n, 1] += behind > tolerance
            counts[n, 2] += behind > _CERTAIN * tolerance
            red, blue = colour[n, 0] - other_colour[i, j, 0], colour[n, 1] - other_colour[i, j, 1]
            counts[n, 3] += math.sqrt(red * red + blue * blue)
