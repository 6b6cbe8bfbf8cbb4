"""Whether two pictures of a video show the same: repeated, or at rest but for a sensor's noise."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.engine.frame import is_constant

LEAST_DIFFERENCE = 0.5
"""Mean absolute difference below which a frame repeats another, grey levels of 255: what lossy coding leaves."""

# Means of so many blocks along the shorter side hold little of a sensor's noise: below these differences (mean, 99th
# percentile), grey levels, the camera and the tissue are at rest. The least of 497 clinical frames were 0.37 and 1.3.
_BLOCKS = 32
_REST = (0.33, 1.2)
_MOST_NOISE = 8.0
# Black borders are the same in all frames: they are not compared.
_BLACK_LEVEL = 16
_COMPARED_SIDE_PX = 160  # at least
_RESTING_SIDE_PX = 256  # every n-th pixel of larger pictures is compared


def mean_difference(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean absolute difference, grey levels, of (h, w, 3) uint8 over pixels not black in both, or all."""
    step = max(1, min(one.shape[:2]) // _COMPARED_SIDE_PX)
    one, other = (np.ascontiguousarray(rgb[::step, ::step]) for rgb in (one, other))
    difference, (red, green, blue) = cv2.absdiff(one, other), cv2.split(cv2.max(one, other))
    lit = (cv2.max(cv2.max(red, green), blue) > _BLACK_LEVEL).astype(np.uint8)
    return float(np.mean(cv2.mean(difference, lit if lit.any() else None)[:3]))


def is_repeat(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two (h, w, 3) uint8 of one size, not constant, differ by no more than lossy coding changes."""
    return mean_difference(one, other) < LEAST_DIFFERENCE and not is_constant(other)


def is_at_rest(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two (h, w, 3) uint8 of one size, not constant, differ by no more than a sensor's noise."""
    if mean_difference(one, other) > _MOST_NOISE:
        return False
    every = max(1, min(one.shape[:2]) // _RESTING_SIDE_PX)
    one, other = (np.ascontiguousarray(rgb[::every, ::every]) for rgb in (one, other))
    height, width = one.shape[:2]
    step = max(1, min(height, width) // _BLOCKS)
    columns, rows = width // step, height // step
    # Blocks of whole pixels take a quarter of the time.
    whole = (rgb[: rows * step, : columns * step] for rgb in (one, other))
    before, now = (cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA) for rgb in whole)
    change = cv2.absdiff(before, now).mean(axis=2)
    limits = (change.mean() < _REST[0]) & (np.percentile(change, 99) < _REST[1])
    return bool(limits) and not is_constant(now)
