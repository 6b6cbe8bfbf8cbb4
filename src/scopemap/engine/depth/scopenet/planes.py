"""Input planes of the network: colour, brightness, ray directions and valid pixels."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.engine.errors import check_shape
from scopemap.engine.geometry.srgb import LINEAR

PLANES = 8  # the network's input, as trained: colour, log brightness, rays and valid mask
INSTRUMENTS = "instruments"  # name of that output
STRIDE = 32  # of the network: both sides of its input are multiples
# Below this linear brightness (sRGB level 3 of 255) there is only noise.
_DARKEST = 1e-3  # guard
_HALF_LINEAR = (0.5 * LINEAR).astype(np.float32)  # brightness is the mean of red and green


def input_planes(rgb: np.ndarray, unit_rays: np.ndarray | None, valid: np.ndarray) -> np.ndarray:
    """Return the network's input (8, H, W) float32.

    rgb : (H, W, 3) uint8, sRGB.
    unit_rays : (H, W, 3) float32 directions of length 1, camera axes; None = unknown, zeros.
    valid : (H, W) bool, where usable tissue shows.

    Planes: red, green, blue (-0.5..0.5), ln of the linear brightness of red and green against the median of the valid
    pixels (a cue for distance that does not depend on exposure), ray x, y, z, valid (0 or 1).
    """
    height, width = valid.shape
    check_shape("rgb", rgb, (height, width, 3))
    planes = np.zeros((PLANES, height, width), np.float32)
    planes[:3] = rgb.transpose(2, 0, 1) * np.float32(1 / 255) - np.float32(0.5)
    linear = cv2.LUT(rgb[..., 0], _HALF_LINEAR) + cv2.LUT(rgb[..., 1], _HALF_LINEAR)
    brightness = np.log(np.maximum(linear, np.float32(_DARKEST)))
    planes[3] = 0.5 * (brightness - (np.median(brightness[valid]) if valid.any() else 0.0))
    if unit_rays is not None:
        check_shape("unit_rays", unit_rays, (height, width, 3))
        planes[4:7] = unit_rays.transpose(2, 0, 1)
    planes[7] = valid
    return planes
