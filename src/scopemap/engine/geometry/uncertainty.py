"""Relative standard deviation of depth per pixel, NaN = unknown, and the weight that follows from it."""

from __future__ import annotations

import numpy as np

from scopemap.engine.errors import check_shape

# A sigma of 0 or of infinity must not make weights infinite or undefined.
_MIN_SIGMA = 1e-4  # guard
_MAX_SIGMA = 1e3  # guard


def relative_sigma(depth_mm: np.ndarray, sigma_mm: np.ndarray | None) -> np.ndarray:
    """Return the standard deviation of depth as a share of it, (H, W) float32, 1e-4..1e3; NaN where either is unknown.

    depth_mm : (H, W), mm, NaN = unknown. sigma_mm : (H, W), mm, one standard deviation, NaN = unknown; None: all is.
    """
    if sigma_mm is None:
        return np.full(np.shape(depth_mm), np.nan, dtype=np.float32)
    check_shape("sigma_mm", sigma_mm, np.shape(depth_mm))
    with np.errstate(invalid="ignore"):
        known = (depth_mm > 0) & (sigma_mm >= 0)
        sigma = np.divide(sigma_mm, depth_mm, out=np.full(np.shape(depth_mm), np.nan, np.float32), where=known)
    return np.clip(sigma, _MIN_SIGMA, _MAX_SIGMA)


def depth_trust(depth_mm: np.ndarray, sigma_mm: np.ndarray | None, floor_share: float) -> np.ndarray:
    """Return the weight of each pixel's depth relative to the image's median pixel, (H, W) float32, positive.

    (f^2 + m^2) / (f^2 + s^2) with s the pixel's `relative_sigma`, m its median over the image and f the `floor_share`,
    the minimum relative error of every pixel. 1 where sigma is unknown.
    """
    sigma = relative_sigma(depth_mm, sigma_mm)
    known = np.isfinite(sigma)
    if not known.any():
        return np.ones(sigma.shape, dtype=np.float32)
    floor, median = np.float32(floor_share**2), np.median(sigma[known]) ** 2
    return np.where(known, (floor + median) / (floor + sigma**2), 1.0).astype(np.float32)


def faded_sigma(propagated: np.ndarray, current: np.ndarray, fading: float) -> np.ndarray:
    """Return the relative sigma of a depth from the previous frame, (H, W) float32, after one frame of growth.

    Per frame, variance grows by `fading` (0..1) of its difference to the current frame's; it never shrinks. NaN where
    `propagated` is; unchanged where `current` is NaN.
    """
    excess = np.maximum(np.nan_to_num(current**2 - propagated**2, nan=0.0), 0.0)
    return np.sqrt(propagated**2 + np.float32(fading) * excess)


def by_variance(weight: np.ndarray, sigma: np.ndarray, sigma_other: np.ndarray) -> np.ndarray:
    """Return the `weight` (H, W) 0..1 of one of two depths, changed by how certain both are, (H, W) float32 0..1.

    The odds weight / (1 - weight) are multiplied by the ratio of the inverse variances, (sigma_other / sigma)^2; where
    either is NaN the weight stays. Equal sigmas change nothing, to the last bit.
    """
    ratio = (sigma / sigma_other) ** 2
    ratio = np.where(np.isfinite(ratio), ratio, np.float32(1.0))
    return weight / (weight + (1 - weight) * ratio)


def blended_sigma(weight: np.ndarray, sigma: np.ndarray, sigma_other: np.ndarray) -> np.ndarray:
    """Return the relative sigma of weight * one + (1 - weight) * other, (H, W) float32, their errors correlated.

    weight * sigma + (1 - weight) * sigma_other, since a network errs alike on neighbouring frames. The known one where
    the other is NaN, whatever the weight.
    """
    one = np.where(np.isfinite(sigma), sigma, sigma_other)
    other = np.where(np.isfinite(sigma_other), sigma_other, sigma)
    return weight * one + (1 - weight) * other
