"""The frame store: tracked frames on disk (about 5 bytes a pixel) until the last one, so that memory stays bounded."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock
from typing import IO

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import InputError
from scopemap.frame import Frame

# ln of millimetres in 16 bits: 0.0001 mm (standard deviations are small) to 34 m in steps of 0.03 %; 0 = unknown.
_LOG_STEP, _MIN_MM = 3e-4, 1e-4
_MAX_CODE = 65535
# Colours only paint the mesh: JPEG takes a fifth of the time and half of the space of a lossless format.
_COLOUR_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


@dataclass(frozen=True)
class _Entry:
    """Small data of a frame, the offset of its images in the file, and their sizes in bytes."""

    index: int
    time_s: float
    camera: PinholeCamera
    T_world_camera: np.ndarray | None
    offset: int
    sizes: list[int]
    median_depth_mm: float


class FrameStore:
    """Stores frames with depth in one file, which is created with the first frame.

    folder : where that file is; None: the system's temporary folder. advice : what else helps where that is full.
    name : of the file, which then stays when the store is closed, for a run to resume; "": it is deleted then.
    """

    NOT_IN_CHECKPOINT = ("_folder",)
    """Not in a checkpoint: a run may go on under another name of its folder."""

    def __init__(self, folder: Path | None = None, advice: str = "", name: str = "") -> None:
        self._folder, self._name = Path(tempfile.gettempdir() if folder is None else folder), name
        self._advice = f", {advice}" if advice else ""
        self._file: IO[bytes] | None = None
        self._entries: list[_Entry] = []
        self._place: dict[int, int] = {}
        self._reading = Lock()

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._entries)

    def put(self, frame: Frame) -> None:
        """Store a frame. Raises `InputError` where the folder is full or read-only."""
        assert frame.depth_mm is not None
        parts = [
            cv2.imencode(".jpg", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), _COLOUR_QUALITY)[1].tobytes(),
            np.packbits(frame.valid).tobytes(),
            np.packbits(np.zeros_like(frame.valid) if frame.highlights is None else frame.highlights).tobytes(),
            *(_encoded(mm).tobytes() for mm in (frame.depth_mm, frame.depth_sigma_mm) if mm is not None),
        ]
        try:
            if self._file is None:
                self._file = self._opened("w+b")
            self._file.seek(0, os.SEEK_END)
            self._file.write(b"".join(parts))
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"cannot store frames in {self._folder}: {error.strerror or error}; free space there{self._advice}"
            ) from None
        sizes = [len(part) for part in parts]
        entry = (
            frame.index,
            frame.time_s,
            frame.camera,
            frame.T_world_camera,
            self._end,
            sizes,
            _median_depth_mm(frame),
        )
        self._place[frame.index] = len(self._entries)
        self._entries.append(_Entry(*entry))

    def _opened(self, mode: str) -> IO[bytes]:
        if not self._name:
            return tempfile.TemporaryFile(dir=self._folder, prefix="scopemap")
        return (self._folder / self._name).open(mode)

    @property
    def _end(self) -> int:
        return self._entries[-1].offset + sum(self._entries[-1].sizes) if self._entries else 0

    def sync(self) -> None:
        """Have the disk hold what was stored. Raises `OSError` where it cannot."""
        if self._file is not None:
            os.fsync(self._file.fileno())

    def reopen(self) -> None:
        """Open the file of the store that this one was restored from; frames put later are cut off."""
        if self._entries:
            self._file = self._opened("r+b")
            self._file.truncate(self._end)

    def frame(self, index: int) -> Frame:
        """Return the frame with this number; any thread may call it."""
        return self._read(self._entries[self._place[index]])

    def poses(self, among: Collection[int]) -> dict[int, np.ndarray]:
        """Return the poses (4, 4) of the frames with the given numbers that have one, by number."""
        some = [entry for entry in self._entries if entry.index in among]
        return {entry.index: entry.T_world_camera for entry in some if entry.T_world_camera is not None}

    def frames(self, among: Collection[int] | None = None) -> Iterator[Frame]:
        """Yield the frames, or those with the given numbers, in order; depth to 0.015 %, colours to a few levels."""
        for entry in self._entries:
            if among is None or entry.index in among:
                yield self._read(entry)

    def median_depth_mm(self, among: Collection[int] | None = None) -> float | None:
        """Return the median of the frames' median depths, mm, None where no depth is known; `among` as in `frames`."""
        some = [entry.median_depth_mm for entry in self._entries if among is None or entry.index in among]
        medians_mm = [median_mm for median_mm in some if np.isfinite(median_mm)]
        return float(np.median(medians_mm)) if medians_mm else None

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            with suppress(OSError):  # a full disk, which `put` has told
                self._file.close()

    def _read(self, entry: _Entry) -> Frame:
        assert self._file is not None
        shape = (entry.camera.height, entry.camera.width)
        with self._reading:
            self._file.seek(entry.offset)
            parts = [np.frombuffer(self._file.read(size), np.uint8) for size in entry.sizes]
        colours, valid, highlights, depth, *sigma = parts
        return Frame(
            entry.index,
            entry.time_s,
            cv2.cvtColor(np.asarray(cv2.imdecode(colours, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB),
            entry.camera,
            _bits(valid, shape),
            _decoded(depth, shape),
            entry.T_world_camera,
            depth_sigma_mm=_decoded(sigma[0], shape) if sigma else None,
            highlights=_bits(highlights, shape),
        )


def _median_depth_mm(frame: Frame) -> float:
    """Return the median of the known depth in a frame's usable pixels, mm; NaN where there is none."""
    assert frame.depth_mm is not None
    some_mm = frame.depth_mm[::4, ::4][frame.valid[::4, ::4]]
    some_mm = some_mm[np.isfinite(some_mm)]
    return float(np.median(some_mm)) if some_mm.size else float("nan")


def _encoded(mm: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        code = np.float32(1.5 - np.log(_MIN_MM) / _LOG_STEP) + np.log(mm) * np.float32(1 / _LOG_STEP)
    # Beyond the range is unknown, not at its end.
    return np.where(np.isfinite(code) & (code < _MAX_CODE + 1), np.maximum(code, 1), 0).astype(np.uint16)


def _bits(packed: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return np.unpackbits(packed, count=shape[0] * shape[1]).reshape(shape).astype(bool)


def _decoded(code: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return _millimetres()[code.view(np.uint16).reshape(shape)]


@cache
def _millimetres() -> np.ndarray:
    """Return the depth that each code stands for, (65536,) float32."""
    mm = _MIN_MM * np.exp((np.arange(_MAX_CODE + 1) - 1) * _LOG_STEP)
    mm[0] = np.nan
    return mm.astype(np.float32)
