"""Two views packed into one picture: side by side or above each other, whole or squeezed to half their width or height.

Fine detail of both halves must agree, shifted sideways by a few percent, in several tiles. Saturated and constant
pixels are left out: reflections of two lamps and text are similar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

import cv2
import numpy as np

from scopemap.engine.geometry.least_squares import robust_sigma
from scopemap.engine.geometry.local_contrast import local_mean

Layout = Literal["left-right", "top-bottom"]

LEAST_CORRELATION = 0.6
"""Normalised cross-correlation of the detail of two halves, and of their parts, that are two views of one scene."""

LEAST_CORRELATION_USUAL_SHAPE = 0.64
"""The same for pictures that have the shape of one view."""

# Width over height of one view as it is displayed; beyond it the view was squeezed, or it is none.
_NARROWEST = 0.95
_WIDEST = 2.0
# Pictures of one view are neither so wide nor so high.
_LEAST_ASPECT_BESIDE = 2.2
_MOST_ASPECT_ABOVE = 1 / 1.4
_WIDTH_PX = 160
_MOST_SHIFT_SHARE = 0.16
_BLACK_LEVEL = 16
_LEAST_LIT_SHARE = 0.15
_DETAIL_SHARE = 0.04
_LEAST_LEAD = 0.25
# Grey levels of detail: less is what coding makes of an even slope.
_LEAST_DEVIATION = 2.0
_LEAST_PICTURES_SHARE = 0.25
_SATURATED_LEVEL = 250
_MOST_SATURATED_SHARE = 0.1
# Detail beyond so many standard deviations counts as that many.
_MOST_DEVIATIONS = 2.5
_TILES = 3
_LEAST_TILES = 3
_LEAST_TILES_SHARE = 0.5
# A pixel whose grey level changes by less over this many pictures or more is written over them.
_STILL_LEVELS = 3
_LEAST_STILL_PICTURES = 3
_MOST_STILL_SHARE = 0.5


@dataclass(frozen=True)
class Packing:
    """The packing of two views into one picture.

    layout : left-right or top-bottom, the left eye's first. squeezed : to half the width or height. correlation : of
    both views' detail, median over the pictures; NaN where not measured.
    """

    layout: Layout
    squeezed: bool
    correlation: float

    @property
    def pixel_aspect(self) -> float:
        """Width over height of a pixel of one view, times that of the whole picture."""
        return 1.0 if not self.squeezed else (2.0 if self.layout == "left-right" else 0.5)

    def view_size(self, width: int, height: int) -> tuple[int, int]:
        """Return (width, height) of one view, px, in pictures of that size."""
        return (width // 2, height) if self.layout == "left-right" else (width, height // 2)

    def views(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the left and the right eye's view (h, w, 3) of a picture."""
        left, right = halves(picture, self.layout)
        return np.ascontiguousarray(left), np.ascontiguousarray(right)


