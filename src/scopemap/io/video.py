"""A video file (mp4, avi, mov, mkv and whatever else FFmpeg reads), decoded in order."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from scopemap.errors import InputError
from scopemap.io.decoding import limit_in_words, most_pixels
from scopemap.io.source import SourceDefaults, SourceFrame
from scopemap.io.time_stamps import TimeStamps

DEFAULT_RATE_HZ = 30.0
# Some headers give the unit of their clock for the rate.
_HIGHEST_RATE_HZ = 1000.0
# Headers round durations and count pictures that are never shown: less than this is not a video that breaks off.
_MISSING_SHARE, _MISSING_FRAMES = 0.02, 2
_MOST_CODED_PIXELS = 2**31 - 1
# A frame out of so many is looked at where a video can only be read in order.
_SAMPLED_EVERY = 10
# FFmpeg draws text files as a terminal would show them.
_TEXT_CODECS = ("ansi", "bintext", "idf", "xbin")


class VideoFile(SourceDefaults):
    """A video; frame number = order of decoding, time stamps from the stream, pictures turned as they are to be shown.

    Colours are converted to 8-bit sRGB by the matrix and range of the stream; where it states none, BT.601, limited. A
    video that breaks off, holds damaged pictures or wrong time stamps is used as far as it goes; `warnings` names
    it once it was read. Raises `InputError` where it cannot be opened or holds fewer than two readable frames.
    """

    name = "video"
    stamped = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.rate_hz, self._counted = DEFAULT_RATE_HZ, False
        first = [frame for _, _, frame in islice(self._decoded(), 2)]
        if len(first) < 2:
            found = "holds one frame, two are needed" if first else self._unreadable()
            raise InputError(f"reading the video {path}: it {found}")
        self._coded_size = (first[0].width, first[0].height)
        matrix = _display_matrix(first[0])
        sideways = matrix is not None and _swaps_sides(matrix)
        self.width, self.height = self._coded_size[::-1] if sideways else self._coded_size
        with self._opened() as container:
            stream = container.streams.video[0]
            rate_hz = float(stream.average_rate or stream.guessed_rate or 0)
            if 0 < rate_hz <= _HIGHEST_RATE_HZ:
                self.rate_hz = rate_hz
            self.stamped = any(frame.time is not None for frame in first)
            if not self.stamped:
                self.notes.append(f"time stamps: frame number / {self.rate_hz:g} s (the video holds none)")
            aspect = float(stream.sample_aspect_ratio or 1.0)
            self.pixel_aspect = 1 / aspect if sideways else aspect
            self._counted = stream.frames > 0
            self.count = _claimed_frames(stream, container.duration, self.rate_hz)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a file."""
        return path.is_file()

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames."""
        for index, time_s, frame in islice(self._decoded(), *self._bounds(selection)):
            if (frame.width, frame.height) != self._coded_size:
                raise InputError(
                    f"reading the video {self.path}: frame {index} is {frame.width}x{frame.height} px, those before it "
                    f"are {self._coded_size[0]}x{self._coded_size[1]} px; cut the video there"
                )
            yield SourceFrame(index, time_s, _shown(frame))

    def samples(self, count: int) -> list[np.ndarray]:
        """Return about `count` pictures (h, w, 3) uint8 from all parts of the video, fewer where it cannot be searched.

        They are not those of `frames`: where the video can be entered, not every frame.
        """
        found: dict[int | None, np.ndarray] = {}
        with suppress(av.FFmpegError, StopIteration), self._opened() as container:
            start, length = container.start_time or 0, container.duration or 0
            for part in range(count):
                container.seek(start + length * part // count)
                frame = next(container.decode(container.streams.video[0]))
                if (frame.width, frame.height) == self._coded_size:
                    found[frame.pts] = _shown(frame)
        if len(found) >= count // 2:
            return list(found.values())
        return [frame.rgb for frame in self.frames(slice(0, count * _SAMPLED_EVERY, _SAMPLED_EVERY))]

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Only decoding tells how many frames there are, and when."""
        return None

    def media(self) -> str:
        """Return what FFmpeg opens: the file's name, or that of its bytes within another file."""
        return str(self.path)

    def _opened(self) -> InputContainer:
        # FFmpeg takes the memory for a picture of whatever size a header claims, to look at it already.
        limit = {"max_pixels": str(int(min(most_pixels(), _MOST_CODED_PIXELS)))}
        container = av.open(self.media(), "r", metadata_errors="replace", options=limit)
        for stream in container.streams.video:
            if stream.codec_context is not None:
                stream.codec_context.options = limit
        return container

    def _unreadable(self) -> str:
        with self._opened() as container:
            sized = container.streams.video[0].width > 0
        return "holds no readable frame" + ("" if sized else f", or pictures of {limit_in_words()}")

    def _decoded(self) -> Iterator[tuple[int, float, VideoFrame]]:
        """Yield number, time stamp, s, and picture of every frame."""
        stamps = TimeStamps(self.rate_hz)
        index = damaged = 0
        broken = False
        try:
            with self._opened() as container:
                if not container.streams.video:
                    raise InputError(f"reading the video {self.path}: it has no picture")
                stream = container.streams.video[0]
                if stream.codec_context is None:
                    raise InputError(f"reading the video {self.path}: FFmpeg has no decoder for it")
                if stream.codec_context.name in _TEXT_CODECS:
                    raise InputError(f"reading the video {self.path}: it is a text file, not a video")
                stream.thread_type = "AUTO"
                for packet in container.demux(stream):
                    try:
                        decoded = packet.decode()
                    except av.FFmpegError:
                        damaged, index = damaged + 1, index + 1
                        continue
                    for frame in decoded:
                        yield index, stamps(index, frame.time), frame
                        index += 1
        except av.FFmpegError as error:
            if index == 0:
                raise InputError(f"reading the video {self.path}: {error.strerror}") from None
            broken = True
        self._report(index, damaged, broken, stamps)

    def _report(self, read: int, damaged: int, broken: bool, stamps: TimeStamps) -> None:
        claimed = getattr(self, "count", None) or 0
        # What claims a duration and not a count, of frames at any rate, must be held to that.
        found = read if self._counted else max(read, round(stamps.span_s * self.rate_hz) + 1)
        if broken or claimed - found > max(_MISSING_FRAMES, _MISSING_SHARE * claimed):
            of = f" of {claimed}" if claimed > read else ""
            self._warn(f"the video {self.path.name} breaks off after {read}{of} frames; these were used")
        if damaged:
            self._warn(f"the video {self.path.name} holds {damaged} damaged picture(s), which were left out")
        if stamps.repaired and self.stamped:
            self._warn(
                f"the video {self.path.name} has {stamps.repaired} time stamp(s) that are missing, do not increase or "
                f"jump, first at frame {stamps.first_repaired}; these frames follow those before them at "
                f"{self.rate_hz:g} frames/s"
            )

    def _bounds(self, selection: slice) -> tuple[int | None, int | None, int | None]:
        """Return bounds that count from the start; the header's claim serves only those from the end."""
        if all(bound is None or bound >= 0 for bound in (selection.start, selection.stop)):
            return selection.start, selection.stop, selection.step
        if self.count is None:
            raise InputError(f"reading the video {self.path}: its length is unknown, so count frames from the start")
        return selection.indices(self.count)


