"""Interlaced pictures: even and odd rows taken at two times (PAL 576i, NTSC 480i, 1080i), and how to undo it.

Combing is the odd rows less the mean of the rows around, where a motion between the fields explains it (Lucas and
Kanade) and it exceeds the difference between rows of one field; else it is texture or noise. Stripes about two rows
apart and rows that were doubled look the same in one picture: the next one decides. Fields are half a frame apart: the
odd rows of one picture and the even ones of the other one are half a frame apart or one and a half. Of a progressive
video they are one frame apart, whichever comes first.
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
# Of the energy of the difference of two fields, the nearer over the farther ones in time. Measured: woven pictures 0.1
# to 0.8, C3VD 0.2 to 0.6, progressive clips 0.95 to 1, but 0.6 where coarse stripes are lossily coded.
_MOST_SYMMETRY = 0.85
# The farther ones over those of one picture, and the nearer ones over them, which should be as near: measured 0.9 to
# 1.6, of the coarse stripes 0.7 and 3.8. Coding that blends fields leaves more of it, and combs.
_LEAST_FARTHER = 1.2
_AS_NEAR = (0.85, 1.7)
_LEAST_ENERGY = 0.25  # squared grey levels
# Of the detail of successive pictures' even rows: C3VD 0.8, every fifth picture of it 0.35.
_LEAST_CORRELATION = 0.4
_DETAIL_PX = (1.5, 24.0)


def combing(picture: np.ndarray) -> float:
    """Return what share, 0 to 1, of the difference of a picture's fields (h, w, 3) uint8 is motion between them."""
    if min(picture.shape[:2]) < _SHORTEST_SIDE_PX:
        return 0.0
    even, odd = _fields(picture)
    return max(_share_moved(even, odd, scale_px) for scale_px in _SCALES_PX)


def is_interlaced(pictures: Sequence[np.ndarray], later: Sequence[np.ndarray | None] = ()) -> bool:
    """Return whether pictures (h, w, 3) uint8 of one video are interlaced; some of them must show motion.

    later : the picture after each, None where there is none that was taken shortly after; (): there are none.
    """
    after = later or [None] * len(pictures)
    combed = sum(
        combing(picture) > LEAST_COMBING if other is None else fields_alternate(picture, other)
        for picture, other in zip(pictures, after, strict=True)
    )
    return combed >= max(1, _LEAST_PICTURES_SHARE * len(pictures))


def fields_alternate(picture: np.ndarray, later: np.ndarray) -> bool:
    """Return whether four fields of two successive pictures (h, w, 3) uint8 were taken at four times, in turn."""
    (even, odd), (later_even, later_odd) = _fields(picture), _fields(later)
    within, *across = (_energy(*pair) for pair in ((even, odd), (even, later_odd), (later_even, odd)))
    nearer, farther = sorted(across)
    if nearer > _MOST_SYMMETRY * farther or farther < _LEAST_FARTHER * max(within, _LEAST_ENERGY):
        return False
    return _AS_NEAR[0] * within < nearer < _AS_NEAR[1] * within or combing(picture) > LEAST_COMBING


def is_shortly_after(picture: np.ndarray, later: np.ndarray) -> bool:
    """Return whether another picture (h, w, 3) uint8 shows what this one does where this one shows it, or nearly."""
    near, far = (_detail(_fields(one)[0]) for one in (picture, later))
    return float((near * far).sum()) > _LEAST_CORRELATION * float(np.linalg.norm(near) * np.linalg.norm(far))


def deinterlaced(picture: np.ndarray) -> np.ndarray:
    """Return the even field of a picture (h, w, 3) uint8 at its size: odd rows are the mean of those around."""
    out = picture.copy()
    even = picture[::2]
    above, below = even[: len(picture) // 2], np.concatenate([even[1:], even[-1:]])[: len(picture) // 2]
    if len(above):
        out[1::2] = cv2.addWeighted(above, 0.5, below, 0.5, 0.0)
    return out


def _fields(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the even and the odd rows of a picture's middle, each (h, w) float32, grey."""
    height, width = picture.shape[0] // 2 * 2, picture.shape[1]
    left = max(width - _MOST_COLUMNS, 0) // 2
    middle = np.ascontiguousarray(picture[:height, left : left + _MOST_COLUMNS])
    grey = cv2.cvtColor(middle, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return grey[::2], grey[1::2]


def _calm(field: np.ndarray, scale_px: float) -> np.ndarray:
    # A field has half the rows.
    return cv2.GaussianBlur(field, (0, 0), sigmaX=scale_px, sigmaY=max(scale_px / 2, 0.5))


def _detail(field: np.ndarray) -> np.ndarray:
    fine, coarse = (_calm(field, scale_px) for scale_px in _DETAIL_PX)
    return fine - coarse


def _energy(even: np.ndarray, odd: np.ndarray) -> float:
    """Return the mean square of what odd rows (h, w) float32 differ by from even ones; rows may have been doubled."""
    above, below = even[:-1], even[1:]
    return min(float(np.var(_calm(odd[:-1] - near, 1.0))) for near in ((above + below) / 2, above, below))


def _share_moved(even: np.ndarray, odd: np.ndarray, scale_px: float) -> float:
    """Return the share of the difference of two fields (h, w) float32 that their motion explains, at one scale."""
    side = int(_BLOCK_SCALES * scale_px) + _LEAST_BLOCK_PX

    def over_block(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values, (side, side))

    between = (even[:-1] + even[1:]) / 2
    apart, mean = (_calm(part, scale_px) for part in (odd[:-1] - between, (odd[:-1] + between) / 2))
    # One field may be brighter, as flicker or stripes of a row each make it.
    apart -= apart.mean()
    energy = over_block(apart * apart)
    if energy.mean() < (_LEAST_DIFFERENCE / (1 + scale_px)) ** 2:
        return 0.0
    # The difference without motion is estimated by rows of one field, which are farther apart.
    within = np.pad(even[1:-1] - (even[:-2] + even[2:]) / 2, ((1, 0), (0, 0)), mode="edge")
    usual = over_block(_calm(np.abs(within), scale_px) ** 2)
    along, down = (cv2.Sobel(mean, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    a, b, c = over_block(along * along) + _LEAST_GRADIENT, over_block(along * down), over_block(down * down)
    c += _LEAST_GRADIENT
    p, q = over_block(along * apart), over_block(down * apart)
    determinant = a * c - b * b
    u, v = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    moved = np.hypot(u, 2 * v) > _LEAST_MOTION_PX
    explained = np.clip(u * p + v * q, 0, energy)
    return float(np.clip(explained - usual, 0, None)[moved].sum() / energy.sum())
