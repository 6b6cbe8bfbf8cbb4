"""Sharpness of a frame against the recent frames: blur, smoke and fluid on the lens reduce it."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

_FINE, _COARSE = 1 / 320, 4 / 320  # of the picture's width: standard deviations of the two blurs
_FRAMES = 30


class SharpnessMonitor:
    """Compares the sharpness of frames, in order, with the median of the last 30.

    Unsharp frames count among those 30, too, so that a camera that approached a bare wall is soon usual again.
    """

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_FRAMES)

    def relative_sharpness(self, rgb: np.ndarray, valid: np.ndarray) -> float:
        """Return the sharpness of an image as a share of the median before it; 1 for the first."""
        value = sharpness(rgb, valid)
        usual = float(np.median(self._recent)) if self._recent else value
        self._recent.append(value)
        return value / usual if usual > 0 else 1.0


def sharpness(rgb: np.ndarray, valid: np.ndarray) -> float:
    """Return the mean local contrast of an image (H, W, 3) uint8 over valid pixels (H, W), relative to brightness."""
    grey, valid = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), valid.astype(np.float32)
    fine, coarse = (_blurred(grey, valid, share * grey.shape[1]) for share in (_FINE, _COARSE))
    brightness = float((coarse * valid).sum())
    return float((np.abs(fine - coarse) * valid).sum()) / brightness if brightness > 0 else 0.0


def _blurred(grey: np.ndarray, valid: np.ndarray, sigma_px: float) -> np.ndarray:
    """Gaussian mean over the usable pixels alone."""
    weight = cv2.GaussianBlur(valid, (0, 0), sigma_px)
    return cv2.GaussianBlur(grey * valid, (0, 0), sigma_px) / np.maximum(weight, 1e-3)
