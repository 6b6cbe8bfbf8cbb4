"""Files of nothing but numbers: a line fx fy cx cy [k1 k2 p1 p2 [k3]], a camera matrix, a toolbox' polynomial."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats import ocamcalib
from scopemap.cameras.formats.contents import calibration_text
from scopemap.cameras.formats.lens_models import with_lens
from scopemap.cameras.formats.stated import Calibration, Size, intrinsics_of, pinhole_of
from scopemap.errors import CalibrationError

_MATRIX_SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
_LINE_COUNTS = (4, 8, 9, 12)
_BETWEEN = str.maketrans(",;[]", "    ")


def rows_in(text: str) -> list[list[float]] | None:
    """Return the numbers of each line that has some, comments after # aside; None where there is anything else.

    Commas, semicolons and square brackets may stand between them.
    """
    lines = (line.partition("#")[0].translate(_BETWEEN) for line in text.splitlines() if line.strip())
    try:
        rows = [[float(word) for word in line.split()] for line in lines]
    except ValueError:
        return None
    return [row for row in rows if row]


def of_rows(rows: list[list[float]], image_size: Size) -> Calibration:
    """Return the camera of lines of numbers; `ValueError` where their counts are those of no form."""
    if ocamcalib.is_polynomial(rows):
        return ocamcalib.of_rows(rows)
    values = [value for row in rows for value in row]
    if not np.isfinite(values).all():
        raise ValueError("it holds NaN or infinity")
    if _is_matrix(rows, values):
        (intrinsics, note), coefficients = intrinsics_of(_matrix(values)), []
    elif len(values) in _LINE_COUNTS:
        note, intrinsics, coefficients = "", (values[0], values[1], values[2], values[3]), values[4:]
    else:
        raise ValueError(
            f"it holds {len(values)} numbers: expected fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]], or a camera matrix "
            "of 3x3, 3x4 or 4x4"
        )
    pinhole, origin = pinhole_of(intrinsics, None, image_size)
    return Calibration(with_lens(pinhole, "", coefficients)[0], None, note, origin)


def read_intrinsics(file: Path, size: Size) -> PinholeCamera:
    """Return the pinhole camera of a text file for images of `size` (width, height), px.

    The file holds a 3x3, 3x4 or 4x4 matrix, in as many lines as it likes. Raises `CalibrationError` for anything else,
    and for a camera that cannot be one of these images.
    """
    try:
        numbers = np.array(calibration_text(file).replace(",", " ").split(), dtype=np.float64)
    except ValueError as error:
        raise CalibrationError(f"cannot read the intrinsics in {file}: {error}") from None
    if numbers.size not in _MATRIX_SHAPES:
        raise CalibrationError(
            f"the intrinsics {file} hold {numbers.size} numbers: expected a matrix of 3x3, 3x4 or 4x4 (9, 12 or 16)"
        )
    K = _matrix(numbers)
    try:
        (fx, fy, cx, cy), _ = intrinsics_of(K)
    except ValueError as error:
        raise CalibrationError(f"the intrinsics {file}: {error}") from None
    width, height = size
    if not (fx > 0 and fy > 0 and 0 <= cx < width and 0 <= cy < height):
        raise CalibrationError(
            f"the intrinsics {file} are not those of images of {width}x{height} px: found focal length {fx:g}, {fy:g} "
            f"and principal point {cx:g}, {cy:g} px"
        )
    return PinholeCamera(fx, fy, cx, cy, width, height)


def _is_matrix(rows: list[list[float]], values: list[float]) -> bool:
    """Whether the numbers are a matrix, which 9 and 12 are not when they stand in one line as fx fy cx cy k1 ..."""
    if len(values) not in _MATRIX_SHAPES:
        return False
    height, width = _MATRIX_SHAPES[len(values)]
    K = np.reshape(values, (height, width))[:, :3]
    is_one = any([M[1, 0], *M[2]] == [0, 0, 0, 1] for M in (K, K.T) if M.shape == (3, 3))
    return height == 4 or [len(row) for row in rows] == [width] * height or is_one


def _matrix(values: list[float] | np.ndarray) -> np.ndarray:
    return np.reshape(np.asarray(values, dtype=np.float64), _MATRIX_SHAPES[len(values)])[:3, :3]
