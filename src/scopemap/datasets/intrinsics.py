"""Intrinsics as a matrix in a text file, as several data sets publish them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.camera import PinholeCamera
from scopemap.errors import CalibrationError

_MATRIX_SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}


def read_intrinsics(file: Path, size: tuple[int, int]) -> PinholeCamera:
    """Return the pinhole camera of a text file for images of `size` (width, height), px.

    The file holds a 3x3, 3x4 or 4x4 matrix, in as many lines as it likes. Raises `CalibrationError` for anything else,
    and for a camera that cannot be one of these images.
    """
    try:
        numbers = np.array(file.read_text(encoding="utf-8").replace(",", " ").split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise CalibrationError(f"cannot read the intrinsics in {file}: {error}") from None
    if numbers.size not in _MATRIX_SHAPES:
        raise CalibrationError(
            f"the intrinsics {file} hold {numbers.size} numbers: expected a matrix of 3x3, 3x4 or 4x4 (9, 12 or 16)"
        )
    K = numbers.reshape(_MATRIX_SHAPES[numbers.size])[:3, :3]
    upright = np.allclose([K[1, 0], K[2, 0], K[2, 1], K[2, 2] - 1], 0)
    (fx, _, cx), (_, fy, cy) = K[:2]
    width, height = size
    if not (upright and fx > 0 and fy > 0 and 0 <= cx < width and 0 <= cy < height):
        raise CalibrationError(
            f"the intrinsics {file} are not those of images of {width}x{height} px: found focal length {fx:g}, {fy:g} "
            f"and principal point {cx:g}, {cy:g} px"
        )
    return PinholeCamera(float(fx), float(fy), float(cx), float(cy), width, height)
