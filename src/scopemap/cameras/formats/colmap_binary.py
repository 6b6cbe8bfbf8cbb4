"""COLMAP's binary files, walked through: little-endian, counts before what is counted."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import Struct

from scopemap.errors import InputError

_COUNT = Struct("<Q")
_LONGEST_NAME_BYTES = 4096


class Content:
    """A binary file that is walked through; what its counts claim is believed only as far as it has bytes."""

    def __init__(self, file: Path, content: mmap.mmap) -> None:
        self._file, self._content, self._at = file, content, 0

    def take(self, form: Struct) -> tuple:
        """Return the next values, of the types in `form`."""
        start = self._at
        self.skip(form.size)
        return form.unpack(self._content[start : self._at])

    def count(self, least_bytes: int, what: str) -> int:
        """Return the next count, of `what` that takes `least_bytes` each at least."""
        (count,) = self.take(_COUNT)
        left = len(self._content) - self._at
        if count * least_bytes > left:
            raise InputError(
                f"reading {self._file}: it claims to hold {count} {what}, but has only {left} bytes left for them; it "
                "is damaged or cut off, write the COLMAP model anew"
            )
        return int(count)

    def name(self) -> str:
        """Return the next name, which ends in a zero byte."""
        start, most = self._at, self._at + _LONGEST_NAME_BYTES
        end = self._content.find(b"\0", start, most)
        if end <= start:
            raise InputError(f"reading {self._file}: no name of an image at byte {start}; it is damaged or cut off")
        self._at = end + 1
        try:
            return self._content[start:end].decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(f"reading {self._file}: the name at byte {start} is no text; it is damaged") from None

    def skip(self, size: int) -> None:
        """Pass over `size` bytes."""
        if self._at + size > len(self._content):
            raise InputError(f"reading {self._file}: it is cut off after {len(self._content)} bytes")
        self._at += size

    def check_end(self) -> None:
        """Raise `InputError` where bytes are left."""
        left = len(self._content) - self._at
        if left:
            raise InputError(f"reading {self._file}: {left} bytes are left after the last entry; it is damaged")


@contextmanager
def opened_model(file: Path) -> Iterator[Content]:
    """Open a binary file of a model; `InputError` where it cannot be."""
    try:
        with file.open("rb") as opened:
            # Mapped, since points, which are passed over, are most of a large model.
            content = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read a COLMAP model from {file}: {error}") from None
    with content:
        yield Content(file, content)
