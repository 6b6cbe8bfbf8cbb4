"""The field of view: whether it fills the picture, its shape and outline, and whether it moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from scopemap.apps.inspect.clip import VideoFinding
from scopemap.apps.inspect.frame_measures import InspectedFrame
from scopemap.engine.masking.masker import hull_of_largest

Shape = Literal["full", "bars", "circle", "cut corners", "rounded corners"]
ShareBox = tuple[float, float, float, float]
"""Left, top, right, bottom as shares of width and height."""

_FULL_SHARE = 0.995
_BAR_SHARE = 0.01
_EDGE_PX = 2
# Shares of a circle's radius: deviation of its outline, and least part of the outline.
_ROUND_TOLERANCE = 0.02
_LEAST_ARC = 0.3
_LEAST_CORNER = 0.03
_LEAST_CORNER_PX = 6
_INSIDE_PX = 2
# Height of an arc over its chord: a quarter of a circle has 0.2, what is left of it at the size of a pixel 0.07; an arc
# around the picture's middle the chord over four diagonals or more, and a straight cut less than half of that.
_LEAST_BULGE = 0.04
_DIAGONALS = 8
_WINDOW = 25
_MOST_WINDOWS = 400
# Pixels lit less often are coding artefacts beside a bright rim.
_LIT_SHARE = 0.1
_MOVED = 0.006
_FAR = 0.04


@dataclass(frozen=True)
class Field:
    """The field of view of a video.

    shape : full: no border; bars: a rectangle inside borders. share : of the picture. outline : (N, 2) x, y of all that
    was ever lit, shares of width and height. moved : by how much it moves, a share, too. box : around it.
    """

    shape: Shape
    share: float
    outline: np.ndarray
    moved: float
    box: ShareBox


class FieldWatcher:
    """Finds the field from all frames, and its motion from the fields of 25 frames each."""

    def __init__(self) -> None:
        # Grow to (h, w) with the first frame; all frames of a video have one size.
        self._times = self._window = np.zeros((1, 1), np.int32)
        self._count = 0
        self._latest = np.ones((1, 1), bool)
        self._boxes: list[ShareBox] = []

    def add(self, item: InspectedFrame) -> None:
        """Add the next frame; blank ones do not count."""
        if item.measures.blank:
            return
        lit = cv2.morphologyEx(item.lit.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
        self._times, self._window, self._count = self._times + lit, self._window + lit, self._count + 1
        if self._count % _WINDOW == 0:
            self._latest = hull_of_largest(self._window > _LIT_SHARE * _WINDOW)
            self._boxes.append(_box(self._latest))
            self._window = np.zeros_like(self._window)

    def field(self) -> Field:
        """Return the field of the frames so far; the whole picture where all were blank."""
        if not self._count:
            corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
            return Field("full", 1.0, corners, 0.0, (0.0, 0.0, 1.0, 1.0))
        hull = hull_of_largest(self._times > _LIT_SHARE * self._count)
        points = _points(hull)
        # From pixel centres to the pixels' outer edges.
        centre = (points.min(0) + points.max(0)) / 2
        outline = (points + 0.5 + 0.5 * np.sign(points - centre)) / hull.shape[::-1]
        moved = self._moved()
        # The union of the places of a field that moves has another shape than each.
        shape = _shape(self._latest if moved > _MOVED else hull)
        return Field(shape, float(hull.mean()), outline, moved, _box(hull))

    def _moved(self) -> float:
        """Return by how much opposite sides moved alike, between any two windows; a dark rim moves one of them only."""
        step = len(self._boxes) // _MOST_WINDOWS + 1
        sides = np.array(self._boxes[::step]).reshape(-1, 2, 2)
        first, second = (sides[:, None] - sides[None]).transpose(2, 0, 1, 3)
        alike = np.where(np.sign(first) == np.sign(second), np.minimum(np.abs(first), np.abs(second)), 0.0)
        return float(alike.max(initial=0.0))

    def findings(self) -> Iterator[VideoFinding]:
        """Yield that a field which does not fill the picture moves so far that the calibration changes."""
        field = self.field()
        if field.shape != "full" and field.moved > _FAR:
            message = (
                f"the field of view moves in the picture, by {field.moved:.1%} of its size: a zoom or a turn of the "
                "camera's head, which changes the calibration, too"
            )
            yield VideoFinding("warning", "field-moves", message, "run the parts by themselves: --frames A:B")


def shares_of(box: Sequence[int], shape: tuple[int, ...]) -> ShareBox:
    """Return left, top, width and height, px, as shares of a picture's shape (height, width)."""
    (height, width), (x, y, across, down) = shape, box
    return x / width, y / height, (x + across) / width, (y + down) / height


