"""The curve between linear light and the levels of sRGB (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np

_LEVEL = np.arange(256) / 255  # 8-bit levels, 0..1
LINEAR = np.where(_LEVEL <= 0.04045, _LEVEL / 12.92, ((_LEVEL + 0.055) / 1.055) ** 2.4)
"""Linear light, (256,) float64, 0..1, of each 8-bit level."""


def srgb_picture(linear: np.ndarray) -> np.ndarray:
    """Return the nearest 8-bit levels, uint8, of linear light 0..1, of any shape."""
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-6) ** (1 / 2.4) - 0.055)
    return np.rint(255 * encoded).astype(np.uint8)
