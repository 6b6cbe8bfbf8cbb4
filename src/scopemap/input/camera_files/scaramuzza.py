"""Scaramuzza's lens by the names that C3VD's config.ini and our own files have."""

from __future__ import annotations

from collections.abc import Sequence

from scopemap.engine.cameras.lenses import OmnidirectionalCamera
from scopemap.input.camera_files.calibration import Calibration, Size
from scopemap.input.camera_files.parsing import MOST_TERMS, Fields
from scopemap.input.camera_files.sizes import size_of

_AFFINE = ("c", "d", "e")
_CENTRE = (("cx", "u0"), ("cy", "v0"))
_LEAST_TERMS = 2


def omnidirectional_of(levels: Sequence[Fields], root: Fields, image_size: Size) -> Calibration | None:
    """Return the camera of a polynomial (`polynomial`, or a0 a1 ...) in the levels of a tree, None where it has none.

    Beside it are cx and cy (px, the centre of the top-left pixel is 0, 0), and the matrix [[c, d], [e, 1]] that takes
    the lens' plane to pixels: `stretch` c d e, or by name. Raises `ValueError` for what is incomplete.
    """
    place = next((level for level in levels if _polynomial(level)), None)
    if place is None:
        return None
    polynomial = _polynomial(place)
    named = [value for name in _AFFINE if (value := place.number((name,))) is not None]
    stretch = place.numbers(("stretch",)) or named or [1.0, 0.0, 0.0]
    if len(polynomial) > MOST_TERMS or len(stretch) != len(_AFFINE):
        raise ValueError(f"expected a 'polynomial' of up to {MOST_TERMS} numbers and a 'stretch' of c, d and e")
    c, d, e = stretch
    if polynomial[0] <= 0:
        own = "OCamCalib's numbers, in other axes, are read from its own calib_results.txt or ocam_model"
        raise ValueError(f"its polynomial begins with {polynomial[0]:g}, which C3VD and MATLAB have positive: {own}")
    cx, cy = _centre(place)
    size, note = size_of(levels, root, (0.0, 0.0, cx, cy), image_size)
    camera = OmnidirectionalCamera(tuple(polynomial), cx, cy, *(size or image_size), (c, d, e))
    return Calibration(camera, None, note, "stated" if size else "images")


def _polynomial(place: Fields) -> list[float]:
    """Return a0, a1 (0 where it is not named), a2, ...; empty where there is none."""
    if listed := place.numbers(("polynomial",)):
        return listed
    named = [place.number((f"a{power}",)) for power in range(MOST_TERMS)]
    last = max((power for power, value in enumerate(named) if value is not None), default=0)
    return [value or 0.0 for value in named[: last + 1]] if named[0] is not None and last >= _LEAST_TERMS else []


def _centre(place: Fields) -> tuple[float, float]:
    matrix = place.numbers(("camera_matrix",), 9)
    cx, cy = (matrix[2], matrix[5]) if matrix else (place.number(names) for names in _CENTRE)
    if cx is None or cy is None:
        raise ValueError("it has a polynomial, but no cx and cy")
    return cx, cy
