"""One root error, few kinds, and the shape check of public functions.

A message names the action, the finding and the remedy. The command line prints a known error as
one line and exits with code 1; anything else is a bug and keeps its traceback.
"""

from __future__ import annotations

import numpy as np


class ScopemapError(Exception):
    """Root of every error that scopemap raises on purpose."""


class InputError(ScopemapError):
    """The input cannot be read or holds nothing to work on."""


class CalibrationError(ScopemapError):
    """The camera calibration cannot be read or does not fit the images."""


class WeightsError(ScopemapError):
    """A network's weights are missing, damaged or of another model."""


class SettingsError(ScopemapError):
    """A setting is unknown or has an impossible value."""


class AlignmentError(ScopemapError):
    """Two trajectories cannot be aligned or share too little."""


def check_shape(name: str, array: np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` unless `array` has `shape`; `None` in `shape` stands for any length."""
    found = np.shape(array)
    fits = len(found) == len(shape) and all(want in (None, have) for want, have in zip(shape, found, strict=True))
    if not fits:
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{name}: expected an array of shape ({wanted}), got {found}")
