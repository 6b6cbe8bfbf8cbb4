"""Cameras in files of arrays: NumPy's .npy and .npz, as users of OpenCV in Python save them; pickles are not loaded."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from tokenize import TokenError
from typing import Any

import numpy as np

from scopemap.input.camera_files.parsing import Fields

LARGEST_BYTES = 1 << 24
_NPY = b"\x93NUMPY"
_NPZ = b"PK\x03\x04"
_DEEPEST = 3
# NumPy tokenizes the header as Python.
_DAMAGED = (
    ValueError, OSError, EOFError, KeyError, SyntaxError, TokenError, zlib.error, zipfile.BadZipFile, MemoryError,
    RuntimeError,
)  # fmt: skip


def numpy_fields(content: bytes) -> Fields | None:
    """Return the arrays of an .npz by name, or an .npy as `K`; None for other content, `ValueError` if damaged."""
    if not content.startswith((_NPY, _NPZ)):
        return None
    try:
        if content.startswith(_NPY):
            return fields_of_arrays({"K": np.load(io.BytesIO(content), allow_pickle=False)})
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(member.file_size for member in archive.infolist()) > LARGEST_BYTES:
                raise ValueError("it is larger than any calibration")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            found = {name: one for name in arrays if (one := _loaded(arrays, name)) is not None}
            return fields_of_arrays(found, is_numpy=True)
    except _DAMAGED as damage:
        raise ValueError(f"its arrays cannot be read ({str(damage).partition(chr(10))[0][:80]})") from None


def fields_of_arrays(variables: Mapping[str, Any], depth: int = 0, *, is_numpy: bool = False) -> Fields:
    """Return arrays, numbers, texts and mappings of them as a tree; everything else, objects, is left out.

    is_numpy : keep a column of four as rows: in NumPy's files it tells a fisheye's coefficients.
    """
    pairs: list[tuple[str, Any]] = []
    for name, value in variables.items():
        if isinstance(value, dict) and depth < _DEEPEST:
            pairs.append((name, fields_of_arrays(value, depth + 1)))
        elif isinstance(value, str):
            pairs.append((name, value))
        elif np.asarray(value).dtype.kind in "fiu":
            array = np.asarray(value, np.float64)
            keeps_rows = is_numpy and array.shape == (4, 1)
            values = array.tolist() if keeps_rows else array.ravel().tolist()
            pairs.append((name, values if array.ndim else float(array)))
    return Fields((name, node) for name, node in pairs if not name.startswith("__"))


def _loaded(arrays: Mapping[str, Any], name: str) -> Any:
    """Return an array, or the text of one; None for one that is pickled."""
    try:
        array = arrays[name]
    except ValueError:
        return None
    return str(array) if array.dtype.kind == "U" and not array.ndim else array
