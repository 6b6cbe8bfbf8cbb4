"""A gzip file as a seekable stream: going back costs a bounded stretch of decompression, not the whole file again.

While the stream is read, the state of the decompressor is kept every 32 MB (`zlib` can copy it, some 40 KB each). At
most `MOST_POINTS` are kept: when there are more, every other one is dropped and the spacing doubles. So the memory is
bounded by about 10 MB however large the file is, and nothing is written to disk.
"""

from __future__ import annotations

import io
import zlib
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from zlib import _Decompress

    from _typeshed import WriteableBuffer

SPACING_BYTES = 32 << 20
MOST_POINTS = 256
_CHUNK_BYTES = 256 << 10
_STEP_BYTES = 1 << 20
_GZIP_WINDOW = 31


@dataclass(frozen=True)
class _Point:
    """Where decompression can start anew: `at` counts decompressed bytes, `offset` those of the file."""

    at: int
    offset: int
    inflate: _Decompress


class SeekableGzip(io.RawIOBase):
    """Decompressed content of a gzip file. Reading raises `EOFError` where it breaks off, `zlib.error` if damaged."""

    def __init__(self, file: Path) -> None:
        self._file = file.open("rb")
        self._spacing = SPACING_BYTES
        self._points = [_Point(0, 0, zlib.decompressobj(_GZIP_WINDOW))]
        self._resume(self._points[0])

    def readable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """True."""
        return True

    def tell(self) -> int:
        """Return the position in the decompressed content."""
        return self._at

    def readinto(self, buffer: WriteableBuffer) -> int:
        """Decompress into `buffer`; returns the number of bytes, 0 at the end."""
        view = memoryview(buffer).cast("B")
        data = self._decompressed(len(view))
        view[: len(data)] = data
        return len(data)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to `offset` from the start or from here; the end of a gzip file is not known beforehand."""
        if whence == io.SEEK_END:
            raise io.UnsupportedOperation("seeking from the end of a gzip file")
        target = offset + (self._at if whence == io.SEEK_CUR else 0)
        point = self._points[bisect_right([p.at for p in self._points], target) - 1]
        if target < self._at or point.at > self._at:
            self._resume(point)
        while self._at < target and self._decompressed(min(_STEP_BYTES, target - self._at)):
            pass
        return self._at

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()

    def _resume(self, point: _Point) -> None:
        self._file.seek(point.offset)
        self._at, self._inflate, self._pending = point.at, point.inflate.copy(), b""

    def _decompressed(self, most: int) -> bytes:
        """Return the next bytes, `most` at most, none at the end."""
        while True:
            if self._inflate.eof and not self._next_stream():
                return b""
            data = self._pending or self._file.read(_CHUNK_BYTES)
            found = self._inflate.decompress(data, most)
            self._pending = self._inflate.unconsumed_tail
            if found:
                self._at += len(found)
                self._keep_point()
                return found
            if not data and not self._inflate.eof:
                raise EOFError("the gzip file breaks off")

    def _next_stream(self) -> bool:
        """Start the next of several gzip streams one after the other; zeros fill the file up at its end."""
        rest = (self._inflate.unused_data or self._file.read(_CHUNK_BYTES)).lstrip(b"\0")
        if not rest:
            return False
        self._inflate, self._pending = zlib.decompressobj(_GZIP_WINDOW), rest
        return True

    def _keep_point(self) -> None:
        if self._inflate.eof or self._at < self._points[-1].at + self._spacing:
            return
        consumed = self._file.tell() - len(self._pending)
        self._points.append(_Point(self._at, consumed, self._inflate.copy()))
        if len(self._points) > MOST_POINTS:
            self._points = self._points[::2]
            self._spacing *= 2
