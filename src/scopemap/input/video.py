"""A video file (mp4, avi, mov, mkv and whatever else FFmpeg reads), decoded in order."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream

from scopemap.engine.errors import InputError
from scopemap.input.decoding import limit_in_words, most_pixels
from scopemap.input.sampling import SampledPair, pair_of, pairs_in_order
from scopemap.input.source import Source, SourceFrame

# Some headers give the unit of their clock for the rate.
_HIGHEST_RATE_HZ = 1000.0
# Headers round durations and count pictures that are never shown: less than this is not a video that breaks off.
_MISSING_SHARE = 0.02
_MISSING_FRAMES = 2
_MOST_CODED_PIXELS = 2**31 - 1
# FFmpeg draws text files as a terminal would show them.
_TEXT_CODECS = ("ansi", "bintext", "idf", "xbin")
# A recording may pause, a time lapse be slow; a stamp that runs ahead by more is of another clock.
_LONGEST_GAP_S = 60.0
_LONGEST_GAP_FRAMES = 10
# AVI and WMV keep the stamps of reordered frames slightly out of order; a clock that goes back by more began again.
_DISORDER_S = 1.0


# AVI keeps no order of showing: the stamps that FFmpeg guesses for its reordered pictures are out of order.
_WITHOUT_ORDER = ("avi",)
# An edit list says which parts of a file are shown: mp4, mov.
_WITH_EDIT_LISTS = "mov"
# Packets among which one with a stamp is sought: of a cut video the first may have none.
_MOST_WITHOUT_STAMP = 1000


@dataclass
class _Reading:
    """One pass over a video: packets read, pictures shown and damaged so far, and whether it broke off.

    shown_pts, latest_pts : the latest of the pictures shown so far, and of those in the packets; None without any.
    """

    stamps: TimeStamps
    packets: int = 0
    shown: int = 0
    damaged: int = 0
    broken: bool = False
    shown_pts: int | None = None
    latest_pts: int | None = None

    @property
    def index(self) -> int:
        """Number of the next picture."""
        return self.shown + self.damaged


class VideoFile(Source):
    """A video; frame number = order of decoding, time stamps from the stream, pictures turned as they are to be shown.

    Colours are converted to 8-bit sRGB by the matrix and range of the stream; where it states none, BT.601, limited. A
    video that breaks off, holds damaged pictures or wrong time stamps is used with `warnings`, which grow while it is
    read. Raises `InputError` where it cannot be opened or holds fewer than two readable frames.
    """

    name = "video"
    stamped = True

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._promised = 0  # packets, 0 where no count is stated
        first = [frame for _, _, frame in islice(self._decoded(), 2)]
        if len(first) == 1:
            raise InputError(f"reading the video {path}: it holds one frame, two are needed")
        if not first:
            raise InputError(f"reading the video {path}: it holds no readable frame, or pictures of {limit_in_words()}")
        # Of one frame: a frame whose side data was looked at refers to itself, and waits for the garbage collector.
        self._matrix = matrix = _display_matrix(first[0])
        self.height, self.width = self._shown(first[0], VideoReformatter()).shape[:2]
        with self._opened() as container:
            stream = container.streams.video[0]
            rate_hz = float(stream.average_rate or stream.guessed_rate or 0)
            self.rate_hz = rate_hz if 0 < rate_hz <= _HIGHEST_RATE_HZ else self.rate_hz
            self.stamped = any(frame.time is not None for frame in first) or self._has_stamps()
            if not self.stamped:
                self.notes.append(f"time stamps: frame number / {self.rate_hz:g} s (the video holds none)")
            aspect = float(stream.sample_aspect_ratio or 1.0)
            self.pixel_aspect = 1 / aspect if matrix is not None and _swaps_sides(matrix) else aspect
            duration_s = None if container.duration is None else container.duration / av.time_base
            if stream.duration is not None and stream.time_base is not None:
                duration_s = float(stream.duration * stream.time_base)
            self._promised, self.count = stream.frames, stream.frames
            if self.count and container.format.name.startswith(_WITH_EDIT_LISTS):
                # The file may hold pictures that are only decoded, for the sake of others, or show some twice.
                self._promised = len(stream.index_entries)
                self.count = sum(not entry.is_discard for entry in stream.index_entries)
            elif not self.count:
                self.count = None if duration_s is None else round(duration_s * self.rate_hz)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a file."""
        return path.is_file()

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; those of another size are left out."""
        reformatter = VideoReformatter()  # one for all frames: setting it up costs more than a frame
        for index, time_s, frame in islice(self._decoded(), *self._bounds(selection)):
            shown = self._of_one_size(SourceFrame(index, time_s, self._shown(frame, reformatter)))
            if shown is not None:
                yield shown

    def samples(self, count: int) -> list[np.ndarray]:
        """Return about `count` pictures (h, w, 3) uint8 from all parts of the video, where it can be entered."""
        return [picture for picture, _ in self.sample_pairs(count)]

    def sample_pairs(self, count: int) -> list[SampledPair]:
        """Return the pictures of `samples`, each with the next other one."""
        found, reformatter = dict[int | None, SampledPair](), VideoReformatter()
        with suppress(av.FFmpegError, StopIteration), self._opened() as container:
            start, length = container.start_time or 0, container.duration or 0
            stream = container.streams.video[0]
            for part in range(count if _may_be_entered(container, stream, count // 2) else 0):
                container.seek(start + length * part // count)
                frames = container.decode(stream)
                first = next(frames)
                shown = (self._shown(frame, reformatter) for frame in chain([first], frames))
                if (pair := pair_of(shown)) is not None:
                    found[first.pts] = pair
        pairs = self._of_this_size(found.values())
        if len(pairs) >= count // 2:
            return pairs
        decoded = (frame for _, _, frame in self._decoded())
        return self._of_this_size(pairs_in_order(decoded, count, lambda frame: self._shown(frame, reformatter)))

    def _of_this_size(self, pairs: Iterable[SampledPair]) -> list[SampledPair]:
        return [pair for pair in pairs if pair[0].shape[:2] == (self.height, self.width)]

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

    def _stream(self, container: InputContainer) -> VideoStream:
        stream = next(iter(container.streams.video), None)
        if stream is None or stream.codec_context is None:
            raise InputError(f"reading the video {self.path}: it has no picture that FFmpeg can decode")
        if stream.codec_context.name in _TEXT_CODECS:
            raise InputError(f"reading the video {self.path}: it is a text file, not a video")
        return stream

    def _has_stamps(self) -> bool:
        with suppress(av.FFmpegError), self._opened() as container:
            packets = islice(container.demux(self._stream(container)), _MOST_WITHOUT_STAMP)
            return any(packet.pts is not None for packet in packets)
        return False

    def _decoded(self) -> Iterator[tuple[int, float, VideoFrame]]:
        """Yield number, time stamp, s, and picture of every frame."""
        reading = _Reading(TimeStamps(self.rate_hz))
        try:
            yield from self._read(reading)
        except av.FFmpegError as error:
            if reading.index == 0:
                raise InputError(f"reading the video {self.path}: {error.strerror}") from None
            reading.broken = True
        self._report(reading)

    def _read(self, reading: _Reading) -> Iterator[tuple[int, float, VideoFrame]]:
        due = list[float | None]()
        with self._opened() as container:
            stream = self._stream(container)
            stream.thread_type = "AUTO"
            in_order = container.format.name not in _WITHOUT_ORDER
            for packet in container.demux(stream):
                if packet.size:
                    reading.packets += 1
                    due.append(None if packet.dts is None else float(packet.dts * packet.time_base))
                    if in_order and packet.pts is not None and not packet.is_discard:
                        reading.latest_pts = max(packet.pts, reading.latest_pts or packet.pts)
                try:
                    decoded = packet.decode()
                except av.FFmpegError:
                    reading.damaged += 1
                    continue
                for frame in decoded:
                    # The k-th picture that is shown is due when the k-th is decoded.
                    stamp_s = frame.time if in_order else due[reading.index] if reading.index < len(due) else None
                    yield reading.index, reading.stamps(reading.index, stamp_s), frame
                    reading.shown += 1
                    if in_order and frame.pts is not None:
                        reading.shown_pts = max(frame.pts, reading.shown_pts or frame.pts)
        shown_pts, latest_pts = reading.shown_pts, reading.latest_pts
        if shown_pts is not None and latest_pts is not None and shown_pts < latest_pts:
            for frame in self._end(shown_pts):
                yield reading.index, reading.stamps(reading.index, frame.time), frame
                reading.shown += 1

    def _end(self, last_pts: int) -> Iterator[VideoFrame]:
        """Yield the frames after one, decoded in one thread: several lose all that wait where one is damaged."""
        with self._opened() as container:
            stream = self._stream(container)
            stream.thread_type = "NONE"
            for packet in container.demux(stream):
                with suppress(av.FFmpegError):
                    yield from (frame for frame in packet.decode() if frame.pts is not None and frame.pts > last_pts)

    def _report(self, reading: _Reading) -> None:
        stamps, read = reading.stamps, reading.shown
        claimed = self.count or 0
        # What claims a duration and not a count, of frames at any rate, must be held to that.
        lasted = max(read, round(stamps.span_s * self.rate_hz) + 1)
        missing = self._promised - reading.packets if self._promised else claimed - lasted
        video = f"the video {self.path.name}"
        if reading.broken or missing > _tolerance(claimed):
            of = f" of {claimed}" if claimed > read else ""
            self._warn(f"{video} breaks off after {read}{of} frames; these were used")
        elif self._promised and claimed - reading.index > _tolerance(claimed):
            self._warn(f"{video} holds {claimed - reading.index} picture(s) that cannot be decoded; they are left out")
        if reading.damaged:
            self._warn(f"{video} holds {reading.damaged} damaged picture(s), which were left out")
        if stamps.repaired and self.stamped:
            wrong = f"{stamps.repaired} time stamp(s) that are missing, do not increase or jump"
            follow = f"these frames follow those before them at {self.rate_hz:g} frames/s"
            self._warn(f"{video} has {wrong}, first at frame {stamps.first_repaired}; {follow}")

    def _shown(self, frame: VideoFrame, reformatter: VideoReformatter) -> np.ndarray:
        """Return the picture (h, w, 3) uint8, sRGB, in the orientation in which it is to be shown."""
        rgb = reformatter.reformat(frame, format="rgb24").to_ndarray()
        return rgb if self._matrix is None else upright(rgb, self._matrix)

    def _bounds(self, selection: slice) -> tuple[int | None, int | None, int | None]:
        """Return bounds that count from the start; the header's claim serves only those from the end."""
        if all(bound is None or bound >= 0 for bound in (selection.start, selection.stop)):
            return selection.start, selection.stop, selection.step
        if self.count is None:
            raise InputError(f"reading the video {self.path}: its length is unknown, so count frames from the start")
        return selection.indices(self.count)


