"""Calibration files of numbers alone, OCamCalib's among them; and Calibu's XML."""

from __future__ import annotations

import re

import numpy as np

from scopemap.input.camera_files.calibration import Calibration, Size, check_size, pinhole_of
from scopemap.input.camera_files.lens import with_lens
from scopemap.input.camera_files.parsing import Fields, xml_root
from scopemap.input.camera_files.scaramuzza import of_ocamcalib

_MATRIX_SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
_LINE_COUNTS = (4, 8, 9, 12)
# A skew is passed over up to the first share of the focal length, with a note up to the second.
_SLIGHT_SKEW = 1e-3
_MOST_SKEW = 1e-2
_CALIBU_PINHOLE = "calibu_fu_fv_u0_v0"
_CALIBU_PARAMETERS = {_CALIBU_PINHOLE: 4, f"{_CALIBU_PINHOLE}_k1_k2": 6, f"{_CALIBU_PINHOLE}_kb4": 8}
_SMALLEST_SIDE_PX = 64


def of_numbers(rows: list[list[float]], image_size: Size) -> Calibration:
    """Return the camera of a matrix, fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]] or OCamCalib's; else `ValueError`.

    Behind a matrix of 3x3 may be lines of coefficients (SciKit-Surgery), behind all one of width and height.
    """
    if not all(np.isfinite(row).all() for row in rows):
        raise ValueError("it holds NaN or infinity")
    if [len(row) for row in rows[2:]] == [2, 3, 2] and all(row[0] == len(row) - 1 for row in rows[:2]):
        (_, *polynomial), _, centre, affine, size = rows
        return Calibration(of_ocamcalib(polynomial, centre, affine, size), None, "")
    stated = _size_in(rows)
    rows = rows[:-1] if stated else rows
    values = [value for row in rows for value in row]
    note, coefficients = "", list[float]()
    if [len(row) for row in rows[:3]] == [3, 3, 3] and len(rows) > 3:
        (intrinsics, note), coefficients = intrinsics_of(np.array(rows[:3])), values[9:]
    elif _is_matrix(rows, values):
        intrinsics, note = intrinsics_of(np.reshape(values, _MATRIX_SHAPES[len(values)]))
    elif len(values) in _LINE_COUNTS:
        intrinsics, coefficients = values[:4], values[4:]
    else:
        expected = "expected fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]], or a camera matrix of 3x3, 3x4 or 4x4"
        raise ValueError(f"it holds {len(values)} numbers: {expected}")
    pinhole, origin = pinhole_of(intrinsics, stated, image_size)
    return Calibration(with_lens(pinhole, "", coefficients)[0], None, note, origin)


def _size_in(rows: list[list[float]]) -> Size | None:
    """Return width and height of the last row, None where that is no size."""
    last = rows[-1] if len(rows) > 1 else []
    is_size = len(last) == 2 and all(side % 1 == 0 and side >= _SMALLEST_SIDE_PX for side in last)
    return check_size(*last) if is_size else None


def intrinsics_of(K: np.ndarray) -> tuple[list[float], str]:
    """Return fx fy cx cy of a camera matrix, transposed or not, and a note; `ValueError` where it is none.

    Of a matrix (3, 4) or (4, 4) it is the upper left (3, 3).
    """
    K, note = K[:3, :3], ""
    if not K.any():
        raise ValueError("its camera matrix is all zero, which ROS writes for a camera that was not calibrated")
    if not _has_last_row(K) and _has_last_row(K.T):
        K, note = K.T, ", its matrix transposed"
    if not _has_last_row(K):
        rows = "; ".join(" ".join(f"{value:g}" for value in row) for row in K)
        raise ValueError(f"its matrix is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1], found {rows}")
    (fx, skew, cx), (_, fy, cy) = K[:2].tolist()
    return [fx, fy, cx, cy], note + without_skew(skew, fx)


def without_skew(skew: float, fx: float) -> str:
    """Return the note on a skew, px, that is left out, "" where it is nothing; `ValueError` where it is too large."""
    if abs(skew) > _MOST_SKEW * abs(fx):
        raise ValueError(f"its camera matrix has a skew of {skew:g}, which no camera here has")
    return f", its skew of {skew:g} px left out" if abs(skew) > _SLIGHT_SKEW * abs(fx) else ""


def _has_last_row(K: np.ndarray) -> bool:
    return np.allclose([K[1, 0], *K[2]], [0, 0, 0, 1])


def _is_matrix(rows: list[list[float]], values: list[float]) -> bool:
    """Return whether the numbers are a matrix; 9 or 12 in one line may be fx fy cx cy k1 ... instead."""
    if len(values) not in _MATRIX_SHAPES:
        return False
    height, width = _MATRIX_SHAPES[len(values)]
    K = np.reshape(values, (height, width))[:3, :3]
    return height == 4 or [len(row) for row in rows] == [width] * height or _has_last_row(K) or _has_last_row(K.T)


def calibu_fields(text: str) -> Fields:
    """Return the mapping of Calibu's XML (EndoMapper): `rig` > `camera` > `camera_model type="calibu_..."`.

    `calibu_fu_fv_u0_v0` is a pinhole, `..._k1_k2` has OpenCV's two radial terms, `..._kb4` is Kannala-Brandt's fisheye.
    Raises `ValueError` for anything else.
    """
    model = xml_root(text).find(".//camera_model")
    kind = "" if model is None else model.get("type", "")
    if model is None or kind not in _CALIBU_PARAMETERS:
        raise ValueError(f"the type {kind[:40]!r} of its camera_model is not known ({', '.join(_CALIBU_PARAMETERS)})")
    values = re.findall(r"[^\s\[\];,]+", model.findtext("params", ""))
    if len(values) != _CALIBU_PARAMETERS[kind]:
        raise ValueError(f"it holds {len(values)} parameters, expected {_CALIBU_PARAMETERS[kind]} finite ones")
    lens = [*values[4:], "0", "0"] if len(values) == 6 else values[4:]
    size = [("image_width", model.findtext("width")), ("image_height", model.findtext("height"))]
    name = "fisheye" if len(values) == 8 else "opencv"
    return Fields([*size, ("intrinsics", values[:4]), ("distortion_coefficients", lens), ("model", name)])
