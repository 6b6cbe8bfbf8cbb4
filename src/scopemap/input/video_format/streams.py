"""Which stream of a file is its video, how long that one lasts, and what a file is that holds none."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import av
from av.container import InputContainer
from av.stream import Disposition
from av.video.stream import VideoStream

from scopemap.input.decoding import TIFF, first_bytes

# Formats of cover pictures. A video may have one of them, too: only its length tells.
_PICTURE_CODECS = ("bmp", "gif", "jpegxl", "mjpeg", "png", "tiff", "webp")
_DURATION = re.compile(r"(\d+):(\d+):(\d+(?:\.\d+)?)")  # what Matroska's writers state of each stream
_LOOKED_AT_BYTES = 4096
_CONTROLS = frozenset(range(32)) - set(b"\t\n\f\r\x1b")  # in no text


def video_stream(container: InputContainer) -> VideoStream | None:
    """Return the stream that is the video: FFmpeg's default among those that are no cover picture; None without any."""
    streams = [stream for stream in container.streams.video if stream.codec_context is not None]
    moving = [stream for stream in streams if not is_cover(stream)] or streams
    best = container.streams.best("video")
    return next((stream for stream in moving if best is not None and stream.index == best.index), _first(moving))


def _first(streams: list[VideoStream]) -> VideoStream | None:
    return next((one for one in streams if one.disposition & Disposition.default), next(iter(streams), None))


def is_cover(stream: VideoStream) -> bool:
    """Return whether a stream is one picture, such as the cover of a file."""
    if stream.disposition & Disposition.attached_pic:
        return True
    is_one = stream.frames == 1 or (not stream.frames and len(stream.index_entries) == 1)
    return is_one and stream.codec_context.name in _PICTURE_CODECS


def other_streams(container: InputContainer, used: VideoStream) -> str:
    """Return a phrase that names the video streams that are not used; "" where there is none."""
    others = [stream for stream in container.streams.video if stream.index != used.index]
    if not others:
        return ""
    named = ", ".join(f"{_named(stream)}{', a cover picture' * is_cover(stream)}" for stream in others)
    count = len(others) + 1
    return f"the file holds {count} video streams: {_named(used)} is used, not {named}"


def _named(stream: VideoStream) -> str:
    size = f", {stream.width}x{stream.height} px" if stream.codec_context is not None else ""
    return f"stream {stream.index}{size}"


def stated_length_s(container: InputContainer, stream: VideoStream) -> tuple[float | None, bool]:
    """Return how long the video lasts by the header, s or None, and whether that is the video's own length.

    A file's length alone may be that of its sound.
    """
    if stream.duration is not None and stream.time_base is not None:
        return float(stream.duration * stream.time_base), True
    stated = _DURATION.match(stream.metadata.get("DURATION", ""))
    if stated:
        hours, minutes, seconds = stated.groups()
        return 3600 * int(hours) + 60 * int(minutes) + float(seconds), True
    return (None if container.duration is None else container.duration / av.time_base), len(container.streams) == 1


def lasts_to_the_end(container: InputContainer, within_s: float) -> bool:
    """Return whether some stream of an open file, such as its sound, goes on to the end that its header states."""
    if container.duration is None:
        return False
    last_s, due_s = 0.0, ((container.start_time or 0) + container.duration) / av.time_base
    with suppress(av.FFmpegError):
        for packet in container.demux():
            if packet.pts is not None and packet.time_base is not None:
                last_s = max(last_s, float((packet.pts + (packet.duration or 0)) * packet.time_base))
    return last_s >= due_s - within_s


def why_few_pictures(file: Path) -> str:
    """Return a phrase that says why FFmpeg reads fewer than two pictures in a file that may hold more; "" else."""
    start = first_bytes(file, _LOOKED_AT_BYTES)
    if start[:4] in TIFF:
        return "of a TIFF only the first picture is read; save its pages as a folder of images"
    if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
        return "animated WebP is not read; save it as a video or a folder of images"
    return ""


def why_no_video(file: Path) -> str:
    """Return a phrase that says why FFmpeg reads no video in a file."""
    start = first_bytes(file, _LOOKED_AT_BYTES)
    if not start:
        return "it is empty"
    if not _CONTROLS & set(start):
        return "it is a text file, not a video; give a video, a folder of images or a data set"
    if start[4:8] == b"ftyp":
        return "its index (moov) is missing or damaged: the recording or copy is incomplete; copy it again"
    return "it is not a video, or its beginning is damaged; give a file that a player shows, or a folder of images"
