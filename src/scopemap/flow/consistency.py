"""Flow in both directions between two frames, where the two agree, and warping with it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.errors import check_shape
from scopemap.flow.estimator import FlowEstimator


@dataclass(frozen=True)
class Flow:
    """Optical flow between the previous and the current frame.

    Attributes
    ----------
    to_previous : (H, W, 2) float32, px: pixel p of the current frame is seen at p + to_previous(p) in the previous.
    to_current : (H, W, 2) float32, px: the same from the previous frame to the current.
    consistent : (H, W) bool on the current frame's grid: True where there and back again ends where it began.
    """

    to_previous: np.ndarray
    to_current: np.ndarray
    consistent: np.ndarray


def pair_flow(
    estimator: FlowEstimator, rgb_previous: np.ndarray, rgb_current: np.ndarray, consistency_px: float
) -> Flow:
    """Return the flow between two (H, W, 3) uint8 frames, both ways, checked against each other.

    `consistency_px` is the largest distance between a pixel and where both flows, one after the other, take it.
    """
    check_shape("rgb_previous", rgb_previous, (None, None, 3))
    check_shape("rgb_current", rgb_current, rgb_previous.shape)
    to_current, to_previous = estimator.estimate_both(rgb_previous, rgb_current)
    return Flow(to_previous, to_current, agree(to_previous, to_current, consistency_px))


def agree(forth: np.ndarray, back: np.ndarray, consistency_px: float) -> np.ndarray:
    """Return (H, W) bool: True where `forth` (H, W, 2) stays in the image and `back`, taken there, undoes it."""
    error_px = np.linalg.norm(forth + pull(back, forth), axis=-1)
    return error_px <= consistency_px


def pull(image_previous: np.ndarray, to_previous: np.ndarray) -> np.ndarray:
    """Sample an image (H, W) or (H, W, C) bilinearly at p + to_previous(p) for every pixel p of the current frame.

    Whole numbers (pictures) repeat their border outside the image. Floating-point numbers (depth, flow) are NaN outside
    the image, and where more than half of what would be sampled is NaN; the rest is the mean of the known neighbours.
    """
    check_shape("to_previous", to_previous, (*image_previous.shape[:2], 2))
    height, width = to_previous.shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    x, y = u + to_previous[..., 0], v + to_previous[..., 1]
    if not np.issubdtype(image_previous.dtype, np.floating):
        return cv2.remap(image_previous, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    known = np.isfinite(image_previous)
    values = np.where(known, image_previous, 0.0).astype(np.float32)
    sums = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    shares = cv2.remap(known.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    inside = inside.reshape(inside.shape + (1,) * (values.ndim - 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(inside & (shares >= 0.5), sums / shares, np.nan).astype(np.float32)
