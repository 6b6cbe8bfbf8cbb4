"""Images and depth warped from one frame to the next along known correspondences and motion."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import check_shape
from scopemap.engine.geometry.kernels import Float32_3d, inner_kernel, kernel


def pull(image_previous: np.ndarray, to_previous: np.ndarray) -> np.ndarray:
    """Sample an image (H, W) or (H, W, C) bilinearly at p + to_previous(p) for every pixel p of the current frame.

    Whole numbers (pictures) repeat their border outside the image. Floating-point numbers (depth, flow) are NaN outside
    the image, and where more than half of what would be sampled is NaN; the rest is the mean of the known neighbours.
    """
    check_shape("to_previous", to_previous, (*image_previous.shape[:2], 2))
    if np.issubdtype(image_previous.dtype, np.floating):
        height, width = to_previous.shape[:2]
        image = np.ascontiguousarray(image_previous, np.float32).reshape(height, width, -1)
        return _sampled(image, np.ascontiguousarray(to_previous, np.float32)).reshape(image_previous.shape)
    x, y = _pixel_grid(*to_previous.shape[:2])
    x, y = x + to_previous[..., 0], y + to_previous[..., 1]
    return cv2.remap(image_previous, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=4)
def _pixel_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return u, v


@inner_kernel
def _mean_of_known(neighbours, a, b):  # type: ignore[no-untyped-def]
    """Mean of the known ones of four values by their bilinear weights; NaN where these are below a half."""
    total, share = np.float32(0.0), np.float32(0.0)
    left, up = np.float32(1.0) - a, np.float32(1.0) - b
    for value, weight in zip(neighbours, (left * up, a * up, left * b, a * b)):  # noqa: B905
        if np.isfinite(value):
            total += weight * value
            share += weight
    return total / share if share >= 0.5 else np.float32(np.nan)


@kernel
def _sampled(image: Float32_3d, to_previous: Float32_3d) -> np.ndarray:
    """Sample floats (H, W, C) as `pull` says; (H, W, C) float32."""
    h, w, channels = image.shape
    out = np.empty((h, w, channels), np.float32)
    for row in range(h):
        for column in range(w):
            x = np.float32(column) + to_previous[row, column, 0]
            y = np.float32(row) + to_previous[row, column, 1]
            if not (0.0 <= x <= w - 1 and 0.0 <= y <= h - 1):
                for c in range(channels):
                    out[row, column, c] = np.nan
                continue
            i, j = int(x), int(y)
            a, b = x - np.float32(i), y - np.float32(j)
            right, below = min(i + 1, w - 1), min(j + 1, h - 1)
            for c in range(channels):
                d00, d10, d01, d11 = image[j, i, c], image[j, right, c], image[below, i, c], image[below, right, c]
                top, bottom = d00 + a * (d10 - d00), d01 + a * (d11 - d01)
                value = top + b * (bottom - top)
                if not np.isfinite(value):
                    value = _mean_of_known((d00, d10, d01, d11), a, b)
                out[row, column, c] = value
    return out


def moved_depth(
    depth_previous_mm: np.ndarray, to_previous: np.ndarray, camera: PinholeCamera, T_current_previous: np.ndarray
) -> np.ndarray:
    """Return the depth (H, W) float32, mm, of the previous frame's points in the current camera; NaN: unknown, behind.

    depth_previous_mm : (H, W) float32, the previous depth already sampled on the current grid, NaN = unknown.
    to_previous : (H, W, 2) float32 px, where in the previous image each pixel's depth was sampled. camera : of both.
    """
    check_shape("depth_previous_mm", depth_previous_mm, (camera.height, camera.width))
    check_shape("to_previous", to_previous, (camera.height, camera.width, 2))
    rays = camera.rays
    slope = T_current_previous[2, :3].astype(np.float32)
    x = rays[..., 0] + to_previous[..., 0] / np.float32(camera.fx)
    y = rays[..., 1] + to_previous[..., 1] / np.float32(camera.fy)
    moved = depth_previous_mm * (slope[0] * x + slope[1] * y + slope[2]) + np.float32(T_current_previous[2, 3])
    return np.where(moved > 0, moved, np.float32(np.nan))


def bilinear(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return an image (H, W, C) at places (N, 2) x, y within it, (N, C), bilinear; also none or more than 32767."""
    corner = np.clip(np.floor(places).astype(int), 0, [image.shape[1] - 2, image.shape[0] - 2])
    x, y = corner.T
    a, b = (places - corner).T[..., None]
    top = (1 - a) * image[y, x] + a * image[y, x + 1]
    bottom = (1 - a) * image[y + 1, x] + a * image[y + 1, x + 1]
    return np.asarray((1 - b) * top + b * bottom)


def resampled(values: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Return floats (H, W) of the same view at the size of `camera`, bilinear; nearest where that meets NaN."""
    size = camera.width, camera.height
    if values.shape == size[::-1]:
        return values
    smooth = cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)
    return np.where(np.isnan(smooth), cv2.resize(values, size, interpolation=cv2.INTER_NEAREST), smooth)


def bilateral_filtered(depth_mm: np.ndarray, sigma_px: float, sigma_mm: float) -> np.ndarray:
    """Smooth depth (H, W) float32 within surfaces, not across edges (equation 2 of arXiv 2508.11282).

    NaN pixels stay NaN and do not count.
    """
    known = np.isfinite(depth_mm)
    if sigma_px <= 0 or not known.any():
        return depth_mm
    away = np.float32(depth_mm[known].max() + 100.0 * sigma_mm)
    smooth = cv2.bilateralFilter(np.where(known, depth_mm, away), -1, sigma_mm, sigma_px)
    return np.where(known, smooth, np.float32(np.nan))
