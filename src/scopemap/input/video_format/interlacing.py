"""Interlaced pictures: even and odd rows taken at two times (PAL 576i, NTSC 480i, 1080i), and how to undo it.

Combing is the odd rows less the mean of the rows around, where a motion between the fields explains it (Lucas and
Kanade) and it exceeds the difference between rows of one field; else it is texture or noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

LEAST_COMBING = 0.05
"""`combing` from which on a picture is interlaced; progressive ones measure next to 0, noisy or sharpened ones too."""

_SHORTEST_SIDE_PX = 32
# That many columns in the middle tell enough.
_MOST_COLUMNS = 640
_SCALES_PX = (1.0, 2.0, 4.0)
_BLOCK_SCALES = 6
_LEAST_BLOCK_PX = 12
# Grey levels that the fields must differ by at a scale of nothing; blurring leaves less of it.
_LEAST_DIFFERENCE = 1.0
_LEAST_MOTION_PX = 0.3
# Squared grey levels per px, without which a motion along an edge would be anything.
_LEAST_GRADIENT = 0.25
_LEAST_PICTURES_SHARE = 0.25


def combing(picture: np.ndarray) -> float:
    """Return what share, 0 to 1, of the difference of a picture's fields (h, w, 3) uint8 is motion between them."""
    height, width = picture.shape[0] // 2 * 2, picture.shape[1]
    if min(height, width) < _SHORTEST_SIDE_PX:
        return 0.0
    left = max(width - _MOST_COLUMNS, 0) // 2
    middle = np.ascontiguousarray(picture[:height, left : left + _MOST_COLUMNS])
    grey = cv2.cvtColor(middle, cv2.COLOR_RGB2GRAY).astype(np.float32)
    even, odd = grey[::2], grey[1::2]
    return max(_share_moved(even, odd, scale_px) for scale_px in _SCALES_PX)


def is_interlaced(pictures: Sequence[np.ndarray]) -> bool:
    """Return whether pictures (h, w, 3) uint8 of one video are interlaced; some of them must show motion."""
    combed = sum(combing(picture) > LEAST_COMBING for picture in pictures)
    return combed >= max(1, _LEAST_PICTURES_SHARE * len(pictures))


def deinterlaced(picture: np.ndarray) -> np.ndarray:
    """Return the even field of a picture (h, w, 3) uint8 at its size: odd rows are the mean of those around."""
    out = picture.copy()
    even = picture[::2]
    above, below = even[: len(picture) // 2], np.concatenate([even[1:], even[-1:]])[: len(picture) // 2]
    if len(above):
        out[1::2] = cv2.addWeighted(above, 0.5, below, 0.5, 0.0)
    return out


def _share_moved(even: np.ndarray, odd: np.ndarray, scale_px: float) -> float:
    """Return the share of the difference of two fields (h, w) float32 that their motion explains, at one scale."""

    def calm(field: np.ndarray) -> np.ndarray:
        # A field has half the rows.
        return cv2.GaussianBlur(field, (0, 0), sigmaX=scale_px, sigmaY=max(scale_px / 2, 0.5))

    side = int(_BLOCK_SCALES * scale_px) + _LEAST_BLOCK_PX

    def over_block(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values, (side, side))

    between = (even[:-1] + even[1:]) / 2
    apart, mean = calm(odd[:-1] - between), calm((odd[:-1] + between) / 2)
    # One field may be brighter, as flicker or stripes of a row each make it.
    apart -= apart.mean()
    energy = over_block(apart * apart)
    if energy.mean() < (_LEAST_DIFFERENCE / (1 + scale_px)) ** 2:
        return 0.0
    # The difference without motion is estimated by rows of one field, which are farther apart.
    within = np.pad(even[1:-1] - (even[:-2] + even[2:]) / 2, ((1, 0), (0, 0)), mode="edge")
    usual = over_block(calm(np.abs(within)) ** 2)
    along, down = (cv2.Sobel(mean, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    a, b, c = over_block(along * along) + _LEAST_GRADIENT, over_block(along * down), over_block(down * down)
    c += _LEAST_GRADIENT
    p, q = over_block(along * apart), over_block(down * apart)
    determinant = a * c - b * b
    u, v = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    moved = np.hypot(u, 2 * v) > _LEAST_MOTION_PX
    explained = np.clip(u * p + v * q, 0, energy)
    return float(np.clip(explained - usual, 0, None)[moved].sum() / energy.sum())
