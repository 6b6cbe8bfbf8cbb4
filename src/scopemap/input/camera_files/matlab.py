"""Cameras of MATLAB: its Computer Vision Toolbox, Bouguet's and Scaramuzza's toolboxes, in .mat files or as JSON.

MATLAB's first pixel is (1, 1), and its sizes are rows before columns; an `IntrinsicMatrix` is transposed, a `K` is not
(mathworks.com/help/vision/ref/cameraparameters.html, fisheyeintrinsics.html). Bouguet's `fc cc kc` count from 0.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Sequence
from struct import Struct, error

import numpy as np

from scopemap.input.camera_files.arrays import LARGEST_BYTES, fields_of_arrays
from scopemap.input.camera_files.calibration import Calibration
from scopemap.input.camera_files.parsing import Fields, mappings_below
from scopemap.input.camera_files.scaramuzza import of_ocamcalib

_HEADER = b"MATLAB "
_HEADER_BYTES = 128
_ORDER_AT = 126  # two letters that tell the order of bytes
_COMPRESSED = 15
_FIRST_PIXEL = 1.0
_EXPORT = (
    "save its struct in MATLAB, `s = toStruct(params); save('cam.mat', '-struct', 's', '-v7')`, and give that file"
)
_DAMAGED = (
    ValueError, TypeError, KeyError, IndexError, OSError, EOFError, zlib.error, error, OverflowError,
    MemoryError, UnicodeError, AttributeError,
)  # fmt: skip
_OCAM = ("ss", "xc", "yc", "c", "d", "e", "width", "height")


def is_mat_file(content: bytes) -> bool:
    """Whether content begins as .mat files do."""
    return content.startswith(_HEADER)


def mat_fields(content: bytes) -> Fields:
    """Return the mapping in a .mat file of version 5 to 7; `ValueError`, with what to do, for others and objects."""
    if content.startswith(_HEADER + b"7.3"):
        raise ValueError(f"it is a .mat file of version 7.3, which is not read: {_EXPORT}")
    from scipy.io.matlab import MatReadError, loadmat  # its import takes longer than all other formats' reading

    try:
        _check_size(content)
        variables = loadmat(io.BytesIO(content), simplify_cells=True, verify_compressed_data_integrity=False)
    except (MatReadError, *_DAMAGED) as damage:
        raise ValueError(f"it is a damaged .mat file ({str(damage).partition(chr(10))[0][:80]})") from None
    fields = fields_of_arrays(variables)
    if not fields.pairs:
        raise ValueError(f"it holds objects of MATLAB, which only MATLAB reads: {_EXPORT}")
    return fields


def of_ocam_model(fields: Fields) -> Calibration | None:
    """Return the camera of OCamCalib's `ocam_model`, None where a mapping holds none; its centre counts from 1."""
    for place in _places(fields):
        if not all(any(place.nodes((name,))) for name in _OCAM):
            continue
        polynomial = place.numbers(("ss",)) or []
        row, column, c, d, e, width, height = (place.number((name,)) or 0.0 for name in _OCAM[1:])
        centre = (row - _FIRST_PIXEL, column - _FIRST_PIXEL)
        return Calibration(of_ocamcalib(polynomial, centre, (c, d, e), (height, width)), None, "")
    return None


def without_matlabs_conventions(fields: Fields) -> Fields:
    """Return a mapping of MATLAB's camera with pixels that count from 0 and width before height; others as they are."""
    for place in _places(fields):
        names = {name for name, _ in place.pairs}
        if {"MappingCoefficients", "DistortionCenter"} <= names:
            return _fisheye(place)
        if {"FocalLength", "PrincipalPoint"} <= names:
            fx, fy = place.numbers(("FocalLength",), 2) or (np.nan, np.nan)
            cx, cy = place.numbers(("PrincipalPoint",), 2) or (np.nan, np.nan)
            return _pinhole(place, [fx, place.number(("Skew",)) or 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        if "RadialDistortion" in names and names & {"IntrinsicMatrix", "ImageSize"}:
            matrix = place.numbers(("IntrinsicMatrix",), 9)
            K = np.reshape(matrix, (3, 3)).T.ravel().tolist() if matrix else place.numbers(("K",), 9)
            if K is not None:
                return _pinhole(place, K)
    return fields


def _places(fields: Fields) -> list[Fields]:
    """Return a mapping and those in it: a struct has any name, and of a pair the first comes first."""
    return [fields, *(place for _, place in mappings_below(fields))]


def _pinhole(place: Fields, K: Sequence[float]) -> Fields:
    fx, skew, cx, _, fy, cy, *_ = K
    matrix = [fx, skew, cx - _FIRST_PIXEL, 0.0, fy, cy - _FIRST_PIXEL, 0.0, 0.0, 1.0]
    lens = [(name, node) for name, node in place.pairs if name in ("RadialDistortion", "TangentialDistortion")]
    return Fields([("camera_matrix", matrix), *lens, *_size(place)])


def _fisheye(place: Fields) -> Fields:
    """Return the polynomial with its a1, which MATLAB leaves out, and the matrix [c d; e 1] as c, d, e."""
    coefficients = place.numbers(("MappingCoefficients",)) or []
    cx, cy = place.numbers(("DistortionCenter",), 2) or (np.nan, np.nan)
    c, d, e, one = place.numbers(("StretchMatrix",), 4) or (1.0, 0.0, 0.0, 1.0)
    if len(coefficients) != 4 or one != 1:
        raise ValueError("expected four MappingCoefficients, a0 a2 a3 a4, and a StretchMatrix [c d; e 1]")
    polynomial = [coefficients[0], 0.0, *coefficients[1:]]
    centre = [("cx", cx - _FIRST_PIXEL), ("cy", cy - _FIRST_PIXEL)]
    return Fields([("polynomial", polynomial), ("stretch", [c, d, e]), *centre, *_size(place)])


def _size(place: Fields) -> list[tuple[str, float]]:
    size = place.numbers(("ImageSize",), 2)
    return [] if size is None else [("image_width", size[1]), ("image_height", size[0])]


def _check_size(content: bytes) -> None:
    """Raise `ValueError` where variables are compressed from more than any calibration."""
    order = "<" if content[_ORDER_AT:_HEADER_BYTES] == b"IM" else ">"
    head, at, total = Struct(f"{order}II"), _HEADER_BYTES, 0
    while at + head.size <= len(content):
        kind, length = head.unpack_from(content, at)
        part = content[at + head.size : at + head.size + length]
        if kind == _COMPRESSED:
            total += len(zlib.decompressobj().decompress(part, LARGEST_BYTES))
        if total >= LARGEST_BYTES:
            raise ValueError("it is larger than any calibration")
        at += head.size + length
