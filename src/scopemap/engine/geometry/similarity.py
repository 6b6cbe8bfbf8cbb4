"""Structural similarity of two pictures (SSIM; Wang et al., IEEE TIP 2004)."""

from __future__ import annotations

import cv2
import numpy as np

_WINDOW_PX = 7  # Wang et al. 2004 with scikit-image's default window
_SAMPLE = _WINDOW_PX**2 / (_WINDOW_PX**2 - 1)  # of a sample's covariance
_C1 = (0.01 * 255) ** 2  # Wang, section III.B
_C2 = (0.03 * 255) ** 2  # Wang et al. 2004: K2 = 0.03


def structural_similarity(grey_a: np.ndarray, grey_b: np.ndarray) -> np.ndarray:
    """Return the structural similarity (H, W) float64, -1..1, of two (H, W) uint8 images in 7 x 7 px (Wang, eq. 13)."""
    a, b = grey_a.astype(np.float64), grey_b.astype(np.float64)
    size, images = (_WINDOW_PX, _WINDOW_PX), (a, b, a * a, b * b, a * b)
    means = (cv2.blur(image, size, borderType=cv2.BORDER_REFLECT) for image in images)
    mean_a, mean_b, square_a, square_b, product = means
    variances = _SAMPLE * (square_a + square_b - mean_a**2 - mean_b**2)
    covariance = _SAMPLE * (product - mean_a * mean_b)
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    similarity: np.ndarray = luminance * (2 * covariance + _C2) / (variances + _C2)
    return similarity