def _box(mask: np.ndarray) -> ShareBox:
    return shares_of(cv2.boundingRect(mask.astype(np.uint8)), mask.shape)


def _points(hull: np.ndarray) -> np.ndarray:
    """Return the pixels of the outline, (N, 2) float, x, y."""
    contours, _ = cv2.findContours(hull.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return contours[0][:, 0].astype(float)


def _shape(hull: np.ndarray) -> Shape:
    if hull.mean() >= _FULL_SHARE:
        return "full"
    if _is_round(_points(hull), hull.shape[1], hull.shape[0]):
        return "circle"
    x, y, across, down = cv2.boundingRect(hull.astype(np.uint8))
    inside = hull[y : y + down, x : x + across]
    # The four quarters, flipped so that the corner comes first.
    flipped = [inside[::up, ::left] for up in (1, -1) for left in (1, -1)]
    corners = [_is_cut(one[: down // 2, : across // 2]) for one in flipped]
    cut = [is_cut for is_cut in corners if is_cut is not None]
    if cut:
        return "cut corners" if 2 * sum(cut) >= len(cut) else "rounded corners"
    left, top, right, bottom = _box(hull)
    return "bars" if max(left, top, 1 - right, 1 - bottom) > _BAR_SHARE else "full"


def _is_round(points: np.ndarray, width: int, height: int) -> bool:
    """Return whether the part of the outline (N, 2) that is not the picture's edge is on one circle."""
    free = ((points > _EDGE_PX) & (points < np.array([width, height]) - 1 - _EDGE_PX)).all(1)
    x, y = points[free].T
    if len(x) < _LEAST_ARC * len(points) or len(x) < 16:
        return False
    # x^2 + y^2 = 2 a x + 2 b y + c (Kasa's fit).
    (a, b, c), *_ = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones_like(x)]), x * x + y * y, rcond=None)
    radius = np.sqrt(max(c + a * a + b * b, 0.0))
    off = np.abs(np.hypot(x - a, y - b) - radius)
    # Corners of a rounded rectangle are on circles, too, but not on one.
    return bool(radius < max(width, height) and np.percentile(off, 95) < max(_ROUND_TOLERANCE * radius, 1.0))


def _is_cut(quarter: np.ndarray) -> bool | None:
    """Return whether a corner is cut straight, not rounded; None where next to nothing is missing."""
    along, down = int(np.argmax(quarter[_INSIDE_PX])), int(np.argmax(quarter[:, _INSIDE_PX]))
    if min(along / quarter.shape[1], down / quarter.shape[0]) < _LEAST_CORNER or min(along, down) < _LEAST_CORNER_PX:
        return None
    rows = np.arange(_INSIDE_PX, down)
    points = np.column_stack([np.argmax(quarter[rows], axis=1), rows]).astype(float)
    # Where cut or arc meets the sides, both are round at the size of a pixel.
    points = points[len(points) // 8 : len(points) - len(points) // 8]
    chord = points[-1] - points[0]
    length = max(float(np.hypot(*chord)), 1e-9)
    across, up = np.array([chord, [-chord[1], chord[0]]]) / length @ (points - points[0]).T
    # By a parabola through all points: single ones are off by half a pixel.
    bulge = abs(float(np.polyfit(across, up, 2)[0])) * length / 4
    return bulge < min(_LEAST_BULGE, length / (_DIAGONALS * 2 * float(np.hypot(*quarter.shape))))
