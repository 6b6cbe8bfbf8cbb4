"""Carrying images and depth from one frame to the next along known correspondences and motion."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape


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


def moved_depth(
    depth_previous_mm: np.ndarray, to_previous: np.ndarray, camera: PinholeCamera, T_current_previous: np.ndarray
) -> np.ndarray:
    """Return the depth that points, sampled from the previous frame, have as seen from the current camera.

    A warp alone carries values unchanged although the camera moved: here each value becomes a point, the point is
    moved, and its new depth is what counts.

    Parameters
    ----------
    depth_previous_mm : (H, W) float32, the previous depth already sampled on the current grid, NaN = unknown.
    to_previous : (H, W, 2) float32 px, where in the previous image each pixel's depth was sampled.
    camera : of both frames.
    T_current_previous : (4, 4) takes points of the previous camera to the current one.

    Returns
    -------
    (H, W) float32 in mm, NaN = unknown or behind the camera.
    """
    check_shape("depth_previous_mm", depth_previous_mm, (camera.height, camera.width))
    check_shape("to_previous", to_previous, (camera.height, camera.width, 2))
    rays = camera.rays
    slope = T_current_previous[2, :3].astype(np.float32)
    x = rays[..., 0] + to_previous[..., 0] / np.float32(camera.fx)
    y = rays[..., 1] + to_previous[..., 1] / np.float32(camera.fy)
    moved = depth_previous_mm * (slope[0] * x + slope[1] * y + slope[2]) + np.float32(T_current_previous[2, 3])
    return np.where(moved > 0, moved, np.float32(np.nan))


def bilateral_filtered(depth_mm: np.ndarray, sigma_px: float, sigma_mm: float) -> np.ndarray:
    """Smooth depth (H, W) float32 within surfaces, not across edges; NaN pixels stay NaN and do not count.

    OpenCV's filter has no missing values: they are set far beyond any range weight, so they affect no neighbour.
    """
    known = np.isfinite(depth_mm)
    if sigma_px <= 0 or not known.any():
        return depth_mm
    away = np.float32(depth_mm[known].max() + 100.0 * sigma_mm)
    smooth = cv2.bilateralFilter(np.where(known, depth_mm, away), -1, sigma_mm, sigma_px)
    return np.where(known, smooth, np.float32(np.nan))
