"""A video file (mp4, avi, mov, mkv and whatever else FFmpeg reads), decoded in order."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from scopemap.datasets.sequence import KnowsNothing, SourceFrame, SourceTruth
from scopemap.errors import InputError

DEFAULT_RATE_HZ = 30.0
# Headers round durations and count pictures that are never shown: less than this is not a video that breaks off.
_MISSING_SHARE, _MISSING_FRAMES = 0.02, 2
# FFmpeg draws text files as a terminal would show them.
_TEXT_CODECS = ("ansi", "bintext", "idf", "xbin")


class VideoFile(KnowsNothing):
    """A video; frame number = order of decoding, time stamps from the stream.

    A video that breaks off, or holds damaged pictures, is used as far as it goes; `warnings` says so once it was read.
    Raises `InputError` where it cannot be opened or holds fewer than two readable frames.
    """

    name = "video"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.warnings: list[str] = []
        first = [frame for _, frame in islice(self._decoded(), 2)]
        if len(first) < 2:
            found = "holds one frame, two are needed" if first else "holds no readable frame"
            raise InputError(f"reading the video {path}: it {found}")
        self.width, self.height = first[0].width, first[0].height
        with av.open(str(path), metadata_errors="replace") as container:
            stream = container.streams.video[0]
            self.rate_hz = float(stream.average_rate or stream.guessed_rate or 0)
            if not self.rate_hz:
                self.rate_hz = DEFAULT_RATE_HZ
                self.notes.append(f"time stamps: frame number / {DEFAULT_RATE_HZ:g} s (the video holds none)")
            self.pixel_aspect = float(stream.sample_aspect_ratio or 1.0)
            self.count = _claimed_frames(stream, container.duration, self.rate_hz)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a file."""
        return path.is_file()

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames."""
        for index, frame in islice(self._decoded(), *self._bounds(selection)):
            if (frame.width, frame.height) != (self.width, self.height):
                raise InputError(
                    f"reading the video {self.path}: frame {index} is {frame.width}x{frame.height} px, those before it "
                    f"are {self.width}x{self.height} px; cut the video there"
                )
            time_s = index / self.rate_hz if frame.time is None else frame.time
            yield SourceFrame(index, time_s, frame.to_ndarray(format="rgb24"))

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Only decoding tells how many frames there are, and when."""
        return None

    def pose(self, index: int) -> np.ndarray | None:
        """A video knows no pose."""
        return None

    def truth(self, index: int) -> SourceTruth | None:
        """A video knows no truth."""
        return None

    def _decoded(self) -> Iterator[tuple[int, VideoFrame]]:
        index = damaged = 0
        broken = False
        try:
            with av.open(str(self.path), metadata_errors="replace") as container:
                if not container.streams.video:
                    raise InputError(f"reading the video {self.path}: it has no picture")
                stream = container.streams.video[0]
                if stream.codec_context is None:
                    raise InputError(f"reading the video {self.path}: FFmpeg knows no decoder for it")
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
                        yield index, frame
                        index += 1
        except av.FFmpegError as error:
            if index == 0:
                raise InputError(f"reading the video {self.path}: {error.strerror}") from None
            broken = True
        self._report(index, damaged, broken)

    def _report(self, read: int, damaged: int, broken: bool) -> None:
        claimed = getattr(self, "count", None) or 0
        if broken or claimed - read > max(_MISSING_FRAMES, _MISSING_SHARE * claimed):
            of = f" of {claimed}" if claimed > read else ""
            self._warn(f"the video {self.path.name} breaks off after {read}{of} frames; these were used")
        if damaged:
            self._warn(f"the video {self.path.name} holds {damaged} damaged picture(s), which were left out")

    def _warn(self, message: str) -> None:
        if message not in self.warnings:
            self.warnings.append(message)

    def _bounds(self, selection: slice) -> tuple[int | None, int | None, int | None]:
        """Return bounds that count from the start; the header's claim serves only those from the end."""
        if all(bound is None or bound >= 0 for bound in (selection.start, selection.stop)):
            return selection.start, selection.stop, selection.step
        if self.count is None:
            raise InputError(f"reading the video {self.path}: its length is unknown, so count frames from the start")
        return selection.indices(self.count)


def _claimed_frames(stream: VideoStream, container_duration: int | None, rate_hz: float) -> int | None:
    if stream.frames:
        return stream.frames
    if stream.duration is not None and stream.time_base is not None:
        return round(float(stream.duration * stream.time_base) * rate_hz)
    return None if container_duration is None else round(container_duration / av.time_base * rate_hz)
