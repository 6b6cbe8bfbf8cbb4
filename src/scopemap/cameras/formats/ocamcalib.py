"""`calib_results.txt` of the OCamCalib toolbox (Scaramuzza et al., IROS 2006): lines of numbers between comments.

`n a0 a1 ...`, the polynomial from the pixel to the ray; `n b0 b1 ...`, its inverse, which is not used here; `row
column`, the centre, from 0; `c d e`, the affine part; `height width`.
"""

from __future__ import annotations

import numpy as np

from scopemap.cameras.formats.stated import LARGEST_SIDE_PX, MOST_TERMS, Calibration
from scopemap.cameras.lenses import OmnidirectionalCamera

_COUNTS_AFTER_POLYNOMIALS = [2, 3, 2]


def is_polynomial(rows: list[list[float]]) -> bool:
    """Whether lines of numbers are those of this file."""
    return (
        [len(row) for row in rows[2:]] == _COUNTS_AFTER_POLYNOMIALS
        and all(row[0] == len(row) - 1 for row in rows[:2])
        and 1 < len(rows[0]) <= MOST_TERMS
    )


def of_rows(rows: list[list[float]]) -> Calibration:
    """Return the camera; `ValueError` where the numbers are none.

    The toolbox' axes are x down, y right, z backwards, and its affine matrix [[c, d], [e, 1]] takes (down, right) to
    (row, column). With right before down it is [[1, e], [d, c]], and divided by its last entry what our camera has;
    the length of what it is multiplied by, rho, and with it the polynomial's argument, is c times the toolbox' then.
    """
    (_, *polynomial), _, (row, column), (c, d, e), (height, width) = rows
    if not np.isfinite([*polynomial, row, column, c, d, e]).all():
        raise ValueError("it holds NaN or infinity")
    if not (1 <= width <= LARGEST_SIDE_PX and 1 <= height <= LARGEST_SIDE_PX) or width % 1 or height % 1:
        raise ValueError(f"its size is {width:g}x{height:g} px, which no image has")
    if polynomial[0] >= 0 or not 0.5 < c < 2:
        raise ValueError(
            f"its polynomial begins with {polynomial[0]:g} and its affine part with {c:g}: the toolbox writes a "
            "negative number and one near 1"
        )
    forward = tuple(-a * c ** (1 - power) for power, a in enumerate(polynomial))
    stretch = (1 / c, e / c, d / c)
    return Calibration(OmnidirectionalCamera(forward, column, row, int(width), int(height), stretch), None, "")
