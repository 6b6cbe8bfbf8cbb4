"""MATLAB's .mat files as trees; objects of MATLAB's classes are not in them as numbers."""

from __future__ import annotations

import io
import zlib
from struct import Struct, error

from scopemap.input.camera_files.arrays import LARGEST_BYTES, fields_of_arrays
from scopemap.input.camera_files.parsing import Fields

_HEADER = b"MATLAB "
_HEADER_BYTES = 128
_ORDER_AT = 126  # two letters that tell the order of bytes
_COMPRESSED = 15
_EXPORT = (
    "save its struct in MATLAB, `s = toStruct(params); save('cam.mat', '-struct', 's', '-v7')`, and give that file"
)
_DAMAGED = (
    ValueError, TypeError, KeyError, IndexError, OSError, EOFError, zlib.error, error, OverflowError,
    MemoryError, UnicodeError, AttributeError,
)  # fmt: skip


def is_mat_file(content: bytes) -> bool:
    """Whether content begins as .mat files do."""
    return content.startswith(_HEADER)


def mat_fields(content: bytes) -> Fields:
    """Return the mapping in a .mat file of version 5 to 7; `ValueError`, with what to do, for others and objects."""
    if content.startswith(_HEADER + b"7.3"):
        raise ValueError(f"it is a .mat file of version 7.3, which is not read: {_EXPORT}")
    from scipy.io.matlab import MatReadError, loadmat  # its import takes longer than all other formats' reading

    try:
        _check_size(content)
        variables = loadmat(io.BytesIO(content), simplify_cells=True, verify_compressed_data_integrity=False)
    except (MatReadError, *_DAMAGED) as damage:
        raise ValueError(f"it is a damaged .mat file ({str(damage).partition(chr(10))[0][:80]})") from None
    fields = fields_of_arrays(variables)
    if not fields.pairs:
        raise ValueError(f"it holds objects of MATLAB, which only MATLAB reads: {_EXPORT}")
    return fields


def _check_size(content: bytes) -> None:
    """Raise `ValueError` where variables are compressed from more than any calibration."""
    order = "<" if content[_ORDER_AT:_HEADER_BYTES] == b"IM" else ">"
    head, at, total = Struct(f"{order}II"), _HEADER_BYTES, 0
    while at + head.size <= len(content):
        kind, length = head.unpack_from(content, at)
        part = content[at + head.size : at + head.size + length]
        if kind == _COMPRESSED:
            total += len(zlib.decompressobj().decompress(part, LARGEST_BYTES))
        if total >= LARGEST_BYTES:
            raise ValueError("it is larger than any calibration")
        at += head.size + length
