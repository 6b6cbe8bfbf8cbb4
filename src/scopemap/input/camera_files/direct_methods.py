"""Camera files of PTAM (`camera.cfg`) and of DSO and TUM's mono data set (`camera.txt`).

Both write shares of the size that count from the image's corner, so that the centre of the first pixel is at 0.5 px:
github.com/Oxford-PTAM/PTAM-GPL, ATANCamera; github.com/JakobEngel/dso, README, "Geometric Calibration File".
"""

from __future__ import annotations

import re

from scopemap.input.camera_files.calibration import Calibration, Size, are_shares_of_size, check_size, pinhole_of
from scopemap.input.camera_files.lens import with_lens
from scopemap.input.camera_files.parsing import number_rows

CORNER_PX = 0.5
_PTAM = re.compile(r"^\s*Camera\.Parameters\s*=?\s*\[?([^\]\n]*)\]?", re.MULTILINE)
_LENSES = {"pinhole": "pinhole", "fov": "fov", "radtan": "radtan", "equidistant": "equi", "kannalabrandt": "equi"}
_FIRST_LINE = re.compile(r"(?:([A-Za-z]\w*)\s+)?([-+.\deE\s,]+)")
_OUTPUTS = ("crop", "full", "none")
_COUNT = {"pinhole": (4, 5), "fov": (5,), "radtan": (8,), "equi": (8,)}
_SHORTEST = 4
_LONGEST = 10


def direct_method_camera(text: str, image_size: Size) -> Calibration | None:
    """Return the camera of PTAM's or DSO's file, None for any other text; `ValueError` for a wrong one."""
    if (ptam := _PTAM.search(text)) is not None:
        return _camera("fov", number_rows(ptam[1]), None, image_size)
    lines = [line for line in (line.partition("#")[0].strip() for line in text.splitlines()[:100]) if line]
    first = _FIRST_LINE.fullmatch(lines[0]) if lines else None
    rows = number_rows(first[2]) if first else None
    if first is None or not rows or not _SHORTEST <= len(rows[0]) <= _LONGEST:
        return None
    size = number_rows(lines[1]) if len(lines) > 1 else None
    size = size if size and len(size[0]) == 2 else None
    is_dso = bool(size) and (len(rows[0]) in (5, 8) or (len(lines) > 2 and lines[2].lower() in _OUTPUTS))
    word = (first[1] or "").lower()
    if word and (word in _LENSES or size):
        lens = _LENSES.get(word, word)
    elif not word and (is_dso or (len(lines) == 1 and len(rows[0]) == 5 and are_shares_of_size(rows[0][:4]))):
        lens = {4: "pinhole", 5: "fov", 8: "radtan"}.get(len(rows[0]), "")
    else:
        return None
    return _camera(lens, rows, check_size(*size[0]) if size else None, image_size)


def _camera(lens: str, rows: list[list[float]] | None, size: Size | None, image_size: Size) -> Calibration:
    """Return the camera of fx fy cx cy and its lens' coefficients; PTAM's and DSO's omega of 0 is a pinhole."""
    values = rows[0] if rows else []
    intrinsics, coefficients = values[:4], values[4:]
    counts = _COUNT.get(lens)
    if counts and len(values) not in counts:
        expected = " or ".join(map(str, counts))
        raise ValueError(
            f"a camera of the model {lens} has {expected} numbers, fx fy cx cy and its lens, found {len(values)}"
        )
    if len(intrinsics) < _SHORTEST:
        raise ValueError(f"it has {len(intrinsics)} of the four numbers fx fy cx cy")
    if lens == "pinhole" and any(coefficients):
        raise ValueError(f"its fifth number, {coefficients[0]:g}, is a lens' that its model, Pinhole, does not have")
    pinhole, origin = pinhole_of(intrinsics, size, image_size, CORNER_PX)
    return Calibration(with_lens(pinhole, lens, coefficients)[0], None, "", origin)
