"""Pictures that a camera wrote turned or mirrored, with a note of how they are to be shown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def turns_sideways(matrix: Sequence[int]) -> bool:
    """Return whether a display matrix (see `upright`) swaps width and height."""
    return abs(matrix[1]) > abs(matrix[0])


def upright(picture: np.ndarray, matrix: Sequence[int]) -> np.ndarray:
    """Return a picture (h, w, 3) as it is to be shown by a display matrix, to the nearest quarter turn.

    `matrix` is that of ISO/IEC 14496-12, 9 numbers a b u c d v x y w: a pixel at (x, y) is shown at
    (a x + c y, b x + d y), up to a shift.
    """
    across, down = matrix[0], matrix[4]
    if turns_sideways(matrix):
        picture, across, down = picture.transpose(1, 0, 2), matrix[3], matrix[1]
    return np.ascontiguousarray(picture[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])