def _may_be_entered(container: InputContainer, stream: VideoStream, places: int) -> bool:
    """Return whether a video can be entered at so many places; only some formats list these before they are read."""
    if not container.format.name.startswith(_WITH_EDIT_LISTS):
        return True
    return sum(entry.is_keyframe for entry in stream.index_entries) >= places


def _tolerance(count: int) -> float:
    """Return how many frames a claim of so many may be wrong by."""
    return max(_MISSING_FRAMES, _MISSING_SHARE * count)


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


class TimeStamps:
    """Repairs stamps while frames are read in order.

    rate_hz : frames per second. A stamp that is missing, or does not increase, is put at the rate after the last one
    that was there; those before the first one lead up to it. Where one goes back by more than a second, or runs ahead
    by more than a minute (ten frames of a slow clip), all that follow are moved with it: files that were joined each
    begin at 0.

    repaired, first_repaired : how many stamps were missing or moved, and the number of the first such frame. span_s :
    time from the first to the last stamp as the stream has them, s.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz, self._shift_s, self._known = rate_hz, 0.0, (0, 0.0)
        self._last_s: float | None = None
        self._first_stamp_s: float | None = None
        self.repaired, self.span_s = 0, 0.0
        self.first_repaired: int | None = None

    def __call__(self, index: int, stamp_s: float | None) -> float:
        """Return when the frame with number `index` was taken, s, by its stamp, s or None."""
        number, known_s = self._known
        time_s = known_s + (index - number) / self._rate_hz
        longest_s = max(_LONGEST_GAP_S, _LONGEST_GAP_FRAMES / self._rate_hz)
        step_s = stamp_s + self._shift_s - self._last_s if stamp_s is not None and self._last_s is not None else None
        if self._first_stamp_s is None:
            # Cut videos have no stamps before the cut: the first one that is there goes on from frame 0.
            self._shift_s = 0.0 if stamp_s is None or index == 0 else time_s - stamp_s
            time_s = time_s if stamp_s is None else stamp_s + self._shift_s
        elif stamp_s is not None and step_s is not None and 0 < step_s <= longest_s:
            time_s = stamp_s + self._shift_s
        else:
            if stamp_s is not None and step_s is not None and not -_DISORDER_S <= step_s <= 0:
                self._shift_s = time_s - stamp_s
            self.first_repaired = index if self.first_repaired is None else self.first_repaired
            self.repaired += 1
        if stamp_s is not None:
            self._known = (index, time_s)
            self._first_stamp_s = stamp_s if self._first_stamp_s is None else self._first_stamp_s
            self.span_s = stamp_s - self._first_stamp_s
        self._last_s = time_s
        return time_s
