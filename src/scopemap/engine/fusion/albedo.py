"""Colours of the tissue: what a frame would look like if the lamp lit all of it alike, in one exposure for all frames.

The lamp is at the camera. The brightness of a picture (sRGB level, not light) of a surface at distance d, under the
cosine of incidence c and the angle a off the optical axis is modelled as

    level = gain * albedo * c^0.1 * d^-0.8 * (cos a)^0.8

Exponents are fitted to levels of the same points in different frames. d^-2 and sRGB's 1 / 2.2 would give d^-0.9; the
cosine counts little, because predicted normals are noisy and tissue lights tissue. The light is bounded: dark pixels
are noise, and bright ones clipped.
"""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.fusion.tsdf import BLOCK, MeasuredSurface, TsdfCamera, measure_surface
from scopemap.engine.fusion.voxel_blocks import VoxelBlocks
from scopemap.engine.geometry.kernels import Float32_2d, UInt8_3d, kernel

_COSINE_POWER = 0.1  # fitted with the next two on three real clips and two phantoms (docs/method.md, Fusion)
_DISTANCE_POWER = 0.8  # fitted: -0.71 to -0.95 in each; sRGB and an inverse square give 0.9
_AXIS_POWER = 0.8  # fitted
_LEAST_LOG_COSINE = np.float32(np.log(0.1))  # guard: grazing incidence
_SMOOTH_SHARE = 1 / 30  # by hand: of the picture's width: cosines are averaged so far, predicted normals are noisy
_STEEPEST = 10.0  # by hand: tangent of the incidence up to which neighbouring pixels of a rendering are one surface
# Bound, approached smoothly, of the light of a pixel over the frame's median light, and of its inverse.
_MOST_LIGHT = 3.0  # by hand
_SATURATED_LEVEL = 250  # by hand: level of a clipped channel
# A clipped channel has lost its share of the hue; where no other frame has the place it is better than nothing.
_SATURATED_WEIGHT = 0.02  # by hand
_STEP_PX = 8  # by hand: between the pixels that are compared with what is fused
_LEAST_OVERLAP = 50  # by hand: of such pixels
# Share of the overlap in a gain: an error of the light's model must not grow along a path.
_FOLLOWED = 0.75  # by hand
_GREY = np.array([0.299, 0.587, 0.114], np.float32)  # luma of ITU-R BT.601


