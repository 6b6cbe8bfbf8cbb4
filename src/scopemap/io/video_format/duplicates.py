"""Pictures that repeat the one before, as a conversion from 25 to 30 pictures a second makes them, or a frozen screen.

A camera at rest repeats nothing: its noise differs. So may a slowly moving one not: compare with the last picture that
was kept, not with the one before, and what creeps adds up until it counts.
"""

from __future__ import annotations

import numpy as np

from scopemap.io.video_format.constant import is_constant

LEAST_DIFFERENCE = 0.5
"""Mean absolute difference below which a picture repeats another, grey levels of 255: what lossy coding leaves."""

# Black borders are the same in all pictures: they must not dilute what differs.
_BLACK_LEVEL = 16
# A mean needs no more pixels than that along a side.
_MOST_PX = 480


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean absolute difference of two pictures (h, w, 3) uint8 where either is lit, grey levels.

    All of both is compared where neither shows anything.
    """
    step = max(1, min(one.shape[:2]) // _MOST_PX)
    one, other = one[::step, ::step], other[::step, ::step]
    apart = np.abs(one.astype(np.int16) - other)
    lit = np.maximum(one, other).max(-1) > _BLACK_LEVEL
    return float(apart[lit].mean() if lit.any() else apart.mean())


def repeats(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two pictures (h, w, 3) uint8 of one size are the same but for what lossy coding changes.

    Pictures that show nothing repeat nothing.
    """
    return difference(one, other) < LEAST_DIFFERENCE and not is_constant(other)
