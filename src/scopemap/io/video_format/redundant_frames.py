"""Frames that add nothing to those before them: constant ones, and repeats.

A conversion from 25 to 30 frames a second repeats frames, a frozen screen does. The noise of a camera at rest differs
from frame to frame, so it repeats nothing. Compare with the last frame that was kept, not with the one before: small
differences then add up until they count.
"""

from __future__ import annotations

import numpy as np

from scopemap.frame import is_constant

LEAST_DIFFERENCE = 0.5
"""Mean absolute difference below which a frame repeats another, grey levels of 255: what lossy coding leaves."""

# Black borders are the same in all frames: they are not compared.
_BLACK_LEVEL = 16
_LONGEST_SIDE_PX = 480


def mean_difference(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean absolute difference, grey levels, of two images (h, w, 3) uint8 over pixels not black in both.

    All pixels are compared where both images are black.
    """
    step = max(1, min(one.shape[:2]) // _LONGEST_SIDE_PX)
    one, other = one[::step, ::step], other[::step, ::step]
    difference = np.abs(one.astype(np.int16) - other)
    lit = np.maximum(one, other).max(-1) > _BLACK_LEVEL
    return float(difference[lit].mean() if lit.any() else difference.mean())


def is_repeat(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two images (h, w, 3) uint8 of one size differ by no more than lossy coding changes.

    Constant images repeat nothing.
    """
    return mean_difference(one, other) < LEAST_DIFFERENCE and not is_constant(other)
