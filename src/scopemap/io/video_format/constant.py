"""Pictures that show nothing."""

from __future__ import annotations

import cv2
import numpy as np

_CONSTANT_RANGE = 4
# Width of the mean that leaves little of a sensor's noise.
_NOISE_WIDTH_PX = 9


def is_constant(rgb: np.ndarray) -> bool:
    """Return whether an image (H, W, 3) uint8 shows nothing: black, or one even colour up to noise."""
    calm = cv2.blur(rgb, (_NOISE_WIDTH_PX, _NOISE_WIDTH_PX))
    low, high = np.percentile(cv2.cvtColor(calm, cv2.COLOR_RGB2GRAY), [0.5, 99.5])
    return bool(high - low <= _CONSTANT_RANGE)
