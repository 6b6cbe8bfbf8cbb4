"""OpenEXR images, read by the package `OpenEXR` (the extra `datasets`)."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from scopemap.io.decoding import check_pixels, reporting


def can_read_exr() -> bool:
    """Return whether the package `OpenEXR` is there."""
    return find_spec("OpenEXR") is not None


def read_exr_red(file: Path) -> np.ndarray:
    """Return the channel R, or Y of a file without R, as (h, w) float32.

    Raises `InputError` for a file that is damaged, has neither channel, or claims more pixels than `decoding` allows.
    """
    import OpenEXR

    with reporting(f"reading {file}: no OpenEXR image with a channel R or Y, or damaged"):
        # Header first: the file's claim is checked before its pixels are decoded.
        corners = OpenEXR.File(str(file), header_only=True).header()["dataWindow"]
        width, height = (np.subtract(*reversed(corners), dtype=np.int64) + 1).tolist()
        check_pixels(width * height, f"reading {file}")
        channels = OpenEXR.File(str(file), separate_channels=True).channels()
        return np.array(channels["R" if "R" in channels else "Y"].pixels, dtype=np.float32)
