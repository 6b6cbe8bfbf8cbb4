"""Calibration files that are no tree of names: numbers alone, OCamCalib's text among them, and PTAM's and DSO's lines.

Each is returned as a mapping, whose names are ours or those of the program's row in the table (`programs.py`).
"""

from __future__ import annotations

import re

import numpy as np

from scopemap.input.camera_files.calibration import Size, are_shares_of_size, check_size
from scopemap.input.camera_files.intrinsics import has_last_row
from scopemap.input.camera_files.parsing import Fields, number_rows

_PTAM = re.compile(r"^\s*Camera\.Parameters\s*=?\s*\[?([^\]\n]*)\]?", re.MULTILINE)
_DSO_LENSES = ("pinhole", "fov", "radtan", "equidistant", "kannalabrandt")
_DSO_LENS_OF = {4: "pinhole", 5: "fov", 8: "radtan"}  # by how many numbers there are, where no word is
_FIRST_LINE = re.compile(r"(?:([A-Za-z]\w*)\s+)?([-+.\deE\s,]+)")
_OUTPUTS = ("crop", "full", "none")
_SHORTEST = 4
_LONGEST = 10
_MOST_LINES = 100
_MATRIX_SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
_LINE_COUNTS = (4, 8, 9, 12)
_SMALLEST_SIDE_PX = 64


def fields_of_text(text: str) -> Fields | None:
    """Return the mapping of PTAM's, DSO's or numbers' text, None for any other; `ValueError` for a wrong one."""
    if (ptam := _PTAM.search(text)) is not None:
        numbers = number_rows(ptam[1]) or [[]]
        return Fields([("PTAM's Camera.Parameters", numbers[0])])
    if (dso := _dso_fields(text)) is not None:
        return dso
    rows = number_rows(text)
    return fields_of_rows(rows) if rows is not None else None


def fields_of_rows(rows: list[list[float]]) -> Fields:
    """Return a matrix, fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]] or OCamCalib's numbers; else `ValueError`.

    Behind a matrix of 3x3 may be lines of coefficients (SciKit-Surgery), behind all one of width and height.
    """
    if not all(np.isfinite(row).all() for row in rows):
        raise ValueError("it holds NaN or infinity")
    if [len(row) for row in rows[2:]] == [2, 3, 2] and all(row[0] == len(row) - 1 for row in rows[:2]):
        names = ("OCamCalib's polynomial", "inverse", "center", "affine", "size")
        return Fields(zip(names, rows, strict=True))
    stated = _size_in(rows)
    rows = rows[:-1] if stated else rows
    values = [value for row in rows for value in row]
    size = list(zip(("image_width", "image_height"), stated or (), strict=False))
    if [len(row) for row in rows[:3]] == [3, 3, 3] and len(rows) > 3:
        return Fields([("camera_matrix", values[:9]), ("distortion_coefficients", values[9:]), *size])
    if _is_matrix(rows, values):
        return Fields([("camera_matrix", values), *size])
    if len(values) in _LINE_COUNTS:
        return Fields([("intrinsics", values[:4]), ("distortion_coefficients", values[4:]), *size])
    expected = "expected fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]], or a camera matrix of 3x3, 3x4 or 4x4"
    raise ValueError(f"it holds {len(values)} numbers: {expected}")


def _dso_fields(text: str) -> Fields | None:
    """Return what DSO's or TUM-mono's `camera.txt` says, None for any other text."""
    lines = [line for line in (line.partition("#")[0].strip() for line in text.splitlines()[:_MOST_LINES]) if line]
    first = _FIRST_LINE.fullmatch(lines[0]) if lines else None
    rows = number_rows(first[2]) if first else None
    if first is None or not rows or not _SHORTEST <= len(rows[0]) <= _LONGEST:
        return None
    size = number_rows(lines[1]) if len(lines) > 1 else None
    size = size if size and len(size[0]) == 2 else None
    is_dso = bool(size) and (len(rows[0]) in (5, 8) or (len(lines) > 2 and lines[2].lower() in _OUTPUTS))
    word = (first[1] or "").lower()
    if word:
        is_dso = word in _DSO_LENSES or bool(size)
    elif not is_dso:
        is_dso = len(lines) == 1 and len(rows[0]) == 5 and are_shares_of_size(rows[0][:4])
    if not is_dso:
        return None
    sides = [("DSO's size", list(check_size(*size[0])))] if size else []
    return Fields([("DSO's first line", rows[0]), ("DSO's lens", word or _DSO_LENS_OF.get(len(rows[0]), "")), *sides])


def _size_in(rows: list[list[float]]) -> Size | None:
    """Return width and height of the last row, None where that is no size."""
    last = rows[-1] if len(rows) > 1 else []
    is_size = len(last) == 2 and all(side % 1 == 0 and side >= _SMALLEST_SIDE_PX for side in last)
    return check_size(*last) if is_size else None


def _is_matrix(rows: list[list[float]], values: list[float]) -> bool:
    """Return whether the numbers are a matrix; 9 or 12 in one line may be fx fy cx cy k1 ... instead."""
    if len(values) not in _MATRIX_SHAPES:
        return False
    height, width = _MATRIX_SHAPES[len(values)]
    K = np.reshape(values, (height, width))[:3, :3]
    return height == 4 or [len(row) for row in rows] == [width] * height or has_last_row(K) or has_last_row(K.T)
