"""The MPEG stream inside a DICOM file, decoded in place."""

from __future__ import annotations

import io
from bisect import bisect_right
from itertools import accumulate, islice
from typing import BinaryIO

from scopemap.errors import InputError
from scopemap.io.datasets.dicom_files import Header, fragments
from scopemap.io.time_stamps import TimeStamps
from scopemap.io.video import VideoFile


class EncapsulatedVideo(VideoFile):
    """A video (MPEG-2, MPEG-4 AVC, HEVC) that is packed into the pixel data of a DICOM file, in fragments.

    stamped : whether the stream says when its pictures were taken. A bare one (H.264, HEVC) says at best how many a
    second: then `stated_hz` comes first, None where the file does not say.
    """

    def __init__(self, header: Header, stated_hz: float | None) -> None:
        self._pieces = [(header.start, header.length)] if header.length is not None else fragments(header)
        if not any(length for _, length in self._pieces):
            raise InputError(f"reading {header.path}: the DICOM file says that it holds a video, but that is empty")
        super().__init__(header.path)
        self.stamped = self.stamped and any(frame.time is not None for _, _, frame in islice(self._decoded(), 2))
        if not self.stamped:
            # FFmpeg gives a bare stream a rate of its own.
            self.rate_hz = stated_hz or self._coded_hz() or self.rate_hz

    def _coded_hz(self) -> float:
        """Return the rate that the pictures' own headers state, 0 where they do not."""
        with self._opened() as container:
            stream = container.streams.video[0]
            next(container.decode(stream), None)
            return float(stream.codec_context.framerate or 0)

    def _report(self, read: int, damaged: int, broken: bool, stamps: TimeStamps) -> None:
        if not self.stamped:
            stamps.repaired = 0
        super()._report(read, damaged, broken, stamps)

    def media(self) -> BinaryIO:
        """Return the stream, as if it were a file."""
        return io.BufferedReader(_Pieces(self.path.open("rb"), self._pieces))


class _Pieces(io.RawIOBase):
    """Stretches (start, length) of a file, read as if they were one file."""

    def __init__(self, file: BinaryIO, pieces: list[tuple[int, int]]) -> None:
        self._file, self._pieces = file, pieces
        self._ends = list(accumulate(length for _, length in pieces))
        self._place = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self._ends[-1]}[whence]
        self._place = max(base + offset, 0)
        return self._place

    def readinto(self, buffer: bytearray | memoryview, /) -> int:  # type: ignore[override]
        piece = bisect_right(self._ends, self._place)
        if piece == len(self._pieces):
            return 0
        left = self._ends[piece] - self._place
        start, length = self._pieces[piece]
        self._file.seek(start + length - left)
        data = self._file.read(min(left, len(buffer)))
        buffer[: len(data)] = data
        self._place += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()