def _shown(frame: VideoFrame) -> np.ndarray:
    """Return the picture (h, w, 3) uint8, sRGB, in the orientation in which it is to be shown."""
    rgb, matrix = frame.to_ndarray(format="rgb24"), _display_matrix(frame)
    return rgb if matrix is None else upright(rgb, matrix)


def upright(rgb: np.ndarray, matrix: Sequence[int]) -> np.ndarray:
    """Return a picture (h, w, 3) rotated and mirrored by a display matrix, to the nearest quarter turn.

    `matrix` is that of ISO/IEC 14496-12, 9 numbers a b u c d v x y w: a pixel at (x, y) is shown at
    (a x + c y, b x + d y), up to a shift.
    """
    across, down = matrix[0], matrix[4]
    if _swaps_sides(matrix):
        rgb, across, down = rgb.transpose(1, 0, 2), matrix[3], matrix[1]
    return np.ascontiguousarray(rgb[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1])


def _swaps_sides(matrix: Sequence[int]) -> bool:
    return abs(matrix[1]) > abs(matrix[0])


def _display_matrix(frame: VideoFrame) -> tuple[int, ...] | None:
    """Return the 9 numbers that say how a frame is to be shown, None where nothing does."""
    stated: Any = frame.side_data.get("DISPLAYMATRIX")
    return None if stated is None else struct.unpack("=9i", bytes(stated)[: 9 * 4])


def _claimed_frames(stream: VideoStream, container_duration: int | None, rate_hz: float) -> int | None:
    if stream.frames:
        return stream.frames
    if stream.duration is not None and stream.time_base is not None:
        return round(float(stream.duration * stream.time_base) * rate_hz)
    return None if container_duration is None else round(container_duration / av.time_base * rate_hz)
