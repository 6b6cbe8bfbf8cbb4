"""A video file (mp4, avi, mov, mkv and whatever else FFmpeg reads), decoded in order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path

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
from scopemap.input.video_format.entry import WITH_EDIT_LISTS, FrameIndex, changes_size, entered, frame_index
from scopemap.input.video_format.orientation import display_matrix, swaps_sides, upright
from scopemap.input.video_format.streams import (
    lasts_to_the_end,
    other_streams,
    stated_length_s,
    video_stream,
    why_few_pictures,
    why_no_video,
)
from scopemap.input.video_format.time_stamps import TimeStamps

# Some headers give the unit of their clock for the rate.
_HIGHEST_RATE_HZ = 1000.0
# Headers round durations and count pictures that are never shown: less than this is not a video that breaks off.
_MISSING_SHARE = 0.02
_MISSING_FRAMES = 2
_MOST_CODED_PIXELS = 2**31 - 1
# FFmpeg draws text files as a terminal would show them.
_TEXT_CODECS = ("ansi", "bintext", "idf", "xbin")
# AVI keeps no order of showing: the stamps that FFmpeg guesses for its reordered pictures are out of order.
_WITHOUT_ORDER = ("avi",)
# Packets among which one with a stamp is sought: of a cut video the first may have none.
_MOST_WITHOUT_STAMP = 1000


@dataclass
class _DecodingPass:
    """One pass over a video: packets read, pictures shown and damaged so far, and whether it broke off.

    shown_pts, latest_pts : the latest of the pictures shown so far, and of those in the packets; None without any.
    smeared : number of the first picture of which data are missing; None: of none.
    """

    stamps: TimeStamps
    packets: int = 0
    shown: int = 0
    damaged: int = 0
    broken: bool = False
    shown_pts: int | None = None
    latest_pts: int | None = None
    smeared: int | None = None

    @property
    def index(self) -> int:
        """Number of the next picture."""
        return self.shown + self.damaged

    def begin(self, rate_hz: float, number: int) -> None:
        """Begin at a picture, as if those before it had been shown."""
        self.stamps, self.packets, self.shown, self.damaged = TimeStamps(rate_hz, number), number, number, 0


class _NotEnteredError(Exception):
    """A video was entered at a picture that cannot be decoded without those before it."""


class VideoFile(Source):
    """A video; frame number = place in the video, damaged pictures counted; pictures turned as they are to be shown.

    Time stamps come from the stream. Colours are converted to 8-bit sRGB by the matrix and range of the stream; where
    it states none, BT.601, limited. A video that breaks off, holds damaged pictures or wrong time stamps is used with
    `warnings`, which grow while it is read. Of several streams the default one is used. Where the index of an mp4 or
    mov is exact, it is entered at the key picture before the selected frames. Raises `InputError` where it cannot be
    opened or holds fewer than two readable frames.
    """

    name = "video"
    stamped = True

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._promised = 0  # packets, 0 where no count is stated
        self._length_is_own = True
        self._coded_aspect: Fraction | None = None  # of the picture that was decoded last
        self._frame_index: FrameIndex | None = None
        self._is_smeared = False
        self._counted = dict[tuple[int | None, int | None], tuple[int, int | None]]()
        first = [frame for _, _, frame in islice(self._decoded(), 2)]
        if len(first) < 2 and (why := why_few_pictures(path)):
            raise InputError(f"reading the video {path}: {why}")
        if len(first) == 1:
            raise InputError(f"reading the video {path}: it holds one frame, two are needed")
        if not first:
            raise InputError(f"reading the video {path}: it holds no readable frame, or pictures of {limit_in_words()}")
        # Of one frame: a frame whose side data was looked at refers to itself, and waits for the garbage collector.
        self._matrix = display_matrix(first[0])
        self.height, self.width = self._shown(first[0], VideoReformatter()).shape[:2]
        with self._opened() as container:
            stream = self._stream(container)
            rate_hz = float(stream.average_rate or stream.guessed_rate or 0)
            self.rate_hz = rate_hz if 0 < rate_hz <= _HIGHEST_RATE_HZ else self.rate_hz
            self.stamped = any(frame.time is not None for frame in first) or self._has_stamps()
            if not self.stamped:
                self.notes.append(f"time stamps: frame number / {self.rate_hz:g} s (the video holds none)")
            if others := other_streams(container, stream):
                self.notes.append(others)
            self._take_aspect(stream.sample_aspect_ratio)
            self._take_count(container, stream)

    def _take_aspect(self, stated: Fraction | None) -> None:
        aspect = float(stated or 1.0)
        self.pixel_aspect = 1 / aspect if self._matrix is not None and swaps_sides(self._matrix) else aspect

    def _take_count(self, container: InputContainer, stream: VideoStream) -> None:
        duration_s, self._length_is_own = stated_length_s(container, stream)
        self._promised, self.count = stream.frames, stream.frames
        if self.count and container.format.name.startswith(WITH_EDIT_LISTS):
            # The file may hold pictures that are only decoded, for the sake of others, or show some twice.
            self._promised = len(stream.index_entries)
            self.count = sum(not entry.is_discard for entry in stream.index_entries)
            self._frame_index = frame_index(container, stream)
        elif not self.count:
            self.count = None if duration_s is None else round(duration_s * self.rate_hz)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a file."""
        return path.is_file()

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; those of another size are left out."""
        reformatter = VideoReformatter()  # one for all frames: setting it up costs more than a frame
        for index, time_s, frame in self._selected(selection):
            shown = self._of_one_size(SourceFrame(index, time_s, self._shown(frame, reformatter)))
            if shown is not None:
                yield shown

    def entry(self, number: int) -> int:
        """Return the position of the last key picture up to a position."""
        return 0 if self._frame_index is None else self._frame_index.key_before(number)

    def begin_at(self, selection: slice) -> None:
        """Take size and pixel aspect of the first selected picture: they may change within a video."""
        start = self._bounds(selection)[0]
        if start == 0 or not self._may_change_size(start):
            return
        for _, _, frame in self._selected(slice(start, start + 1)):
            height, width = self._shown(frame, VideoReformatter()).shape[:2]
            if (width, height) != (self.width, self.height):
                self.width, self.height = width, height
                self._take_aspect(self._coded_aspect)

    def _may_change_size(self, until: int) -> bool:
        if self._frame_index is not None:
            return True
        with suppress(av.FFmpegError), self._opened() as container:
            return changes_size(container, self._stream(container), until)
        return False

    def _selected(self, selection: slice) -> Iterator[tuple[int, float, VideoFrame]]:
        """Yield number, time stamp, s, and picture of those whose number is selected."""
        start, stop = self._bounds(selection)
        step = selection.step or 1
        is_beyond = self._frame_index is not None and start >= len(self._frame_index.dts)
        if is_beyond or (stop is not None and stop <= start):
            return
        for index, time_s, frame in self._decoded(start):
            if stop is not None and index >= stop:
                return
            if index >= start and (index - start) % step == 0:
                yield index, time_s, frame
            if stop is not None and index + 1 >= stop:
                return

    def samples(self, count: int) -> list[np.ndarray]:
        """Return about `count` pictures (h, w, 3) uint8 from all parts of the video, where it can be entered."""
        return [picture for picture, _ in self.sample_pairs(count)]

    def sample_pairs(self, count: int) -> list[SampledPair]:
        """Return the pictures of `samples`, each with the next other one."""
        found, reformatter = dict[int | None, SampledPair](), VideoReformatter()
        with suppress(av.FFmpegError, StopIteration), self._opened() as container:
            start, length = container.start_time or 0, container.duration or 0
            stream = self._stream(container)
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
        stream = video_stream(container)
        if stream is None:
            raise InputError(f"reading the video {self.path}: it has no picture that FFmpeg can decode")
        if stream.codec_context.name in _TEXT_CODECS:
            raise InputError(f"reading the video {self.path}: {why_no_video(self.path)}")
        return stream

    def _has_stamps(self) -> bool:
        with suppress(av.FFmpegError), self._opened() as container:
            packets = islice(container.demux(self._stream(container)), _MOST_WITHOUT_STAMP)
            return any(packet.pts is not None for packet in packets)
        return False

    def _decoded(self, start: int = 0) -> Iterator[tuple[int, float, VideoFrame]]:
        """Yield number, time stamp, s, and picture of every frame from `start` on, and of some before it."""
        reading = _DecodingPass(TimeStamps(self.rate_hz))
        try:
            try:
                yield from self._read(reading, start)
            except _NotEnteredError:
                reading.begin(self.rate_hz, 0)
                yield from self._read(reading, 0)
        except av.FFmpegError as error:
            if reading.index == 0:
                why = why_no_video(self.path) if isinstance(error, av.InvalidDataError) else error.strerror
                raise InputError(f"reading the video {self.path}: {why}") from None
            reading.broken = True
        self._report(reading)

    def _read(self, reading: _DecodingPass, start: int) -> Iterator[tuple[int, float, VideoFrame]]:
        due = list[float | None]()
        with self._opened() as container:
            stream = self._stream(container)
            stream.thread_type = "AUTO"
            in_order = container.format.name not in _WITHOUT_ORDER
            index = self._frame_index
            entry = None if start == 0 or index is None else entered(container, stream, index, start)
            if entry is not None:
                reading.begin(self.rate_hz, entry.number)
            for packet in container.demux(stream) if entry is None else entry.packets:
                if packet.size:
                    if packet.is_corrupt and reading.smeared is None:
                        reading.smeared = reading.packets
                    reading.packets += 1
                    due.append(None if packet.dts is None else float(packet.dts * packet.time_base))
                    if in_order and packet.pts is not None and not packet.is_discard:
                        reading.latest_pts = max(packet.pts, reading.latest_pts or packet.pts)
                try:
                    decoded = packet.decode()
                except av.FFmpegError:
                    reading.damaged += entry is None or reading.shown_pts is not None
                    continue
                for frame in decoded:
                    if entry is not None and reading.shown_pts is None and not _is_entry(frame, entry.pts):
                        continue
                    self._look_for_smears(frame, reading)
                    # The k-th picture that is shown is due when the k-th is decoded.
                    self._coded_aspect = stream.codec_context.sample_aspect_ratio
                    stamp_s = frame.time if in_order else due[reading.index] if reading.index < len(due) else None
                    yield reading.index, reading.stamps(reading.index, stamp_s), frame
                    reading.shown += 1
                    if in_order and frame.pts is not None:
                        reading.shown_pts = max(frame.pts, reading.shown_pts or frame.pts)
        if entry is not None and reading.shown_pts is None:
            raise _NotEnteredError
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

    def _look_for_smears(self, frame: VideoFrame, reading: _DecodingPass) -> None:
        """Warn once: FFmpeg fills what is missing from other pictures, and shows the result as if it were sound.

        Where nothing follows, the video breaks off, which is said by itself.
        """
        if frame.is_corrupt and reading.smeared is None:
            reading.smeared = reading.index
        if self._is_smeared or reading.smeared is None or reading.index <= reading.smeared:
            return
        self._is_smeared = True
        found = f"the data of the video {self.path.name} are interrupted or damaged near frame {reading.smeared}"
        self._warn(f"{found}: unless pieces were joined there, pictures up to the next key picture may be smeared")

    def _report(self, reading: _DecodingPass) -> None:
        stamps, read = reading.stamps, reading.shown
        claimed = self.count or 0
        # What claims a duration and not a count, of frames at any rate, must be held to that.
        lasted = max(read, round(stamps.span_s * self.rate_hz) + 1)
        missing = self._promised - reading.packets if self._promised else claimed - lasted
        video = f"the video {self.path.name}"
        if missing > _tolerance(claimed) and not reading.broken and not self._promised and self._sound_is_longer():
            self.count = reading.index
        elif reading.broken or missing > _tolerance(claimed):
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

    def _sound_is_longer(self) -> bool:
        """Return whether the length that the header states is that of another stream, which is complete."""
        if self._length_is_own:
            return False
        with suppress(av.FFmpegError), self._opened() as container:
            return lasts_to_the_end(container, _MISSING_SHARE * (container.duration or 0) / av.time_base)
        return False

    def _shown(self, frame: VideoFrame, reformatter: VideoReformatter) -> np.ndarray:
        """Return the picture (h, w, 3) uint8, sRGB, in the orientation in which it is to be shown."""
        rgb = reformatter.reformat(frame, format="rgb24").to_ndarray()
        return rgb if self._matrix is None else upright(rgb, self._matrix)

    def _bounds(self, selection: slice) -> tuple[int, int | None]:
        """Return the numbers of the first selected frame and of that after the last one, None: to the end.

        Negative ones count the pictures that are shown, whatever the header claims: all are decoded once.
        """
        start, stop = selection.start or 0, selection.stop
        if start >= 0 and (stop is None or stop >= 0):
            return start, stop
        if (start, stop) not in self._counted:
            most = max(-start, -(stop or 0))
            numbers = self._last_numbers(most)
            self.count = numbers[-1] + 1 if numbers else 0
            first, end = (
                bound if bound is None or bound >= 0 else numbers[bound] if -bound <= len(numbers) else 0
                for bound in (start, stop)
            )
            self._counted[start, stop] = first or 0, end
        return self._counted[start, stop]

    def _last_numbers(self, most: int) -> list[int]:
        """Return the numbers of the last pictures, `most` of them or more, or of all."""
        begin = max(0, (self.count or 0) - most) if self._frame_index is not None else 0
        numbers = [index for index, _, _ in self._decoded(begin)]
        return numbers if len(numbers) >= most or begin == 0 else [index for index, _, _ in self._decoded()]


def _is_entry(frame: VideoFrame, pts: int) -> bool:
    """Return whether a frame is the key picture with this stamp; False for those shown before it.

    Raises `_NotEnteredError` where it is missing or damaged.
    """
    if frame.pts is None or frame.pts > pts or (frame.pts == pts and frame.is_corrupt):
        raise _NotEnteredError
    return bool(frame.pts == pts)


def _may_be_entered(container: InputContainer, stream: VideoStream, places: int) -> bool:
    """Return whether a video can be entered at so many places; only some formats list these before they are read."""
    if not container.format.name.startswith(WITH_EDIT_LISTS):
        return True
    return sum(entry.is_keyframe for entry in stream.index_entries) >= places


def _tolerance(count: int) -> float:
    """Return how many frames a claim of so many may be wrong by."""
    return max(_MISSING_FRAMES, _MISSING_SHARE * count)
