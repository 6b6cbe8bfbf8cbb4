"""One file of depth or disparity: an image of one channel, or an array of NumPy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.input.decoding import read_decoded

NUMPY = ".npy"
_COLOUR_CHANNELS = (3, 4)
_HEADER_BYTES = 128  # that NumPy fills up to this length


def read_depth_file(file: Path) -> np.ndarray:
    """Return (h, w) uint8, uint16 or floating; raises `InputError` for other content."""
    array = np.squeeze(_array_in(file) if file.suffix.lower() == NUMPY else _image_in(file))
    is_colour = array.ndim == 3 and array.shape[-1] in _COLOUR_CHANNELS
    if (
        is_colour
        and np.array_equal(array[..., 1], array[..., 0], True)
        and np.array_equal(array[..., 2], array[..., 0], True)
    ):
        array, is_colour = array[..., 0], False
    if array.ndim == 2 and (array.dtype in (np.uint8, np.uint16) or np.issubdtype(array.dtype, np.floating)):
        return array
    if is_colour:
        remedy = "a colour-mapped depth picture cannot be converted to depth; give what the network returned"
    elif array.ndim != 2:
        remedy = "save one array (height, width) per frame"
    else:
        remedy = "save it as uint16 or float32"
    raise InputError(
        f"the depth file {file} holds {array.dtype} of shape {array.shape}: expected one channel of 8 or 16 bit or "
        f"floats; {remedy}"
    )


def _array_in(file: Path) -> np.ndarray:
    try:
        loaded: np.ndarray = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        why = "it is no array of NumPy, or damaged"
        if _holds_objects(file):
            why = "it holds Python objects, which are not loaded; save the array itself"
        raise InputError(f"cannot read the depth file {file}: {why}") from None
    return loaded


def _holds_objects(file: Path) -> bool:
    """Return whether a file is a pickle, or an array of NumPy whose header says that it holds objects."""
    with file.open("rb") as content:
        start = content.read(_HEADER_BYTES)
    return start.startswith(b"\x80") or (start.startswith(b"\x93NUMPY") and b"'|O'" in start)


def _image_in(file: Path) -> np.ndarray:
    image = read_decoded(file)
    if image is None:
        raise InputError(f"cannot read the depth file {file}: not an image that OpenCV reads, or damaged")
    return image
