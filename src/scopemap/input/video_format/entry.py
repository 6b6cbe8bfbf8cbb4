"""Entering a video at a key picture, where the file's index tells the number of each picture before it is read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice

import av
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.video.stream import VideoStream

from scopemap.input.video_format.time_stamps import LONGEST_GAP_S

WITH_EDIT_LISTS = "mov"
"""FFmpeg's name of the formats mp4 and mov; an edit list says which parts of such a file are shown."""

_MOST_TRIES = 8  # key pictures that are tried, one before the other
# No field or picture that is hidden in a packet of its own doubles the count by more.
_MOST_PACKETS = 2


@dataclass(frozen=True)
class FrameIndex:
    """All pictures of a file in the order of decoding. dts : due times (N,) int64, ascending. keys : positions."""

    dts: np.ndarray
    keys: np.ndarray

    def key_before(self, number: int) -> int:
        """Return the position of the last key picture up to a position."""
        return int(self.keys[self.keys <= number].max(initial=0))


@dataclass(frozen=True)
class Entry:
    """Where a video was entered: number and stamp of the key picture, and the packets from it on."""

    number: int
    pts: int
    packets: Iterator[Packet[VideoStream]]


def frame_index(container: InputContainer, stream: VideoStream) -> FrameIndex | None:
    """Return the index of a video; None where it is not exact.

    Exact is that of an mp4 or mov which lists each picture once, shows all of them, and whose clock does not jump.
    """
    if not container.format.name.startswith(WITH_EDIT_LISTS) or not stream.frames or stream.time_base is None:
        return None
    entries = [(one.timestamp, one.size, one.is_keyframe, one.is_discard) for one in stream.index_entries]
    if len(entries) != stream.frames or any(size <= 0 or discard for _, size, _, discard in entries):
        return None
    dts, is_key = np.array([e[0] for e in entries], dtype=np.int64), np.array([e[2] for e in entries])
    steps = np.diff(dts)
    if (steps <= 0).any() or (2 * steps * float(stream.time_base) > LONGEST_GAP_S).any():
        return None
    return FrameIndex(dts, np.flatnonzero(is_key))


def entered(container: InputContainer, stream: VideoStream, index: FrameIndex, number: int) -> Entry | None:
    """Go to the last key picture from which the picture `number` can be decoded; None, at the start: there is none."""
    if number < len(index.dts):
        # The picture's stamp where all take equally long, then earlier and earlier key pictures.
        stamp = int(index.dts[number] - index.dts[0]) + (stream.start_time or 0)
        for target in [stamp, *index.dts[index.keys[index.keys <= number][::-1]][:_MOST_TRIES].tolist()]:
            with suppress(av.FFmpegError, StopIteration):
                container.seek(target, stream=stream)
                entry = _entry(container.demux(stream), index)
                if entry is not None and 0 < entry.number <= number:
                    return entry
        container.seek(int(index.dts[0]), stream=stream)
    return None


def _entry(packets: Iterator[Packet[VideoStream]], index: FrameIndex) -> Entry | None:
    """Return the entry at the first of some packets; None where the index does not know that as a key picture.

    All that is decoded before a key picture is shown before it, and so are those decoded after it with earlier stamps.
    """
    first = next(packets)
    if not first.is_keyframe or first.pts is None or first.dts is None:
        return None
    position = int(np.searchsorted(index.dts, first.dts))
    if position >= len(index.dts) or index.dts[position] != first.dts:
        return None
    head = [first]
    for packet in packets:
        head.append(packet)
        if packet.dts is None or packet.dts >= first.pts:
            break
    leading = sum(packet.pts is not None and packet.pts < first.pts for packet in head)
    return Entry(position + leading, first.pts, chain(head, packets))


def changes_size(container: InputContainer, stream: VideoStream, until: int) -> bool:
    """Return whether the key pictures up to about the picture `until` differ in size; no others are decoded."""
    sizes, most = set[tuple[int, int]](), _MOST_PACKETS * (until + 1)
    stream.codec_context.skip_frame = "NONKEY"
    stream.thread_type = "SLICE"
    for packet in islice(container.demux(stream), most):
        if packet.is_keyframe or not packet.size:
            with suppress(av.FFmpegError):
                sizes |= {(frame.width, frame.height) for frame in packet.decode()}
        if len(sizes) > 1:
            return True
    with suppress(av.FFmpegError):
        sizes |= {(frame.width, frame.height) for frame in stream.codec_context.decode(None)}
    return len(sizes) > 1
