"""One root error, few kinds, and the checks that raise them.

A message names the action, the finding and the remedy. The command line prints a known error as
one line and exits with code 1; anything else is a bug and keeps its traceback.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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
    found = getattr(array, "shape", None)
    if found is None:  # a list: without numpy where none comes, which `scopemap --help` waits for
        import numpy as np

        found = np.shape(array)
    fits = len(found) == len(shape) and all(want in (None, have) for want, have in zip(shape, found, strict=True))
    if not fits:
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{name}: expected an array of shape ({wanted}), got {found}")


def check_bytes(what: str, claimed: int, most: int) -> None:
    """Raise `InputError` where `what`, a file or a member of an archive, holds more than `most` bytes unpacked."""
    if claimed > most:
        raise InputError(
            f"reading {what}: it holds {claimed >> 20} MB, expected {most >> 20} MB at most; is it damaged?"
        )


@contextmanager
def reporting(fault: str, *, quoting: bool = True, kind: type[ScopemapError] = InputError) -> Iterator[None]:
    """Turn the exceptions of a parser into an error of `kind`: `fault` and, with `quoting`, the parser's own message.

    Damaged bytes end in exceptions of any kind. The parser's warnings are suppressed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except ScopemapError:
        raise
    except Exception as error:
        quoted = " ".join(str(error).split()) if quoting else ""
        raise kind(f"{fault} ({quoted or type(error).__name__})") from None
