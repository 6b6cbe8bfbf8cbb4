"""What the network sees: its input planes, and pictures whose colour tells nothing of distance.

Blood absorbs green and blue, and hardly red: pale and dark tissue differ least in red, and what remains is the lamp's
fall-off. So a picture in the tissue's one colour, and in grey, by the brightness of red, asks the network once more.
Where red saturates, the picture's own colours are all there is.
"""

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
# Linear red from which on it counts less, and from which on it does not count: sRGB levels 188 and 237.
_SATURATES = 0.5
_SATURATED = 0.85  # sRGB level 237
_LINEAR = LINEAR.astype(np.float32)
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


def one_colour(rgb: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an sRGB picture (H, W, 3) uint8 in the median colour of its valid pixels (H, W) bool, and that in grey.

    Without valid pixels the first is the picture itself.
    """
    linear = _LINEAR[rgb]
    if valid.any():
        tint = np.maximum(np.median(linear[valid], axis=0), _DARKEST)
        red = linear[..., :1]
        kept = np.clip((red - _SATURATES) / (_SATURATED - _SATURATES), 0, 1)
        linear = (1 - kept) * red * (tint / tint[0]) + kept * linear
    grey = np.broadcast_to(linear[..., :2].mean(-1, keepdims=True), linear.shape)
    return _srgb(linear), _srgb(grey)


def _srgb(linear: np.ndarray) -> np.ndarray:
    return np.rint(np.interp(linear, LINEAR, np.arange(256))).astype(np.uint8)
