"""Depth from near-field shading, without weights: brightness falls with a power of the distance along the ray."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.depth.guided import filled, guided_filter
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.srgb import LINEAR

# Of what is by trial: on the real frames of `scopemap_bench.scripts.depth_without_download`.
_EXPONENT = 0.6  # by trial: distance = k * brightness^-exponent; an inverse square gives 0.5
# Red alone saturates on near tissue, green alone follows the blood, blue is mostly noise.
_CHANNEL_WEIGHTS = np.array([0.5, 0.5, 0.0], dtype=np.float32)
# Below this linear brightness (sRGB level 3 of 255) there is only noise: it bounds the distance.
_DARKEST = 1e-3  # guard
# Lamp emission and lens vignetting together fall with about the first power of the angle's cosine.
_LAMP_COSINE_POWER = 1.0  # by trial
_DARK_LEVEL = 12  # by trial: as that of `masking/masker.py`
_SATURATED_LEVEL = 250  # by trial: grey level of green that is clipped
_HIGHLIGHT_RATIO = 2.0  # by trial: of a highlight's brightness over its wide surroundings'
_HIGHLIGHT_WHITENESS = 0.6  # by trial: of a highlight's darkest channel over its brightest
# Shares of the image width: smoothing window, largest hole that is filled.
_WINDOW_SHARE = 0.04  # by trial
_REACH_SHARE = 0.1  # by trial
# Deviation of log brightness in a window above which it is taken for shape, not for texture.
_EDGE_LOG = 0.8  # by trial
# A frame with less usable tissue cannot fix the scale: the next one is tried.
_MIN_SHARE = 0.02  # by trial


class ShadingDepth:
    """Depth estimator: distance along the ray = k * brightness^-exponent; its z is the depth.

    k is fixed on the first usable frame, by the stated prior that the tissue's median distance there is
    `settings.shading_median_mm`, and kept from then on, so that depth shrinks as the camera approaches.
    """

    scale_mm: float | None = None
    """k; None until it is fixed."""
    name = "shading"

    def __init__(self, settings: DepthSettings) -> None:
        self._settings = settings

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return depth in mm by the prior, kind "depth", (H, W) float32.

        Highlights and over-exposed pixels are filled from around them. NaN: dark or masked pixels without usable
        neighbours; everything, as long as no frame had usable pixels.
        """
        unit_z = 1 / np.linalg.norm(frame.camera.rays, axis=-1)
        distance = _relative_distance(frame, unit_z)
        if self.scale_mm is None:
            seen = distance[frame.valid & np.isfinite(distance)]
            if seen.size >= _MIN_SHARE * distance.size:
                self.scale_mm = self._settings.shading_median_mm / float(np.median(seen))
        scale_mm = np.nan if self.scale_mm is None else self.scale_mm
        return DepthEstimate((scale_mm * distance * unit_z).astype(np.float32), "depth")

    def provenance(self) -> dict[str, str]:
        """Return what the depth was made from."""
        return {
            "depth": "near-field shading, embedded, no weights",
            "prior": f"median distance of the first frame {self._settings.shading_median_mm:g} mm",
            "exponent": f"{_EXPONENT:g}",
        }


def _relative_distance(frame: Frame, unit_z: np.ndarray) -> np.ndarray:
    """Return the distance along the ray up to a factor, (H, W) float32, NaN = unknown; unit_z : (H, W) of unit rays."""
    width = frame.camera.width
    brightness = linear_brightness(frame.rgb) / unit_z**_LAMP_COSINE_POWER
    log_brightness = np.log(np.maximum(brightness, _DARKEST)).astype(np.float32)
    radius_px = max(1, round(_WINDOW_SHARE * width))
    glare = _glare(frame.rgb, log_brightness, 2 * radius_px + 1)
    log_brightness = filled(log_brightness, frame.valid & ~glare, max(1, round(_REACH_SHARE * width)))
    known = np.isfinite(log_brightness) & (frame.rgb.max(-1) > _DARK_LEVEL)
    return np.exp(-_EXPONENT * guided_filter(log_brightness, known, radius_px, _EDGE_LOG))


def linear_brightness(rgb: np.ndarray) -> np.ndarray:
    """Return the mean linear red and green 0..1 (H, W) float32 of an sRGB image (H, W, 3) uint8."""
    return LINEAR.astype(np.float32)[rgb] @ _CHANNEL_WEIGHTS


def _glare(rgb: np.ndarray, log_brightness: np.ndarray, width_px: int) -> np.ndarray:
    """Return where light comes from a reflection narrower than `width_px` or beyond the sensor's range, (H, W) bool."""
    calm = cv2.blur(log_brightness, (3, 3))
    wide = cv2.morphologyEx(calm, cv2.MORPH_OPEN, np.ones((width_px, width_px), np.uint8))
    white = rgb.min(-1) > _HIGHLIGHT_WHITENESS * rgb.max(-1)
    glare = (rgb[..., 1] >= _SATURATED_LEVEL) | (white & (log_brightness - wide > np.log(_HIGHLIGHT_RATIO)))
    return cv2.dilate(glare.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
