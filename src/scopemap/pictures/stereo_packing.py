"""Two views packed into one picture: beside or above each other, whole or squeezed to half their width or height.

A shape that is unusual for one view raises the suspicion; only pictures confirm it: the halves of a stereo picture show
the same tissue, moved sideways by a few percent and not at all up or down. What is compared is fine detail: the light
of an ordinary picture, brightest in its middle and dark around, is alike in its halves, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

Layout = Literal["left-right", "top-bottom"]

LEAST_CORRELATION = 0.6
"""Normalised cross-correlation of the detail of two halves that are two views of one scene."""

# Width over height of one view as it is displayed; beyond it the view was squeezed, or it is none.
_NARROWEST, _WIDEST = 0.95, 2.0
# Pictures of one view are neither so wide nor so high.
_LEAST_ASPECT_BESIDE, _MOST_ASPECT_ABOVE = 2.2, 1 / 1.4
_WIDTH_PX = 160
_MOST_SHIFT_SHARE = 0.16
_BLACK_LEVEL = 16
_LEAST_LIT_SHARE = 0.15
_DETAIL_SHARE = 0.04
_LEAST_LEAD = 0.25
# Grey levels of detail: less is what coding makes of an even slope.
_LEAST_DEVIATION = 2.0
_LEAST_PICTURES_SHARE = 0.25


@dataclass(frozen=True)
class Packing:
    """How two views lie in one picture.

    Attributes
    ----------
    layout : beside each other, the left eye's on the left; or above each other, the left eye's on top.
    squeezed : whether each has only half its width (left-right) or height (top-bottom).
    correlation : of the detail of both views, median over the pictures; NaN where nobody looked.
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

    def first(self, picture: np.ndarray) -> np.ndarray:
        """Return the left eye's view (h, w, 3) of a picture."""
        return np.ascontiguousarray(halves(picture, self.layout)[0])


def halves(picture: np.ndarray, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return the left and right, or upper and lower half of a picture (h, w, ...); a middle line is left out."""
    height, width = picture.shape[0] // 2, picture.shape[1] // 2
    if layout == "left-right":
        return picture[:, :width], picture[:, -width:]
    return picture[:height], picture[-height:]


def suspected(width: int, height: int, pixel_aspect: float = 1.0) -> Layout | None:
    """Return how two whole views would lie in pictures whose shape is unusual for one view; None for usual shapes."""
    aspect = pixel_aspect * width / height
    if aspect > _LEAST_ASPECT_BESIDE:
        return "left-right"
    return "top-bottom" if aspect < _MOST_ASPECT_ABOVE else None


def squeezed_views(width: int, height: int, layout: Layout, pixel_aspect: float = 1.0) -> bool:
    """Return whether the views in a picture of that size must be squeezed, by the shape that they would have else."""
    aspect = pixel_aspect * width / height
    return aspect / 2 < _NARROWEST if layout == "left-right" else aspect * 2 > _WIDEST


def packing(pictures: Sequence[np.ndarray], pixel_aspect: float = 1.0) -> Packing | None:
    """Return how two views are packed into pictures (h, w, 3) uint8 of one video; None: they show one view.

    `pixel_aspect` is the width of a pixel over its height.
    """
    if not pictures:
        return None
    height, width = pictures[0].shape[:2]
    layouts: tuple[Layout, Layout] = ("left-right", "top-bottom")
    found = []
    for layout in layouts:
        values = [value for picture in pictures if (value := _alike(*halves(picture, layout))) is not None]
        enough = len(values) >= max(1, _LEAST_PICTURES_SHARE * len(pictures))
        if enough and np.median(values) > LEAST_CORRELATION:
            squeezed = squeezed_views(width, height, layout, pixel_aspect)
            found.append(Packing(layout, squeezed, float(np.median(values))))
    return max(found, key=lambda one: one.correlation, default=None)


def _alike(one: np.ndarray, other: np.ndarray) -> float | None:
    """Return the correlation of the detail of two halves, 0 where it singles out no shift; None: nothing to compare."""
    if min(one.shape[:2]) < 16:
        return None
    (first, lit), (second, other_lit) = _detail(one), _detail(other)
    height, width = first.shape
    across, up = round(_MOST_SHIFT_SHARE * width), round(_MOST_SHIFT_SHARE * height)
    middle = np.s_[up : height - up, across : width - across]
    least_deviation = min(first[middle].std(), second[middle].std())
    if min(lit, other_lit) < _LEAST_LIT_SHARE or least_deviation < _LEAST_DEVIATION:
        return None
    scores = cv2.matchTemplate(second, first[middle], cv2.TM_CCOEFF_NORMED)
    _, best, _, (at, row) = cv2.minMaxLoc(scores)
    if abs(row - up) > max(1, round(0.02 * height)):
        return 0.0
    reach = max(3, round(_DETAIL_SHARE * 2 * width))
    v, u = np.mgrid[: scores.shape[0], : scores.shape[1]]
    elsewhere = scores[np.hypot(v - row, u - at) > reach]
    return float(best) if elsewhere.size and best - elsewhere.max() > _LEAST_LEAD else 0.0


def _detail(view: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a view (h, w) at a small size less its local mean, 0 where it is black, and the share that is not."""
    size = (_WIDTH_PX, max(16, round(_WIDTH_PX * view.shape[0] / view.shape[1])))
    grey = cv2.resize(cv2.cvtColor(view, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA).astype(np.float32)
    lit = cv2.erode((grey > _BLACK_LEVEL).astype(np.float32), np.ones((3, 3)))
    sigma_px = _DETAIL_SHARE * _WIDTH_PX
    weight = cv2.GaussianBlur(lit, (0, 0), sigma_px)
    mean = cv2.GaussianBlur(grey * lit, (0, 0), sigma_px) / np.maximum(weight, 1e-6)
    return (grey - mean) * lit, float(lit.mean())
