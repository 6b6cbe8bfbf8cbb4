"""Sharpness of a frame against the recent frames, and its image quality: blur, smoke and fluid reduce both."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from scopemap.engine.geometry.local_contrast import local_mean

_FINE = 1 / 320  # by hand: of the picture's width: standard deviations of the two blurs
_COARSE = 4 / 320  # by hand
_FRAMES = 30  # by hand: of the median
# Quality is measured in a small copy, against the upper quartile of so many frames: unlike their median, it is still
# that of clear ones where fluid stays for seconds.
_SMALL_PX = 320  # by hand
_NEIGHBOURS = 100  # by hand
_CLEAR_PERCENTILE = 75  # by hand
LEAST_QUALITY = 0.01  # guard: a frame still has a weight
# Least sharpness, usable share and saturation of clear frames by which others are judged: pictures may all be flat, or
# have no colours; coding alone makes saturations of one level in a hundred.
_LEAST_MEASURES = np.array([1e-6, 1e-6, 0.02])


class SharpnessMonitor:
    """Compares the sharpness of frames, in order, with the median of the last 30, unsharp ones included."""

    def __init__(self) -> None:
        self._recent = deque[float](maxlen=_FRAMES)

    def relative_sharpness(self, rgb: np.ndarray, valid: np.ndarray) -> float:
        """Return the sharpness of an image as a share of the median before it; 1 for the first."""
        value = sharpness(rgb, valid)
        usual = float(np.median(self._recent)) if self._recent else value
        self._recent.append(value)
        return value / usual if usual > 0 else 1.0


class PictureQuality:
    """Image quality of frames, in order, beside that of the last 100.

    The product of three shares, each 1 at most, of the upper quartile of these frames: sharpness; usable pixels, which
    are neither saturated nor too dark; and saturation of the colours, since tissue is red and haze is white. What
    the clear frames lack, too, as a video without colours lacks saturation, does not count.
    """

    def __init__(self) -> None:
        self.recent = deque[tuple[float, float, float]](maxlen=_NEIGHBOURS)
        """Measures of these frames."""

    def __call__(self, rgb: np.ndarray, valid: np.ndarray) -> float:
        """Return the quality, 0.01..1, of an image (H, W, 3) uint8 with valid pixels (H, W) bool."""
        share = float(valid.mean())
        if share == 0:
            return LEAST_QUALITY
        height, width = valid.shape
        factor = min(1.0, _SMALL_PX / max(height, width))
        size = max(1, round(factor * width)), max(1, round(factor * height))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if factor < 0.5 else cv2.INTER_LINEAR)
        valid = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        found = sharpness(rgb, valid), share, _saturation(rgb, valid)
        self.recent.append(found)
        clear = np.percentile(self.recent, _CLEAR_PERCENTILE, axis=0)
        shares = np.where(clear < _LEAST_MEASURES, 1.0, np.minimum(found / np.maximum(clear, _LEAST_MEASURES), 1.0))
        return max(float(shares.prod()), LEAST_QUALITY)


def _saturation(rgb: np.ndarray, valid: np.ndarray) -> float:
    """Return the mean saturation of the colours, 0..1, over valid pixels."""
    r, g, b = cv2.split(rgb)
    brightest, darkest = cv2.max(cv2.max(r, g), b), cv2.min(cv2.min(r, g), b)
    share = (brightest - darkest).astype(np.float32) / np.maximum(brightest, 1)  # black has none
    return cv2.mean(share, valid.astype(np.uint8))[0]


def sharpness(rgb: np.ndarray, valid: np.ndarray) -> float:
    """Return the mean local contrast of an image (H, W, 3) uint8 over valid pixels (H, W), relative to brightness."""
    grey, valid = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), valid.astype(np.float32)
    fine = local_mean(grey, _FINE * grey.shape[1], valid)
    coarse = local_mean(grey, _COARSE * grey.shape[1], valid, downscale=2)
    brightness = float((coarse * valid).sum())
    return float((np.abs(fine - coarse) * valid).sum()) / brightness if brightness > 0 else 0.0
