"""Poses as Unity writes them: left-handed with y up; a position, and a quaternion with the scalar last."""

from __future__ import annotations

import numpy as np

from scopemap.errors import InputError
from scopemap.trajectory.formats.poses import from_quaternions

_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def mirrored(T: np.ndarray) -> np.ndarray:
    """Return poses (N, 4, 4) of the left-handed world with y up in OpenCV's axes, both camera and world: M T M."""
    return _MIRROR @ T @ _MIRROR


def poses_of_rows(rows: np.ndarray, mm_per_unit: float, where: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return which rows hold a pose, (N,) bool, and the poses (M, 4, 4) of these, translation in mm, axes as given.

    rows : (N, 7), position and unit quaternion x y z w; a row with NaN or infinity holds no pose. where : the place of
    each row, for the `InputError` at a quaternion that is not of length 1.
    """
    known = np.isfinite(rows).all(axis=1)
    places = [place for place, holds in zip(where, known, strict=True) if holds]
    return known, from_quaternions(rows[known, 3:], rows[known, :3] * mm_per_unit, places)


def numbers_of(fields: list[str], count: int, where: str) -> list[float]:
    """Return the `count` numbers in `fields`, NaN among them; `InputError`, with `where`, for anything else."""
    if len(fields) != count:
        raise InputError(f"{where}: found {len(fields)} columns where {count} numbers were expected")
    try:
        return [float(field) for field in fields]
    except ValueError as error:
        raise InputError(f"{where}: expected {count} numbers ({error})") from None
