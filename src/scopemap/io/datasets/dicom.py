"""DICOM: endoscopic video (MPEG), multi-frame images, and folders with one of these or one series of single frames.

DICOM PS3.3, A.32.5 (video endoscopic image). Frames are called by their numbers: file names and everything else in a
DICOM file may be about a patient.
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence as Several
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np

from scopemap.errors import InputError
from scopemap.io.datasets.dicom_files import Header, is_dicom, is_index, is_installed, read_header, require_pydicom
from scopemap.io.datasets.dicom_pictures import pictures
from scopemap.io.datasets.dicom_video import EncapsulatedVideo
from scopemap.io.images import FOLDER_RATE_HZ, image_files, numeric_order
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth

_COMPARED, _CLOCKS_APART = 25, 0.005


class Dicom(SourceDefaults):
    """The pictures of one DICOM file, or of one series in a folder.

    Time stamps are a video's own, else those that the file states (FrameTimeVector, FrameTime, CineRate,
    RecommendedDisplayFrameRate), else frame number / 30 s. Grey pictures show the levels that the file wants shown.
    Frames count from 0; those of a series have their instances' numbers. Raises `InputError` for what holds no pictures
    or several series, and where `pydicom` is not installed.
    """

    name = "dicom"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self.warnings: list[str] = []
        require_pydicom(path)
        self._headers = self._in_folder(path) if path.is_dir() else [read_header(path)]
        first = self._headers[0]
        self._video: EncapsulatedVideo | None = None
        self.numbers = range(first.frames) if len(self._headers) == 1 else self._instances()
        self.count: int | None = len(self.numbers)
        self.width, self.height, self.pixel_aspect = first.columns, first.rows, first.pixel_aspect or 1.0
        self._window = first.window
        self._vector_s, self._rate_hz, clock = first.clock()
        if first.is_video:
            self._video = EncapsulatedVideo(first, self._rate_hz)
            self.warnings = self._video.warnings
            self.width, self.height, self.count = self._video.width, self._video.height, self._video.count
            self.pixel_aspect = first.pixel_aspect or self._video.pixel_aspect
        self.stamped = bool(clock) or self._is_stamped
        if self._video is not None:
            clock = self._clock_of(self._video, clock)
        if not clock:
            clock = f"frame number / {FOLDER_RATE_HZ:g} s (the file states none)"
        self.notes.append(f"time stamps: {clock}")
        if self._vector_s is None and not self._is_stamped and first.fields.get("FrameTimeVector"):
            self._warn("its FrameTimeVector does not increase, or not once for each picture, and was left out")
        stored = int(first.fields.get("BitsStored") or 8)
        if self._window is not None:
            self.notes.append("grey levels: those that the file wants shown (WindowCenter, WindowWidth), as 8 bit")
        elif stored > 8:
            self.notes.append(f"levels: the upper 8 of the {stored} bits that the file says are stored (BitsStored)")
        if first.missing:
            self._warn(f"it claims {first.frames + first.missing} pictures, {first.frames} are there; these were used")
        if any(header.may_show_patient for header in self._headers):
            self._warn("it says that notes, perhaps a patient's name, are burned into the pictures")

    is_installed = staticmethod(is_installed)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a DICOM file, or a folder of these and no other images."""
        if path.is_dir():
            return not image_files(path) and bool(_files(path))
        return is_dicom(path)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; one that cannot be decoded is left out with a warning."""
        if self._video is not None:
            for frame in self._video.frames(selection):
                yield SourceFrame(frame.index, self._time_s(frame.index, frame.time_s), frame.rgb, str(frame.index))
            return
        for number, rgb in self._selected(range(len(self.numbers))[selection]):
            if rgb is None:
                self._warn(f"picture {number} cannot be decoded and was left out")
                continue
            if rgb.shape[:2] != (self.height, self.width):
                raise InputError(
                    f"reading {self.path}: picture {number} is {rgb.shape[1]}x{rgb.shape[0]} px, those before it are "
                    f"{self.width}x{self.height} px; a sequence needs frames of one size"
                )
            yield SourceFrame(number, self._time_s(number), rgb, str(number))

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Return number and time of the selected frames; None for a video, where only decoding tells."""
        if self._video is not None:
            return None
        return [(number, self._time_s(number)) for number in self.numbers[selection]]

    def media(self) -> str | BinaryIO | None:
        """Return the video's stream; None where there is none."""
        return None if self._video is None else self._video.media()

    def pose(self, index: int) -> np.ndarray | None:
        """DICOM knows no pose of an endoscope."""
        return None

    def truth(self, index: int) -> SourceTruth | None:
        """DICOM knows no truth."""
        return None

    def _selected(self, positions: range) -> Iterator[tuple[int, np.ndarray | None]]:
        if len(self._headers) == 1:
            yield from pictures(self._headers[0], positions, self._window)
            return
        for position in positions:
            for _, rgb in pictures(self._headers[position], range(1), self._window):
                yield self.numbers[position], rgb

    def _time_s(self, number: int, otherwise_s: float | None = None) -> float:
        if self._vector_s is not None and number < len(self._vector_s):
            return float(self._vector_s[number])
        if self._rate_hz:
            return number / self._rate_hz
        return number / FOLDER_RATE_HZ if otherwise_s is None else otherwise_s

    @property
    def _is_stamped(self) -> bool:
        return self._video is not None and self._video.stamped

    def _clock_of(self, video: EncapsulatedVideo, stated: str) -> str:
        """Return what tells the time of a video's pictures: the stream where it does, as headers round."""
        if not video.stamped:
            return stated or f"frame number / {video.rate_hz:g} s (neither the file nor the pictures have stamps)"
        own_s = [frame.time_s for frame in video.frames(slice(_COMPARED))]
        said_s = [self._time_s(number, time_s) for number, time_s in enumerate(own_s)]
        ratio = (said_s[-1] - said_s[0]) / (own_s[-1] - own_s[0])
        if abs(ratio - 1) > _CLOCKS_APART:
            self._warn(
                f"its header ({stated}) makes the video {ratio:.3g} times as long as its own time stamps do: these "
                "were used"
            )
        self._vector_s = self._rate_hz = None
        return "the video's"

    def _in_folder(self, path: Path) -> list[Header]:
        """Return the headers of the one series in a folder, sorted."""
        files = _files(path)
        headers, fault = [], ""
        for file in files:
            try:
                headers.append(read_header(file))
            except InputError as error:
                fault = str(error)
        if not headers:
            raise InputError(fault or f"reading {path}: it holds no DICOM file")
        if len(headers) < len(files):
            left_out = f"{len(files) - len(headers)} of {len(files)} DICOM files"
            self._warn(f"{left_out} hold no pictures or cannot be read, and were left out")
        several = [header for header in headers if header.is_several]
        series = {header.series for header in headers if not header.is_several}
        if len(several) + len(series) > 1:
            raise InputError(
                f"reading {path}: it holds {len(several)} videos or multi-frame images and {len(series)} series of "
                "single frames; give one file, or a folder with one series"
            )
        return sorted(headers, key=lambda header: header.instance or 0)

    def _instances(self) -> Several[int]:
        numbers = [header.instance for header in self._headers if header.instance is not None]
        if len(numbers) == len(self._headers) and all(a < b for a, b in pairwise(numbers)):
            return numbers
        self._warn("not every file of the series has a number of its own: they are counted in the order of their names")
        return range(len(self._headers))

    def _warn(self, message: str) -> None:
        if message not in self.warnings:
            self.warnings.append(message)


def _files(folder: Path) -> list[Path]:
    """Return the DICOM files in a folder, but for the list of what a medium holds."""
    files = (file for file in folder.iterdir() if not file.name.startswith(".") and is_dicom(file))
    return sorted((file for file in files if not is_index(file)), key=numeric_order)
