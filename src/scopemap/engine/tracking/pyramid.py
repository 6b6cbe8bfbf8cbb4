"""Image pyramids for tracking: masked means, so that highlights and borders do not bleed into coarse levels."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import TrackingSettings
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.kernels import Float32_2d, kernel
from scopemap.engine.geometry.local_contrast import local_contrast, local_mean
from scopemap.engine.tracking.residuals import PyramidLevel

# By hand: grey levels per residual unit without local normalisation: residuals of order one either way.
_GREY_UNIT = 32.0
_SLOPE_SIGMA_PX = 1.5  # by hand: of the smoothing of depth before its slope is measured
_NORMALISE_SIGMA_PX = 2.0  # chosen on cecum_t1_a (C3VD) and four phantoms: of the local mean and deviation
_MIN_SIDE_PX = 16  # the paper's section WEMA-RTDL: no level is smaller
_NOISE_LEVEL = 2.0  # by hand: grey levels of local deviation below which an area counts as flat


def build_pyramid(
    frame: Frame, settings: TrackingSettings, *, use_slope: bool = False, levels: int | None = None
) -> list[PyramidLevel]:
    """Return the levels from `finest_level` (first) to the coarsest (last), each half the size of the one before.

    use_slope : take tangent planes from the depth; only for measured depth, since slopes of predicted depth follow the
    colour of the tissue. Else every plane is parallel to the image. levels : number of levels; None: down to a short
    side of 16 px. A frame without depth gives a pyramid that can be aligned to a reference, but cannot be one.
    """
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    weight = frame.valid.astype(np.float32)
    depth = np.full(grey.shape, np.nan, np.float32)
    if frame.depth_mm is not None:
        depth = np.where(frame.valid, frame.depth_mm, np.float32(np.nan))
    finest = min(settings.finest_level, settings.levels - 1)
    count = settings.levels if levels is None else finest + levels
    camera = frame.camera
    pyramid: list[PyramidLevel] = []
    for level in range(count):
        if level > 0:
            width, height = camera.width // 2, camera.height // 2
            if pyramid and min(width, height) < _MIN_SIDE_PX:
                break
            # An odd last row or column has no partner: without it, pixels, depth and camera halve alike.
            camera = replace(camera, width=2 * width, height=2 * height)
            grey, weight, depth = (p[: 2 * height, : 2 * width] for p in (grey, weight, depth))
            grey, weight = _halve_image(grey, weight, (width, height))
            known = frame.depth_mm is not None
            depth = _halve_depth(np.ascontiguousarray(depth)) if known else np.full((height, width), np.nan, np.float32)
            camera = camera.resized(width, height)
        if level >= finest:
            slope = _slope(depth, camera) if use_slope else np.zeros((*depth.shape, 2), np.float32)
            intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
            pyramid.append(PyramidLevel(_channels(grey, weight), weight, depth, slope, intrinsics))
    return pyramid


def texture(frame: Frame, settings: TrackingSettings) -> float:
    """Return the root mean square of a picture's locally normalised channel over usable pixels, 0..1.

    Tissue that fills the picture, heavy blur and fluid leave noise alone.
    """
    level = build_pyramid(replace(frame, depth_mm=None), settings, levels=1)[0]
    weight = level.weight.sum()
    return float(np.sqrt((level.channels[1] ** 2 * level.weight).sum() / weight)) if weight else 0.0


def _slope(depth_mm: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Derivative of smoothed inverse depth along the ray's x and y, (H, W, 2) 1/mm; 0 where depth is unknown."""
    known = np.isfinite(depth_mm).astype(np.float32)
    if not known.any():
        return np.zeros((*depth_mm.shape, 2), np.float32)
    nearness = np.divide(1.0, depth_mm, out=np.zeros_like(depth_mm), where=known > 0)
    share = np.maximum(cv2.GaussianBlur(known, (0, 0), _SLOPE_SIGMA_PX), 1e-6)
    smooth = np.where(share > 0.5, cv2.GaussianBlur(nearness, (0, 0), _SLOPE_SIGMA_PX) / share, np.nan)
    along_y, along_x = np.gradient(smooth)
    return np.nan_to_num(np.stack([camera.fx * along_x, camera.fy * along_y], -1)).astype(np.float32)


def _channels(grey: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Grey values, and those less their local mean over their local deviation, (2, H, W) float32."""
    detail = (grey - local_mean(grey, _NORMALISE_SIGMA_PX, weight)) * weight
    normalised = local_contrast(detail, _NORMALISE_SIGMA_PX, weight, noise=_NOISE_LEVEL)
    return np.stack([grey / _GREY_UNIT, normalised]).astype(np.float32)


def _halve_image(grey: np.ndarray, weight: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(grey * weight, size, interpolation=cv2.INTER_AREA) / np.maximum(share, 1e-6)
    return mean, (share > 0.5).astype(np.float32)


@kernel
def _halve_depth(depth_mm: Float32_2d) -> np.ndarray:
    """Mean of the known depths of four pixels on the nearest of their surfaces (within 5 %)."""
    h, w = depth_mm.shape[0] // 2, depth_mm.shape[1] // 2
    out = np.empty((h, w), np.float32)
    for row in range(h):
        for column in range(w):
            nearest, total, count = np.inf, 0.0, 0
            for n in range(4):
                depth = depth_mm[2 * row + n // 2, 2 * column + n % 2]
                nearest = depth if depth < nearest else nearest
            for n in range(4):
                depth = depth_mm[2 * row + n // 2, 2 * column + n % 2]
                if depth <= 1.05 * nearest:
                    total, count = total + depth, count + 1
            out[row, column] = total / count if count > 0 else np.nan
    return out