class AlbedoPainter:
    """Turns the frames that are fused, in order, into pictures of albedo in one exposure."""

    _log_level: float | None = None

    def __init__(self) -> None:
        self._median_levels = list[float]()

    @property
    def median_level(self) -> float | None:
        """Median over the frames of their median grey level, 0..255; None before the first."""
        return float(np.median(self._median_levels)) if self._median_levels else None

    def paint(
        self, rgb: np.ndarray, surface: MeasuredSurface, camera: TsdfCamera, blocks: VoxelBlocks, voxel_mm: float
    ) -> np.ndarray:
        """Return albedo r g b, levels that may exceed 255, and the weight of each pixel's colour, (H, W, 4) float32.

        rgb : (H, W, 3) uint8. blocks : what is fused so far; the frame's exposure is brought to it.
        Weights prefer near and frontal views, and hardly count a saturated channel.
        """
        light = relative_light(surface, camera)
        row, col = np.mgrid[_STEP_PX // 2 : len(rgb) : _STEP_PX, _STEP_PX // 2 : rgb.shape[1] : _STEP_PX].reshape(2, -1)
        shown = light[row, col] > 0
        row, col = row[shown], col[shown]
        if not row.size:
            return _painted(rgb, surface.inverse_depth, light)
        levels = rgb[row, col] @ _GREY
        self._median_levels.append(float(np.median(levels)))
        rays = np.stack([(col - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(len(row))], axis=-1)
        points = (rays / surface.inverse_depth[row, col, None] - camera.t) @ camera.R
        log_gain = self._log_gain(levels / light[row, col], _fused_levels(points, blocks, voxel_mm))
        return _painted(rgb, surface.inverse_depth, light * np.float32(math.exp(-log_gain)))

    def _log_gain(self, levels: np.ndarray, fused: np.ndarray) -> float:
        """Return ln of the gain that brings levels (N,) to those that are fused at their places, NaN where none are."""
        log_level = math.log(max(float(np.median(levels)), 1.0))
        if self._log_level is None:
            self._log_level = log_level
        usual = self._log_level - log_level
        known = np.isfinite(fused) & (levels > 1)
        if known.sum() < _LEAST_OVERLAP:
            return usual
        overlap = float(np.median(np.log(np.maximum(fused[known], 1.0) / levels[known])))
        return _FOLLOWED * overlap + (1 - _FOLLOWED) * usual


def relative_light(surface: MeasuredSurface, camera: TsdfCamera) -> np.ndarray:
    """Return the light of each pixel over the image's median, (H, W) float32, 1/3..3; NaN where depth is unknown."""
    inverse_depth = surface.inverse_depth
    log_ray = _log_rays(inverse_depth.shape, camera[2:])
    with np.errstate(divide="ignore", invalid="ignore"):
        log_distance = log_ray - np.log(inverse_depth)
        log_cosine = np.log(surface.plane_mm) - log_distance
    known = np.isfinite(log_distance)
    log_cosine = _mean(np.where(known, np.maximum(log_cosine, _LEAST_LOG_COSINE), np.float32(0)), known)
    log_light = _COSINE_POWER * log_cosine - _DISTANCE_POWER * log_distance - _AXIS_POWER * log_ray
    some = log_light[::3, ::3][known[::3, ::3]]
    log_light -= np.median(some) if some.size else np.float32(0)
    most = np.log(np.float32(_MOST_LIGHT))
    return np.exp(most * np.tanh(log_light / most))


@lru_cache(maxsize=4)
def _log_rays(shape: tuple[int, int], intrinsics: tuple[float, ...]) -> np.ndarray:
    """Return the logarithms (H, W) float32 of the lengths of the rays, z = 1, of a camera's fx, fy, cx, cy."""
    fx, fy, cx, cy = intrinsics
    x, y = (np.arange(shape[1]) - cx) / fx, (np.arange(shape[0]) - cy) / fy
    return np.asarray(0.5 * np.log1p(x**2 + y[:, None] ** 2).astype(np.float32))


def lit_by_lamp(rgb: np.ndarray, depth_mm: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    """Return a picture of albedo (H, W, 3) under the lamp, levels that may exceed 255, float32; 0 without depth.

    The light is smoothed: the roughness of a rendered mesh, unlike its colours, is noise of single voxels.
    """
    pinhole = TsdfCamera(np.eye(3), np.zeros(3), camera.fx, camera.fy, camera.cx, camera.cy)
    inverse_depth = np.asarray(1 / depth_mm, np.float32)
    surface = measure_surface(inverse_depth, pinhole, _STEEPEST / camera.fx, 0.0, np.inf)
    # Beside depth edges the slope is unknown: a surface that faces the lamp.
    unknown = np.isnan(surface.inverse_depth)
    facing_mm = depth_mm * _ray_lengths(camera)
    plane_mm = np.where(unknown, facing_mm, surface.plane_mm).astype(np.float32)
    light = relative_light(MeasuredSurface(inverse_depth, plane_mm, surface.weight), pinhole)
    known = light > 0
    log_light = _mean(np.log(light, out=np.zeros_like(light), where=known), known)
    return rgb * cv2.cvtColor(np.where(known, np.exp(log_light), np.float32(0)), cv2.COLOR_GRAY2RGB)


@lru_cache(maxsize=4)
def _ray_lengths(camera: PinholeCamera) -> np.ndarray:
    """Return the lengths (H, W) float32 of a camera's rays."""
    x, y, z = np.moveaxis(camera.rays, -1, 0)
    return np.sqrt(x * x + y * y + z * z)


def displayed(colours: np.ndarray, median_level: float | None) -> np.ndarray:
    """Return colours (V, 3) scaled to a median grey level, 0..255, in their hue; None: as they are."""
    if median_level is None or not len(colours):
        return colours
    scaled = colours * (median_level / max(float(np.median(colours @ _GREY)), 1.0))
    return scaled * np.minimum(1.0, 255.0 / np.maximum(scaled.max(axis=1, keepdims=True), 1.0))


def _mean(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the local mean of values (H, W) float32, 0 where they are unknown, over the known pixels (H, W) bool."""
    window = (max(1, round(_SMOOTH_SHARE * known.shape[1])),) * 2
    return cv2.blur(values, window) / np.maximum(cv2.blur(known.astype(np.float32), window), np.float32(1e-6))


@kernel
def _painted(rgb: UInt8_3d, inverse_depth: Float32_2d, light: Float32_2d) -> np.ndarray:
    """Return rgb / light and the weight of each pixel's colour, (H, W, 4) float32; 0 where light is NaN."""
    height, width = light.shape
    result = np.zeros((height, width, 4), np.float32)
    for row in range(height):
        for col in range(width):
            if light[row, col] > 0:
                most = 0
                for channel in range(3):
                    most = max(most, rgb[row, col, channel])
                    result[row, col, channel] = rgb[row, col, channel] / light[row, col]
                weight = inverse_depth[row, col] ** 2
                result[row, col, 3] = weight if most < _SATURATED_LEVEL else _SATURATED_WEIGHT * weight
    return result


def _fused_levels(points: np.ndarray, blocks: VoxelBlocks, voxel_mm: float) -> np.ndarray:
    """Return the grey level that is fused in the voxel next to each point (N, 3), (N,), NaN where there is none."""
    voxel = np.rint(points / voxel_mm).astype(np.int64)
    slots = blocks.find(voxel // BLOCK)
    colour = blocks.voxels.colour[(slots, *(voxel % BLOCK).T)]
    seen = (slots > 0) & (colour[:, 3] > 0)
    return np.divide(colour[:, :3] @ _GREY, colour[:, 3], out=np.full(len(points), np.nan, np.float32), where=seen)
