"""Edge-aware smoothing (He, Sun, Tang, ECCV 2010) and hole filling (Knutsson, Westin, CVPR 1993) by box filters."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.engine.errors import check_shape


def masked_mean(image: np.ndarray, known: np.ndarray, radius_px: int) -> np.ndarray:
    """Return the mean (H, W) float32 of the `known` (H, W) pixels in windows of 2 radius + 1 px; NaN where none is."""
    check_shape("known", known, np.shape(image))
    window = (2 * radius_px + 1, 2 * radius_px + 1)
    share = cv2.boxFilter(known.astype(np.float32), -1, window, borderType=cv2.BORDER_REFLECT)
    mean = cv2.boxFilter(np.where(known, image, 0).astype(np.float32), -1, window, borderType=cv2.BORDER_REFLECT)
    # Running sums leave rounding noise where a window holds nothing: half a pixel's share is the threshold.
    occupied = share > 0.5 / (window[0] * window[1])
    return np.divide(mean, share, out=np.full_like(mean, np.nan), where=occupied)


def guided_filter(image: np.ndarray, known: np.ndarray, radius_px: int, edge: float) -> np.ndarray:
    """Smooth an image (H, W) with itself as guide, eq. 5-8 of He et al. with p = I and epsilon = edge^2; float32.

    known : (H, W) bool; other pixels are ignored and NaN in the result. edge : standard deviation in a window, in the
    image's unit: smaller differences go, larger ones stay.
    """
    mean = masked_mean(image, known, radius_px)
    variance = np.maximum(masked_mean(image**2, known, radius_px) - mean**2, 0)
    gain = variance / (variance + edge**2)
    gain, offset = masked_mean(gain, known, radius_px), masked_mean((1 - gain) * mean, known, radius_px)
    return np.where(known, gain * image + offset, np.nan).astype(np.float32)


def filled(image: np.ndarray, known: np.ndarray, max_distance_px: int) -> np.ndarray:
    """Fill pixels (H, W) not `known` from the nearest known ones; NaN where these are beyond `max_distance_px`."""
    result = np.where(known, image, np.nan).astype(np.float32)
    radius_px = 1
    while radius_px < 2 * max_distance_px and np.isnan(result).any():
        means = masked_mean(image, known, min(radius_px, max_distance_px))
        result = np.where(np.isnan(result), means, result)
        radius_px *= 2
    return result
