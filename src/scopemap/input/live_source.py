"""A live source: a camera, a stream, or a file at its own speed; the newest frame counts, older ones are dropped."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterator
from contextlib import closing
from pathlib import Path

import av
import cv2
import numpy as np
from av.video.reformatter import VideoReformatter

from scopemap.engine.errors import InputError
from scopemap.input.opening import open_source
from scopemap.input.source import Source, SourceFrame
from scopemap.input.video_format.streams import video_stream

_Pictures = Generator[tuple[float | None, np.ndarray], None, None]
_TIMEOUT_S = 10.0
_STREAM_OPTIONS = {"rtsp_transport": "tcp", "flags": "low_delay"}


class LiveSource(Source):
    """Frames of a camera, a stream or a file, read in a thread of their own; a slow consumer gets the newest.

    address : the number of a camera, a device (/dev/video0), an address that FFmpeg opens (rtsp://...), or a file or
        folder, which is played by its own time stamps.

    Frame numbers count all frames read, `time_s` is the time since the first. `read` and `dropped` count frames; while
    `paused` is set, frames are read and left out. `first` : the first picture, (h, w, 3) uint8, which `frames` yields,
    too, where it comes from a file. Raises `InputError` where it cannot be opened or gives no frame within ten seconds.
    """

    name = "live"
    stamped = True
    frame_limit_s = None  # it may be paused

    def __init__(self, address: str) -> None:
        super().__init__(Path(address))
        self.read, self.dropped, self.paused = 0, 0, False
        self._pictures = self._opened(address)
        if (first := next(self._pictures, None)) is None:
            raise InputError(f"reading {address}: it gives no picture")
        self._stamp_s, self.first = first
        self.height, self.width = self.first.shape[:2]
        self._started_s = time.monotonic()
        self._newest: SourceFrame | None = None
        self._ended, self._fault = False, ""
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, name="live", daemon=True)

    def now_s(self) -> float:
        """Return the present time, s, on the clock of `time_s`."""
        return time.monotonic() - self._started_s

    def stop(self) -> None:
        """End the frames: the present one is the last."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the newest frame until the source ends or `stop` is called, more where called again; no `selection`."""
        if self._thread.ident is None:
            self._started_s = time.monotonic()
            self._thread.start()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self._newest is not None)
                frame, self._newest = self._newest, None
                if frame is None or (self._ended and self.paused):
                    break
            yield frame
        if self._fault:
            self._warn(self._fault)

    def _read(self) -> None:
        try:
            with closing(self._pictures):
                if self._stamp_s is not None:  # of a file; a camera's is old by now
                    self._put(self._stamp_s, self.first)
                for stamp_s, rgb in self._pictures:
                    if self._ended:
                        return
                    self._put(stamp_s, rgb)
        except InputError as error:
            self._fault = str(error)
        finally:
            self.stop()

    def _put(self, stamp_s: float | None, rgb: np.ndarray) -> None:
        """Publish a picture when its time has come; the one before is dropped where nobody has taken it."""
        with self._changed:
            if stamp_s is not None:
                self._changed.wait_for(lambda: self._ended, timeout=max(stamp_s - self.now_s(), 0.0))
            frame = self._of_one_size(SourceFrame(self.read, self.now_s() if stamp_s is None else stamp_s, rgb))
            if frame is not None and not self.paused:
                self.dropped += self._newest is not None
                self._newest = frame
                self._changed.notify_all()
            self.read += 1

    def _opened(self, address: str) -> _Pictures:
        """Return what yields the time stamp of each picture, s from 0, None for now, and the picture."""
        if address.isdecimal() or address.startswith("/dev/"):
            return _camera(address)
        if "://" in address:
            return _stream(address)
        source = open_source(address)
        self.pixel_aspect, self.calibration = source.pixel_aspect, source.calibration
        self.camera, self.camera_source = source.camera, source.camera_source
        return _played(source)


def _played(source: Source) -> _Pictures:
    first_s = None
    for frame in source.frames(slice(None)):
        first_s = frame.time_s if first_s is None else first_s
        yield frame.time_s - first_s, frame.rgb


def _camera(address: str) -> _Pictures:
    camera = cv2.VideoCapture(int(address) if address.isdecimal() else address)
    try:
        if not camera.isOpened():
            raise InputError(f"reading {address}: no such camera, or it is in use")
        camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        while True:
            found, bgr = camera.read()
            if not found:
                raise InputError(f"reading {address}: the camera gives no more pictures")
            yield None, cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    finally:
        camera.release()


def _stream(address: str) -> _Pictures:
    try:
        with av.open(address, options=_STREAM_OPTIONS, timeout=_TIMEOUT_S) as container:
            reformatter = VideoReformatter()
            if (stream := video_stream(container)) is None:
                raise InputError(f"reading {address}: it has no picture that FFmpeg can decode")
            for frame in container.decode(stream):
                yield None, reformatter.reformat(frame, format="rgb24").to_ndarray()
    except av.FFmpegError as error:
        raise InputError(f"reading {address}: {error}") from None
