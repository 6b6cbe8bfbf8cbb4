"""DICOM: endoscopic video (MPEG), multi-frame images, and folders with one of these or one series of single frames.

DICOM PS3.3, A.32.5 (video endoscopic image). Frames are named by their numbers: file names and everything else in a
DICOM file may be about a patient.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.io.datasets.dicom_files import EncapsulatedVideo, Header, images, read_header
from scopemap.io.decoding import first_bytes
from scopemap.io.images import image_files, numeric_order
from scopemap.io.source import Source, SourceFrame
from scopemap.notices import Notice

_PREAMBLE, _MAGIC, _META_BYTES = 128, b"DICM", 512
# The SOP class of a directory of a medium (PS3.3, F), as an element of the file's own header.
_DIRECTORY = b"\x02\x00\x02\x00UI\x14\x001.2.840.10008.1.3.10"


class Dicom(Source):
    """The images of one DICOM file, or of one series in a folder.

    Time stamps are a video's own, else those of the header (FrameTimeVector, FrameTime, CineRate,
    RecommendedDisplayFrameRate), else frame number / 30 s. Frames count from 0; those of a series have the numbers of
    their instances. Raises `InputError` for what holds no images or several series, and without `pydicom`.
    """

    name = "dicom"

    def __init__(self, path: Path) -> None:
        if find_spec("pydicom") is None:
            raise InputError(f"reading {path}: it is DICOM; install its reader: pip install -e '.[dicom]'")
        super().__init__(path)
        self._headers = self._in_folder(path) if path.is_dir() else [read_header(path)]
        first = self._headers[0]
        self.numbers, self.count = range(first.frames), first.frames
        if len(self._headers) > 1:
            self.numbers, self.count = range(len(self._headers)), len(self._headers)
            instances = [header.instance for header in self._headers if header.instance is not None]
            if len(instances) == self.count and all(a < b for a, b in pairwise(instances)):
                self.numbers = instances
            else:
                self._warn("not every file of the series has a number of its own: counted in the order of their names")
        self.width, self.height = int(first.fields.Columns), int(first.fields.Rows)
        self.pixel_aspect = first.pixel_aspect or 1.0
        self.times_s, rate_hz, clock = first.clock()
        self._video = EncapsulatedVideo(first, rate_hz) if first.is_video else None
        self.rate_hz = rate_hz or self.rate_hz
        if self._video is not None:
            self.numbers, self.warnings, self.rate_hz = None, self._video.warnings, self._video.rate_hz
            self.width, self.height, self.count = self._video.width, self._video.height, self._video.count
            self.pixel_aspect = first.pixel_aspect or self._video.pixel_aspect
            if self._video.stamped:
                # Rates in headers are rounded.
                self.times_s, clock = {}, "the video's"
        self.stamped = bool(clock)
        self.notes.append(f"time stamps: {clock or f'frame number / {self.rate_hz:g} s (the file states none)'}")
        self._report_header(first)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a DICOM file, or a folder of these and no other images."""
        if path.is_dir():
            return not image_files(path) and bool(_files(path))
        return _is_dicom(path)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; one that cannot be decoded is left out with a warning."""
        if self._video is not None:
            for frame in self._video.frames(selection):
                time_s = self.times_s.get(frame.index, frame.time_s)
                yield replace(frame, time_s=time_s, name=str(frame.index))
            return
        for number, rgb in self._selected(selection):
            if rgb is None:
                self._warn(f"image {number} cannot be decoded and was left out")
                continue
            self._check_size(rgb, f"{self.path}: image {number}")
            yield SourceFrame(number, self._time_s(number), rgb, str(number))

    def media(self) -> str | None:
        """Return the video's stream; None where there is none."""
        return None if self._video is None else self._video.media()

    def _selected(self, selection: slice) -> Iterator[tuple[int, np.ndarray | None]]:
        if len(self._headers) == 1:
            yield from images(self._headers[0], range(self._headers[0].frames)[selection])
            return
        for number, header in list(zip(self.numbers or (), self._headers, strict=True))[selection]:
            for _, rgb in images(header, range(1)):
                yield number, rgb

    def _report_header(self, first: Header) -> None:
        """Add the notes and warnings on levels, time steps, missing images and burned-in notes."""
        stored = int(first.fields.get("BitsStored") or 8)
        if first.is_windowed:
            self.notes.append("grey levels: the window of the file (WindowCenter, WindowWidth), as 8 bit")
        elif stored > 8 and self._video is None:
            self.notes.append(f"levels: all {stored} stored bits (BitsStored), scaled to 8 bit")
        if first.fields.get("FrameTimeVector") and not self.times_s and self._video is None:
            self._warn("its FrameTimeVector does not increase, or not once for each image, and was left out")
        if first.missing:
            self._warn(f"it claims {first.frames + first.missing} images, {first.frames} are there; these were used")
        if any(str(header.fields.get("BurnedInAnnotation", "")).upper() == "YES" for header in self._headers):
            self._warn(Notice("input-text-burned-in"))

    def _in_folder(self, path: Path) -> list[Header]:
        """Return the headers of the one series in a folder, sorted."""
        files = _files(path)
        headers = []
        for file in files:
            with suppress(InputError):
                headers.append(read_header(file))
        if not headers:
            raise InputError(f"reading {path}: none of its {len(files)} DICOM files holds images that can be read")
        if len(headers) < len(files):
            left_out = f"{len(files) - len(headers)} of {len(files)} DICOM files"
            self._warn(f"{left_out} hold no images or cannot be read, and were left out")
        single = [header for header in headers if not header.is_video and header.frames + header.missing == 1]
        several, series = len(headers) - len(single), {str(h.fields.get("SeriesInstanceUID", "")) for h in single}
        if several + len(series) > 1:
            raise InputError(
                f"reading {path}: it holds {several} videos or multi-frame images and {len(series)} series of single "
                "frames; give one file, or a folder with one series"
            )
        return sorted(headers, key=lambda header: header.instance or 0)


def _is_dicom(file: Path) -> bool:
    """Whether a file is DICOM by its magic word or its ending, and not the directory of a medium."""
    start = first_bytes(file, _META_BYTES)
    is_directory = file.name.upper() == "DICOMDIR" or _DIRECTORY in start
    has_magic = start[_PREAMBLE : _PREAMBLE + 4] == _MAGIC
    return bool(start) and not is_directory and (has_magic or file.suffix.lower() == ".dcm")


def _files(folder: Path) -> list[Path]:
    files = (file for file in folder.iterdir() if not file.name.startswith(".") and _is_dicom(file))
    return sorted(files, key=numeric_order)
