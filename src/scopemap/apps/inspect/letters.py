"""Letters among what stays in place: parts of one height, beside each other on a line, the same in all frames."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import maximum

# What belongs to an overlay is this near to what the finder sees of it, px of the picture that it sees; and known after
# so many frames.
BESIDE_PX = (8, 4)
_LEAST_TIMES = 12
# A stroke differs from what is around it, at one of these scales, by so many levels, somewhere by so many. It stays,
# better than an instrument at rest: its own spread is at most a share of that, and the noise of coding.
_SCALES_PX = (1.5, 3.0, 6.0, 12.0)
_STROKE_LEVELS = 15.0
_PEAK_LEVELS = 25.0
_SPREAD_SHARE = 0.15
_CODING_LEVELS = 3.0
# Heights over the scale, px; width over height, and the least median of it: stripes are slender.
_HEIGHTS = (2.0, 8.0)
_LEAST_PX = 3
_WIDEST = 4.0
_LEAST_MEDIAN_WIDTH = 0.2
# Letters of a line: heights and contrasts over one's own; how far feet are apart and gaps are wide, over one's height;
# how much they overlap, over their width.
_HEIGHTS_ALIKE = (0.6, 1.6)
_CONTRAST_ALIKE = 0.6
_FOOT = 0.1
_GAP = 5.0
_OVERLAP = 0.3
# The letters that make a text; more where they are so small that they merge and that noise looks like them.
_LEAST_LETTERS = 3
_SMALL_PX = 6
_LEAST_SMALL = 5


class LetterFinder:
    """Keeps mean and spread of the levels near overlays, in the input's own pixels: a small copy has no letters."""

    def __init__(self) -> None:
        # Grows to (H, W) with the first frame: levels, their squares, and how often. float32 is too coarse for an hour.
        self._level: np.ndarray = np.zeros((0, 0))
        self._square = self._count = self._level

    def add(self, rgb: np.ndarray, found: np.ndarray) -> None:
        """Add a frame (H, W, 3) uint8, with the overlays that were found in a small copy, (h, w) bool."""
        level = cv2.extractChannel(rgb, 1)
        if self._level.shape != level.shape:
            self._level, self._square, self._count = (np.zeros(level.shape) for _ in range(3))
        near = cv2.dilate(found.astype(np.uint8), np.ones([2 * px + 1 for px in BESIDE_PX[::-1]], np.uint8))
        near = cv2.resize(near, level.shape[::-1], interpolation=cv2.INTER_NEAREST)
        cv2.accumulate(level, self._level, near)
        cv2.accumulateSquare(level, self._square, near)
        cv2.accumulate(near, self._count)

    def letters(self) -> np.ndarray:
        """Return the middles of all letters, (N, 2), shares of width and height."""
        count = np.maximum(self._count, 1)
        mean = self._level / count
        spread = np.sqrt(np.maximum(self._square / count - mean * mean, 0))
        known = self._count >= _LEAST_TIMES
        levels, weights = (mean * known).astype(np.float32), known.astype(np.float32)
        found = [np.zeros((0, 2))]
        for scale in _SCALES_PX if known.any() else ():
            around, weight = (cv2.GaussianBlur(image, (0, 0), scale) for image in (levels, weights))
            contrast = mean - around / np.maximum(weight, 1e-3)
            steady = known & (spread < _SPREAD_SHARE * np.abs(contrast) + _CODING_LEVELS)
            found += [_letters(np.where(steady, sign * contrast, 0), scale) for sign in (1, -1)]
        return np.concatenate(found) / self._level.shape[::-1]


def _letters(contrast: np.ndarray, scale: float) -> np.ndarray:
    """Return the middles, (N, 2) px, of what makes lines of text, from the contrast (H, W) of what stays."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((contrast > _STROKE_LEVELS).astype(np.uint8))
    left, top, wide, high = stats[:, :4].T.astype(float)
    peak = maximum(contrast, labels, np.arange(len(stats)))
    fits = (high >= max(_LEAST_PX, _HEIGHTS[0] * scale)) & (high <= _HEIGHTS[1] * scale) & (wide <= _WIDEST * high)
    # The first part is all the rest.
    fits &= (peak >= _PEAK_LEVELS) & (np.arange(len(stats)) > 0)
    left, top, wide, high, peak = (each[fits] for each in (left, top, wide, high, peak))
    kept = np.zeros(len(high), bool)
    for number, height in enumerate(high):
        line = (high >= _HEIGHTS_ALIKE[0] * height) & (high <= _HEIGHTS_ALIKE[1] * height)
        line &= (peak >= _CONTRAST_ALIKE * peak[number]) & (peak[number] >= _CONTRAST_ALIKE * peak)
        line &= np.abs(top + high - top[number] - height) <= max(1, _FOOT * height)
        # The stripes of an oblique rod lie over each other.
        apart = np.maximum(left - left[number] - wide[number], left[number] - left - wide)
        line &= ((apart >= -_OVERLAP * wide) & (apart <= _GAP * height)) | (np.arange(len(high)) == number)
        enough = line.sum() >= (_LEAST_LETTERS if height >= _SMALL_PX else _LEAST_SMALL)
        kept[number] = enough and np.median(wide[line] / high[line]) >= _LEAST_MEDIAN_WIDTH
    return np.stack([left + wide / 2, top + high / 2], -1)[kept]