def halves(picture: np.ndarray, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return the left and right, or upper and lower half of a picture (h, w, ...); a middle line is left out."""
    height, width = picture.shape[0] // 2, picture.shape[1] // 2
    if layout == "left-right":
        return picture[:, :width], picture[:, -width:]
    return picture[:height], picture[-height:]


def suspected(width: int, height: int, pixel_aspect: float = 1.0) -> Layout | None:
    """Return the layout that the shape of pictures suggests, None for shapes that are usual for one view."""
    aspect = pixel_aspect * width / height
    if aspect > _LEAST_ASPECT_BESIDE:
        return "left-right"
    return "top-bottom" if aspect < _MOST_ASPECT_ABOVE else None


def squeezed_views(width: int, height: int, layout: Layout, pixel_aspect: float = 1.0) -> bool:
    """Return whether the views in a picture of that size must be squeezed, by the shape that they would have else."""
    aspect = pixel_aspect * width / height
    return aspect / 2 < _NARROWEST if layout == "left-right" else aspect * 2 > _WIDEST


def packing(pictures: Sequence[np.ndarray], pixel_aspect: float = 1.0) -> Packing | None:
    """Return how two views are packed into (h, w, 3) uint8 of one video, or None; pixel_aspect : width over height."""
    if not pictures:
        return None
    height, width = pictures[0].shape[:2]
    found = []
    for layout in get_args(Layout):
        is_suspected = suspected(width, height, pixel_aspect) == layout
        least = LEAST_CORRELATION if is_suspected else LEAST_CORRELATION_USUAL_SHAPE
        values = _correlations(pictures, layout)
        enough = len(values) >= max(1, _LEAST_PICTURES_SHARE * len(pictures))
        if enough and np.median(values) > least:
            squeezed = squeezed_views(width, height, layout, pixel_aspect)
            found.append(Packing(layout, squeezed, float(np.median(values))))
    return max(found, key=lambda one: one.correlation, default=None)


def _correlations(pictures: Sequence[np.ndarray], layout: Layout) -> list[float]:
    """Return the correlation of the halves of the pictures in which there is something to compare."""
    firsts, seconds = zip(*(halves(picture, layout) for picture in pictures), strict=True)
    if min(firsts[0].shape[:2]) < 16:
        return []
    values = [_alike(one, other) for one, other in zip(_comparable(firsts), _comparable(seconds), strict=True)]
    return [value for value in values if value is not None]


def _comparable(views: Sequence[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return each view as a small grey picture (h, w), and which of its pixels are compared (h, w), 0 or 1, float32."""
    size = (_WIDTH_PX, max(16, round(_WIDTH_PX * views[0].shape[0] / views[0].shape[1])))
    full = [cv2.cvtColor(view, cv2.COLOR_RGB2GRAY) for view in views]
    greys = np.stack([_reduced(grey, size) for grey in full]).astype(np.float32)
    saturated = np.stack([_reduced((grey >= _SATURATED_LEVEL).astype(np.float32), size) for grey in full])
    used = np.stack([_eroded(one) for one in (greys > _BLACK_LEVEL) & (saturated < _MOST_SATURATED_SHARE)])
    if len(views) >= _LEAST_STILL_PICTURES:
        still = np.ptp(greys, axis=0) < _STILL_LEVELS
        lit = used.any(axis=0)
        # In a video at rest, text over the picture cannot be distinguished from the scene.
        if lit.any() and still[lit].mean() < _MOST_STILL_SHARE:
            used *= _eroded(~still | ~lit)
    return list(zip(greys, used, strict=True))


def _reduced(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _eroded(mask: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.erode(mask.astype(np.float32), np.ones((3, 3))))


def _alike(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> float | None:
    """Return the correlation of the detail of two halves, 0 where they agree in no one shift or in too few parts."""
    (first, used), (second, other_used) = _detail(*one), _detail(*other)
    height, width = first.shape
    across, up = round(_MOST_SHIFT_SHARE * width), round(_MOST_SHIFT_SHARE * height)
    middle = np.s_[up : height - up, across : width - across]
    least_deviation = min(first[middle].std(), second[middle].std())
    if min(used, other_used) < _LEAST_LIT_SHARE or least_deviation < _LEAST_DEVIATION:
        return None
    scores = cv2.matchTemplate(second, first[middle], cv2.TM_CCOEFF_NORMED)
    _, best, _, (at, row) = cv2.minMaxLoc(scores)
    if abs(row - up) > max(1, round(0.02 * height)):
        return 0.0
    reach = max(3, round(_DETAIL_SHARE * 2 * width))
    v, u = np.mgrid[: scores.shape[0], : scores.shape[1]]
    elsewhere = scores[np.hypot(v - row, u - at) > reach]
    if not elsewhere.size or best - elsewhere.max() <= _LEAST_LEAD:
        return 0.0
    tiles = _tiles(first, second, (at - across, row - up))
    agree = sum(tile > LEAST_CORRELATION for tile in tiles)
    return float(best) if agree >= max(_LEAST_TILES, _LEAST_TILES_SHARE * len(tiles)) else 0.0


def _tiles(first: np.ndarray, second: np.ndarray, shift: tuple[int, int]) -> list[float]:
    """Return the correlation of each part of the first view that has detail with the second at about a shift, px."""
    height, width = first.shape
    across, up = shift
    # The depth of the tissue, hence the shift, differs from part to part.
    reach, rise = max(2, round(_DETAIL_SHARE * width)), max(1, round(0.02 * height))
    rows, columns = (np.linspace(0, length, _TILES + 1).astype(int) for length in first.shape)
    found = []
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            # Of the tile, what the other view shows, too.
            low, high = max(left, -across), min(right, width - across)
            upper, lower = max(top, rise - up), min(bottom, height - rise - up)
            if high - low < (right - left) / 2 or lower - upper < (bottom - top) / 2:
                continue
            tile = first[upper:lower, low:high]
            begin, end = max(0, low + across - reach), min(width, high + across + reach)
            around = second[upper + up - rise : lower + up + rise, begin:end]
            if min(tile.std(), around.std()) >= _LEAST_DEVIATION:
                found.append(float(cv2.matchTemplate(around, tile, cv2.TM_CCOEFF_NORMED).max()))
    return found


def _detail(grey: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a view (h, w) less its local mean, clipped, 0 where it is not used, and the share that is."""
    sigma_px = _DETAIL_SHARE * _WIDTH_PX
    detail = (grey - local_mean(grey, sigma_px, used)) * used
    # By the median: few bright pixels must not widen what they are clipped to.
    deviation = robust_sigma(detail[used > 0])
    most = _MOST_DEVIATIONS * max(deviation, 1.0)
    return np.clip(detail, -most, most), float(used.mean())
