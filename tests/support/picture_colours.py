"""Pictures as they were written, and where they have a colour."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def read(file: Path) -> np.ndarray:
    """Return the picture, (h, w, 3) uint8, RGB."""
    return cv2.imread(str(file))[..., ::-1]


def is_colour(picture: np.ndarray, colour: str, within: int = 12) -> np.ndarray:
    """Return which pixels, (h, w), have a colour such as #1F77B4, within so many levels."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return np.asarray(np.abs(picture.astype(int) - rgb).max(-1) < within)
