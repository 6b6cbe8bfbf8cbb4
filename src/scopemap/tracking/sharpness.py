"""How clear a frame is against those before it: blur, smoke and fluid on the lens take its detail away."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from scopemap.frame import Frame

_FINE, _COARSE = 1 / 320, 4 / 320  # of the picture's width: standard deviations of the two blurs
_FRAMES = 30


class Clarity:
    """Compares the detail of frames, in order, with the median of the 30 that came before.

    Unclear frames count among those 30, too: a camera that has moved up to a bare wall is soon at home there.
    """

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_FRAMES)

    def against_recent(self, frame: Frame) -> float:
        """Return the frame's detail as a share of what was usual before it; 1 for the first."""
        detail = detail_of(frame)
        usual = float(np.median(self._recent)) if self._recent else detail
        self._recent.append(detail)
        return detail / usual if usual > 0 else 1.0


def detail_of(frame: Frame) -> float:
    """Return how much grey values differ from their surround, as a share of their brightness, over usable pixels."""
    grey, valid = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), frame.valid.astype(np.float32)
    fine, coarse = (_blurred(grey, valid, share * grey.shape[1]) for share in (_FINE, _COARSE))
    brightness = float((coarse * valid).sum())
    return float((np.abs(fine - coarse) * valid).sum()) / brightness if brightness > 0 else 0.0


def _blurred(grey: np.ndarray, valid: np.ndarray, sigma_px: float) -> np.ndarray:
    """Gaussian mean over the usable pixels alone."""
    weight = cv2.GaussianBlur(valid, (0, 0), sigma_px)
    return cv2.GaussianBlur(grey * valid, (0, 0), sigma_px) / np.maximum(weight, 1e-3)
