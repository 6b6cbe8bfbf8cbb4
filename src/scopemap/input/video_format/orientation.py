"""How the pictures of a video are to be shown: its display matrix."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from av.video.frame import VideoFrame


def upright(rgb: np.ndarray, matrix: Sequence[int]) -> np.ndarray:
    """Return a picture (h, w, 3) rotated and mirrored by a display matrix, to the nearest quarter turn.

    `matrix` is that of ISO/IEC 14496-12, 9 numbers a b u c d v x y w: a pixel at (x, y) is shown at
    (a x + c y, b x + d y), up to a shift.
    """
    across, down = matrix[0], matrix[4]
    if swaps_sides(matrix):
        rgb, across, down = rgb.transpose(1, 0, 2), matrix[3], matrix[1]
    return np.ascontiguousarray(rgb[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def swaps_sides(matrix: Sequence[int]) -> bool:
    """Return whether a display matrix turns a picture on its side."""
    return abs(matrix[1]) > abs(matrix[0])


def display_matrix(frame: VideoFrame) -> tuple[int, ...] | None:
    """Return the 9 numbers that say how a frame is to be shown, None where nothing does."""
    stated: Any = frame.side_data.get("DISPLAYMATRIX")
    return None if stated is None else struct.unpack("=9i", bytes(stated)[: 9 * 4])
