"""Calibration files of one tool each: OCamCalib's text, Calibu's XML, StereoMIS' INI; and files of numbers alone."""

from __future__ import annotations

import configparser
import re

import numpy as np

from scopemap.engine.cameras.lenses import OmnidirectionalCamera
from scopemap.input.camera_files.calibration import Calibration, Size, check_size, pinhole_of
from scopemap.input.camera_files.lens import with_lens
from scopemap.input.camera_files.parsing import MOST_TERMS, Fields, xml_root

_MATRIX_SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
_LINE_COUNTS = (4, 8, 9, 12)
# A skew is passed over up to the first share of the focal length, with a note up to the second.
_SLIGHT_SKEW = 1e-3
_MOST_SKEW = 1e-2
_CALIBU_PINHOLE = "calibu_fu_fv_u0_v0"
_CALIBU_PARAMETERS = {_CALIBU_PINHOLE: 4, f"{_CALIBU_PINHOLE}_k1_k2": 6, f"{_CALIBU_PINHOLE}_kb4": 8}
_STEREO_LEFT = "StereoLeft"


def of_numbers(rows: list[list[float]], image_size: Size) -> Calibration:
    """Return the camera of a matrix, fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]] or OCamCalib's; else `ValueError`."""
    values = [value for row in rows for value in row]
    if not np.isfinite(values).all():
        raise ValueError("it holds NaN or infinity")
    if [len(row) for row in rows[2:]] == [2, 3, 2] and all(row[0] == len(row) - 1 for row in rows[:2]):
        return Calibration(_of_ocamcalib(rows), None, "")
    if _is_matrix(rows, values):
        matrix = np.reshape(values, _MATRIX_SHAPES[len(values)])[:3, :3]
        (intrinsics, note), coefficients = intrinsics_of(matrix), list[float]()
    elif len(values) in _LINE_COUNTS:
        note, intrinsics, coefficients = "", values[:4], values[4:]
    else:
        expected = "expected fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]], or a camera matrix of 3x3, 3x4 or 4x4"
        raise ValueError(f"it holds {len(values)} numbers: {expected}")
    pinhole, origin = pinhole_of(intrinsics, None, image_size)
    return Calibration(with_lens(pinhole, "", coefficients)[0], None, note, origin)


def intrinsics_of(K: np.ndarray) -> tuple[list[float], str]:
    """Return fx fy cx cy of a camera matrix (3, 3), transposed or not, and a note; `ValueError` where it is none."""
    note = ""
    if not K.any():
        raise ValueError("its camera matrix is all zero, which ROS writes for a camera that was not calibrated")
    if not _has_last_row(K) and _has_last_row(K.T):
        K, note = K.T, ", its matrix transposed"
    if not _has_last_row(K):
        rows = "; ".join(" ".join(f"{value:g}" for value in row) for row in K)
        raise ValueError(f"its matrix is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1], found {rows}")
    (fx, skew, cx), (_, fy, cy) = K[:2].tolist()
    if abs(skew) > _MOST_SKEW * abs(fx):
        raise ValueError(f"its camera matrix has a skew of {skew:g}, which no camera here has")
    if abs(skew) > _SLIGHT_SKEW * abs(fx):
        note += f", its skew of {skew:g} px left out"
    return [fx, fy, cx, cy], note


def _has_last_row(K: np.ndarray) -> bool:
    return np.allclose([K[1, 0], *K[2]], [0, 0, 0, 1])


def _is_matrix(rows: list[list[float]], values: list[float]) -> bool:
    """Return whether the numbers are a matrix; 9 or 12 in one line may be fx fy cx cy k1 ... instead."""
    if len(values) not in _MATRIX_SHAPES:
        return False
    height, width = _MATRIX_SHAPES[len(values)]
    K = np.reshape(values, (height, width))[:3, :3]
    return height == 4 or [len(row) for row in rows] == [width] * height or _has_last_row(K) or _has_last_row(K.T)


def _of_ocamcalib(rows: list[list[float]]) -> OmnidirectionalCamera:
    """Return the camera of the toolbox' `calib_results.txt` (Scaramuzza et al., IROS 2006).

    Its lines: `n a0 a1 ...`, the polynomial; `n b0 b1 ...`, its inverse, which is not used; `row column`, the centre,
    from 0; `c d e`; `height width`. Its axes are x down, y right, z backwards, and [[c, d], [e, 1]] takes (down, right)
    to (row, column). With right before down that is [[1, e], [d, c]], divided by c what our camera has; rho is c times
    the toolbox' then.
    """
    (_, *polynomial), _, (row, column), (c, d, e), (height, width) = rows
    size = check_size(width, height)
    first = polynomial[0] if 0 < len(polynomial) <= MOST_TERMS else 0.0
    if first >= 0 or not 0.5 < c < 2:
        begins = f"its polynomial begins with {first:g} and its affine part with {c:g}"
        raise ValueError(f"{begins}: the toolbox writes a negative number and one near 1")
    forward = tuple(-a * c ** (1 - power) for power, a in enumerate(polynomial))
    return OmnidirectionalCamera(forward, column, row, *size, (1 / c, e / c, d / c))


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


def stereo_ini_fields(text: str) -> Fields | None:
    """Return the left camera of a da Vinci's `StereoCalibration.ini` (StereoMIS), None for any other text.

    `[StereoLeft]` holds res_x, res_y, fc_x, fc_y, cc_x, cc_y and the lens kc_0 ... in OpenCV's order. Raises
    `ValueError` where the file is damaged.
    """
    if not any(line.strip() == f"[{_STEREO_LEFT}]" for line in text.splitlines()):
        return None
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(text)
        left = parser[_STEREO_LEFT]
    except (configparser.Error, KeyError) as error:
        raise ValueError(str(error).partition("\n")[0]) from None
    lens = [left[key] for i in range(8) if (key := f"kc_{i}") in left]
    return Fields([*left.items(), ("distortion_coefficients", lens)])
