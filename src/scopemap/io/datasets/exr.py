"""OpenEXR images, read by the package `OpenEXR` (the extra `datasets`)."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.io.decoding import check_pixels


def can_read_exr() -> bool:
    """Return whether the package `OpenEXR` is there."""
    return find_spec("OpenEXR") is not None


def read_exr_red(file: Path) -> np.ndarray:
    """Return the channel R, or Y of a file without R, as (h, w) float32.

    Raises `InputError` for a file that is damaged, has neither channel, or claims more pixels than `decoding` allows.
    """
    import OpenEXR

    try:
        # Header first: the file's claim is checked before its pixels are decoded.
        corners = OpenEXR.File(str(file), header_only=True).header()["dataWindow"]
        width, height = (np.subtract(*reversed(corners), dtype=np.int64) + 1).tolist()
        check_pixels(width * height)
        channels = OpenEXR.File(str(file), separate_channels=True).channels()
        values = channels["R" if "R" in channels else "Y"].pixels
    except InputError as error:
        raise InputError(f"reading {file}: {error}") from None
    except Exception as error:  # damaged bytes end in exceptions of any kind
        raise InputError(f"reading {file}: no OpenEXR image with a channel R or Y, or damaged ({error})") from None
    if values.shape != (height, width):
        raise InputError(f"reading {file}: its channel is {values.shape} in a window of {width}x{height} px")
    return values.astype(np.float32)
