"""Pictures whose colour tells nothing of distance: in the tissue's one colour, and in grey, by the brightness of red.

Blood absorbs green and blue, and hardly red: pale and dark tissue differ least in red, and what remains is the lamp's
fall-off. Where red saturates, the picture's own colours are all there is.
"""

from __future__ import annotations

import numpy as np

from scopemap.engine.geometry.srgb import LINEAR

# Linear red from which on it counts less, and from which on it does not count: sRGB levels 188 and 237.
_SATURATES = 0.5
_SATURATED = 0.85  # sRGB level 237
_DARKEST = 1e-3  # guard: sRGB level 3, below which there is only noise
_LINEAR = LINEAR.astype(np.float32)


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
