"""Local mean and contrast of images, in which lamp and exposure cancel."""

from __future__ import annotations

import cv2
import numpy as np

_LEAST_WEIGHT = 1e-6  # guard: division where nothing is valid


def local_mean(
    values: np.ndarray, sigma_px: float, weight: np.ndarray | None = None, *, downscale: int = 1
) -> np.ndarray:
    """Return the Gaussian mean, (H, W) float32, around each pixel of `values` (H, W), float32 or, downscaled, uint8.

    weight : (H, W) float32, by which pixels count; None: all alike. downscale : of the size at which it is computed.
    """
    if weight is not None:
        share = np.maximum(local_mean(weight, sigma_px, downscale=downscale), _LEAST_WEIGHT)
        return local_mean(values * weight, sigma_px, downscale=downscale) / share
    if downscale == 1:
        return cv2.GaussianBlur(values, (0, 0), sigma_px)
    height, width = values.shape
    size = (max(1, width // downscale), max(1, height // downscale))
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), sigma_px / downscale), (width, height))


def local_contrast(
    detail: np.ndarray,
    sigma_px: float,
    weight: np.ndarray | None = None,
    *,
    unit: float = 1.0,
    noise: float = 0.0,
    least: float = 0.0,
    downscale: int = 1,
) -> np.ndarray:
    """Return `unit` times `detail` (H, W) float32, an image less its local mean, over its local standard deviation.

    weight, downscale : as in `local_mean`. noise : deviation of noise, whose variance is added to the local one.
    least : added to the deviation.
    """
    variance = local_mean(detail**2, sigma_px, weight, downscale=downscale)
    return unit * detail / (np.sqrt(variance + noise**2) + least)
