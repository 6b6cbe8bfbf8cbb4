"""What programs' numbers count, turned into ours: px, the centre of the first pixel at 0, OpenCV's coefficients.

Each conversion takes numbers by our names and returns them, and raises `ValueError` for those that it cannot turn.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

from scopemap.input.camera_files.calibration import check_size
from scopemap.input.camera_files.parsing import MOST_TERMS

Values: TypeAlias = dict[str, Any]
Conversion: TypeAlias = Callable[[Values], Values]

_CORNER_TO_CENTRE_PX = 0.5
_FIRST_PIXEL = 1.0
_MIDDLE_PX = 0.5  # the middle of a row of n pixels is at (n - 1) / 2
_AFFINE = (0.5, 2.0)  # the toolbox' c is a ratio of a pixel's sides


def from_corner(values: Values) -> Values:
    """Centre from the picture's corner; shares of the size stay as they are."""
    cx, cy = values["cx"], values["cy"]
    moved = _CORNER_TO_CENTRE_PX if max(cx, cy) > 1 else 0.0
    return values | {"cx": cx - moved, "cy": cy - moved}


def from_first_pixel(values: Values) -> Values:
    """Centre from a first pixel that is (1, 1)."""
    return values | {"cx": values["cx"] - _FIRST_PIXEL, "cy": values["cy"] - _FIRST_PIXEL}


def from_middle(values: Values) -> Values:
    """Centre, 0 where it is not there, from the middle of the picture."""
    cx, cy = (side / 2 - _MIDDLE_PX + values.get(name, 0.0) for name, side in _sides(values))
    return values | {"cx": cx, "cy": cy}


def of_longer_side(values: Values) -> Values:
    """Focal lengths and centre in shares of the longer side."""
    longer = max(values["width"], values["height"])
    return values | {name: values[name] * longer for name in ("fx", "fy", "cx", "cy") if name in values}


def of_sensor(values: Values) -> Values:
    """One focal length in mm, beside the sensor's width in mm; the centre in px."""
    f_mm, sensor_mm, width = (values[name] for name in ("f", "sensor", "width"))
    if not (f_mm > 0 and sensor_mm > 0):
        raise ValueError(f"its focal length is {f_mm:g} mm on a sensor of {sensor_mm:g} mm, of no calibration")
    focal_px = f_mm * width / sensor_mm
    return values | {"fx": focal_px, "fy": focal_px}


def with_affinity(values: Values) -> Values:
    """One focal length f, to which b1 is added in x, and a skew b2."""
    f = values["f"]
    return values | {"fx": f + values.get("b1", 0.0), "fy": f, "skew": values.get("b2", 0.0)}


def of_toolbox_axes(values: Values) -> Values:
    """The polynomial of Scaramuzza's toolbox (IROS 2006) and its affine part c d e.

    Its axes are x down, y right, z backwards, and [[c, d], [e, 1]] takes (down, right) to (row, column). With right
    before down that is [[1, e], [d, c]], divided by c what our camera has; rho is c times the toolbox' then.
    """
    polynomial, c, d, e = (values[name] for name in ("polynomial", "c", "d", "e"))
    check_size(values["width"], values["height"])
    first = polynomial[0] if 0 < len(polynomial) <= MOST_TERMS else 0.0
    least, most = _AFFINE
    if first >= 0 or not least < c < most:
        begins = f"its polynomial begins with {first:g} and its affine part with {c:g}"
        raise ValueError(f"{begins}: the toolbox writes a negative number and one near 1")
    forward = [-a * c ** (1 - power) for power, a in enumerate(polynomial)]
    left = {name: value for name, value in values.items() if name not in ("c", "d", "e")}
    return left | {"polynomial": forward, "stretch": [1 / c, e / c, d / c]}


def _sides(values: Values) -> tuple[tuple[str, float], tuple[str, float]]:
    if not values["width"] or not values["height"]:
        raise ValueError("it states no width and height, from whose middle its principal point counts")
    return ("cx", values["width"]), ("cy", values["height"])
