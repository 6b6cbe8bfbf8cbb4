"""DICOM: endoscopic video, multi-frame images, a series; read with the extra `dicom`.

Sources: PS3.3, A.32.5, C.7.6.3 and C.7.6.5; PS3.5, A.

Only the tags that describe images are read, and messages do not repeat them: no names, dates and numbers of patients.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from scopemap.engine.errors import InputError, check_bytes, reporting
from scopemap.engine.notices import Notice
from scopemap.input.decoding import check_pixels, first_bytes
from scopemap.input.image_names import numeric_order
from scopemap.input.images import image_files
from scopemap.input.source import Source, SourceFrame
from scopemap.input.video import VideoFile

_IMPLICIT = "1.2.840.10008.1.2"
_EXPLICIT = "1.2.840.10008.1.2.1"
_PIXEL_DATA = struct.pack("<HH", 0x7FE0, 0x0010)
_UNDEFINED = 0xFFFFFFFF
_PARTIAL = "YBR_PARTIAL_420"
_MOST_IMAGE_BYTES = 256 << 20
_RATES = ("CineRate", "RecommendedDisplayFrameRate")
_SLOWEST_HZ = 1e-3
_FASTEST_HZ = 1e5
_TAGS = (
    "Rows", "Columns", "NumberOfFrames", "SamplesPerPixel", "PhotometricInterpretation", "PlanarConfiguration",
    "BitsAllocated", "BitsStored", "PixelRepresentation", "PixelAspectRatio", "BurnedInAnnotation", "WindowCenter",
    "WindowWidth", "VOILUTFunction", "RescaleSlope", "RescaleIntercept", "FrameTime", "FrameTimeVector", "CineRate",
    "RecommendedDisplayFrameRate", "InstanceNumber", "SeriesInstanceUID", "RedPaletteColorLookupTableData",
    "RedPaletteColorLookupTableDescriptor", "GreenPaletteColorLookupTableData",
    "GreenPaletteColorLookupTableDescriptor", "BluePaletteColorLookupTableData",
    "BluePaletteColorLookupTableDescriptor",
)  # fmt: skip
_PREAMBLE = 128
_MAGIC = b"DICM"
_META_BYTES = 512
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
        self._headers = self._in_folder(path) if path.is_dir() else [_read_header(path)]
        first = self._headers[0]
        self.numbers, self.count = range(first.frames), first.frames
        if len(self._headers) > 1:
            self.numbers, self.count = range(len(self._headers)), len(self._headers)
            instances = [header.instance for header in self._headers if header.instance is not None]
            if len(instances) == self.count and all(a < b for a, b in pairwise(instances)):
                self.numbers = instances
            else:
                self._warn("some files of the series share a number, so frames are in the order of the files' names")
        self.width, self.height = int(first.fields.Columns), int(first.fields.Rows)
        self.pixel_aspect = first.pixel_aspect or 1.0
        self.times_s, rate_hz, clock = first.clock()
        self._video = EncapsulatedVideo(first, rate_hz) if first.is_video else None
        self.rate_hz = rate_hz or self.rate_hz
        if (video := self._video) is not None:
            self.left_out, self.resized = video.left_out, video.resized
            self.numbers, self.warnings, self.rate_hz = None, video.warnings, video.rate_hz
            self.width, self.height, self.count = video.width, video.height, video.count
            self.pixel_aspect = first.pixel_aspect or video.pixel_aspect
            if video.stamped:  # rates in headers are rounded
                self.times_s, clock = {}, "the video's"
        self.stamped = bool(clock)
        self.notes.append(f"time stamps: {clock or f'frame number / {self.rate_hz:g} s (the file states none)'}")
        self._report_header(first)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a DICOM file, or a folder of these and no other images."""
        return not image_files(path) and bool(_files(path)) if path.is_dir() else _is_dicom(path)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames without those that cannot be decoded, with a warning, or have another size."""
        if self._video is not None:
            for read in self._video.frames(selection):
                time_s = self.times_s.get(read.index, read.time_s)
                yield replace(read, time_s=time_s, name=str(read.index))
            return
        for number, rgb in self._selected(selection):
            if rgb is None:
                self._warn(f"image {number} cannot be decoded and was left out")
                continue
            if (shown := self._of_one_size(SourceFrame(number, self._time_s(number), rgb, str(number)))) is not None:
                yield shown

    def media(self) -> str | None:
        """Return the video's stream; None where there is none."""
        return None if self._video is None else self._video.media()

    def _selected(self, selection: slice) -> Iterator[tuple[int, np.ndarray | None]]:
        if len(self._headers) == 1:
            yield from _images(self._headers[0], range(self._headers[0].frames)[selection])
            return
        for number, header in list(zip(self.numbers or (), self._headers, strict=True))[selection]:
            yield from ((number, rgb) for _, rgb in _images(header, range(1)))

    def _report_header(self, first: Header) -> None:
        """Add the notes and warnings on levels, time steps, missing images and burned-in notes."""
        stored = int(first.fields.get("BitsStored") or 8)
        if first.is_windowed:
            self.notes.append("grey levels: the window of the file (WindowCenter, WindowWidth), as 8 bit")
        elif stored > 8 and self._video is None:
            self.notes.append(f"levels: all {stored} stored bits (BitsStored), scaled to 8 bit")
        if first.fields.get("FrameTimeVector") and not self.times_s and self._video is None:
            self._warn("the FrameTimeVector was ignored: it does not increase once for each image")
        if first.missing:
            self._warn(
                f"the file states {first.frames + first.missing} images and holds {first.frames}; these were used"
            )
        if any(str(header.fields.get("BurnedInAnnotation", "")).upper() == "YES" for header in self._headers):
            self._warn(Notice("input-text-burned-in"))

    def _in_folder(self, path: Path) -> list[Header]:
        """Return the headers of the one series in a folder, sorted."""
        files = _files(path)
        headers = []
        for file in files:
            with suppress(InputError):
                headers.append(_read_header(file))
        if not headers:
            raise InputError(f"reading {path}: none of its {len(files)} DICOM files holds images that can be read")
        if left_out := len(files) - len(headers):
            self._warn(f"{left_out} of {len(files)} DICOM files hold no images or cannot be read, and were left out")
        single = [header for header in headers if not header.is_video and header.frames + header.missing == 1]
        several, series = len(headers) - len(single), {str(h.fields.get("SeriesInstanceUID", "")) for h in single}
        if several + len(series) > 1:
            held = f"{several} videos or multi-frame images and {len(series)} series of single frames"
            raise InputError(f"reading {path}: it holds {held}; give one file, or a folder with one series")
        return sorted(headers, key=lambda header: header.instance or 0)


@dataclass(frozen=True)
class Header:
    """What the header of the file `path` holds about its images.

    syntax : UID of the transfer syntax. frames : number of images that the file claims and has room for. missing :
    number of those beyond. start : place of the pixel data, bytes. fragments : start and length of its pieces, bytes;
    one where it is native. fields : the tags that were read.
    """

    path: Path
    syntax: str
    frames: int
    missing: int
    start: int
    fragments: list[tuple[int, int]]
    fields: Any

    @property
    def is_video(self) -> bool:
        """Whether the images are one MPEG stream."""
        from pydicom.uid import MPEGTransferSyntaxes

        return self.syntax in MPEGTransferSyntaxes

    @property
    def is_native(self) -> bool:
        """Whether the images are not compressed."""
        return self.syntax in (_IMPLICIT, _EXPLICIT)

    @property
    def instance(self) -> int | None:
        """The file's number in its series."""
        with _reporting(self.path):
            value = self.fields.get("InstanceNumber")
            return None if value is None else int(value)

    @property
    def pixel_aspect(self) -> float | None:
        """Width of a pixel over its height; None where the file does not state it."""
        with _reporting(self.path):
            # PS3.3, C.7.6.3.1.7: the vertical side comes first.
            down, across = self.fields.get("PixelAspectRatio") or (1, 0)
            return across / down if 0.1 < across / (down or np.nan) < 10 else None

    @property
    def is_windowed(self) -> bool:
        """Whether grey levels are displayed by a window that the file states (PS3.3, C.11.2.1.2)."""
        with _reporting(self.path):
            is_grey = str(self.fields.get("PhotometricInterpretation", "")).startswith("MONOCHROME")
            width = np.ravel(self.fields.get("WindowWidth") or 0)[0]
            return is_grey and width >= 1 and self.fields.get("WindowCenter") is not None

    def clock(self) -> tuple[dict[int, float], float | None, str]:
        """Return times, s from the first, by image, or {}; images per second, or None; and a note of their tag."""
        with _reporting(self.path):
            steps_ms = np.ravel(self.fields.get("FrameTimeVector") or []).astype(float)[: self.frames]
            if len(steps_ms) == self.frames > 1 and np.isfinite(steps_ms).all() and (steps_ms[1:] > 0).all():
                times_s = np.cumsum([0.0, *steps_ms[1:]]) / 1000
                return dict(enumerate(times_s.tolist())), None, "FrameTimeVector"
            period_ms = float(self.fields.get("FrameTime") or 0)
            rates_hz = {"FrameTime": 1000 / period_ms if period_ms > 0 else 0.0}
            rates_hz |= {name: float(self.fields.get(name) or 0) for name in _RATES}
        for name, rate_hz in rates_hz.items():
            if _SLOWEST_HZ < rate_hz < _FASTEST_HZ:
                return {}, rate_hz, f"frame number / {rate_hz:g} s ({name})"
        return {}, None, ""


def _read_header(file: Path) -> Header:
    """Return what a file's header holds about its images; `InputError` where it holds none, and for unread kinds."""
    import pydicom

    with _reporting(file), file.open("rb") as stream:
        fields = pydicom.dcmread(stream, stop_before_pixels=True, force=True, specific_tags=list(_TAGS))
        syntax = str(fields.file_meta.get("TransferSyntaxUID", ""))
        syntax = syntax or (_IMPLICIT if fields.original_encoding[0] else _EXPLICIT)
        rows, columns = int(fields.get("Rows") or 0), int(fields.get("Columns") or 0)
        element = stream.read(8)
        if min(rows, columns) < 1 or element[:4] != _PIXEL_DATA or len(element) < 8:
            raise InputError(f"reading {file}: the DICOM file holds no images")
        # PS3.5, 7.1: an explicit VR is followed by two empty bytes and the length.
        length = int(struct.unpack("<L", element[4:] if syntax == _IMPLICIT else stream.read(4))[0])
        check_pixels(float(rows) * columns)
        start, claimed = stream.tell(), max(int(fields.get("NumberOfFrames") or 1), 1)
        fields.NumberOfFrames = claimed
        fragments = _fragments(stream) if length == _UNDEFINED else [(start, length)]
        header = Header(file, syntax, claimed, 0, start, fragments, fields)
        if header.is_video:
            return header
        _check_decoder(file, syntax)
        if length == _UNDEFINED:
            found = len(fragments)
            check_bytes(f"{file}, one image", max((size for _, size in fragments), default=0), _MOST_IMAGE_BYTES)
        else:
            found = min(stream.seek(0, io.SEEK_END) - start, length) // max(_native_bytes(fields), 1)
    return replace(header, frames=min(claimed, found), missing=max(claimed - found, 0))


def _images(header: Header, wanted: range) -> Iterator[tuple[int, np.ndarray | None]]:
    """Yield number, from 0, and image (rows, columns, 3) uint8, of those `wanted`; None where it cannot be decoded."""
    for number, content in enumerate(islice(_packed(header), min(wanted.stop, header.frames))):
        if number in wanted:
            rgb = None
            with suppress(InputError), _reporting(header.path):
                rgb = _rgb(header, content)
            yield number, rgb


class EncapsulatedVideo(VideoFile):
    """A video (MPEG-2, AVC, HEVC) in a DICOM file; `stated_hz`, where not None, replaces missing time stamps."""

    def __init__(self, header: Header, stated_hz: float | None) -> None:
        names = [f"subfile,,start,{at},end,{at + length},,:{header.path}" for at, length in header.fragments if length]
        if not names:
            raise InputError(f"reading {header.path}: the video in the DICOM file is empty")
        self._fragments = "|".join(names)
        super().__init__(header.path)
        if not self.stamped and stated_hz:
            self.rate_hz = stated_hz

    def media(self) -> str:
        """Return FFmpeg's name of the fragments, joined."""
        return f"concat:{self._fragments}"


def _is_dicom(file: Path) -> bool:
    """Whether a file is DICOM by its magic word or its ending, and not the directory of a medium."""
    start = first_bytes(file, _META_BYTES)
    is_directory = file.name.upper() == "DICOMDIR" or _DIRECTORY in start
    has_magic = start[_PREAMBLE : _PREAMBLE + 4] == _MAGIC
    return bool(start) and not is_directory and (has_magic or file.suffix.lower() == ".dcm")


def _files(folder: Path) -> list[Path]:
    files = (file for file in folder.iterdir() if not file.name.startswith(".") and _is_dicom(file))
    return sorted(files, key=numeric_order)


def _reporting(path: Path) -> AbstractContextManager[None]:
    """Turn the exceptions of `pydicom` into an `InputError` that quotes nothing of the file."""
    return reporting(f"reading {path}: the DICOM file is damaged or incomplete", quoting=False)


def _fragments(stream: BinaryIO) -> list[tuple[int, int]]:
    """Return start and length, bytes, of the fragments of the pixel data, without the table of offsets before them."""
    from pydicom.encaps import parse_fragments

    found = []
    for item in parse_fragments(stream)[1][1:]:
        stream.seek(item + 4)
        found.append((item + 8, struct.unpack("<L", stream.read(4))[0]))
    return found


def _native_bytes(fields: Any) -> int:
    """Return the bytes of one image that is not compressed."""
    from pydicom.pixels.utils import get_expected_length

    return int(get_expected_length(fields)) // int(fields.NumberOfFrames)


def _check_decoder(file: Path, syntax: str) -> None:
    """Raise `InputError` where no decoder of `pydicom` is installed for a transfer syntax."""
    from pydicom.pixels import get_decoder
    from pydicom.uid import UID, UID_dictionary

    with suppress(RuntimeError):  # it is unknown
        if get_decoder(UID(syntax)).is_available:
            return
    # A UID that is unknown is not quoted: it may hold anything.
    name = UID(syntax).name if syntax in UID_dictionary else "an unknown transfer syntax"
    advice = (
        "install a plugin of pydicom (pyjpegls, pylibjpeg), or convert the file, for example with dcmconv or dcmdjpeg"
    )
    raise InputError(f"reading {file}: no decoder is installed for {name}; {advice}")


def _packed(header: Header) -> Iterator[bytes]:
    """Yield the bytes of each image, as they are in the file."""
    from pydicom.encaps import generate_frames

    with header.path.open("rb") as stream:
        stream.seek(header.start)
        if header.is_native:
            size = _native_bytes(header.fields)
            yield from (stream.read(size) for _ in range(header.frames))
            return
        frames = generate_frames(stream, number_of_frames=header.frames)
        while True:
            with _reporting(header.path):
                frame = next(frames, None)
            if frame is None:
                return
            yield frame


def _rgb(header: Header, content: bytes) -> np.ndarray:
    """Return the image (rows, columns, 3) uint8 in the bytes of one frame."""
    from pydicom.encaps import encapsulate
    from pydicom.pixels import apply_color_lut, apply_rescale, apply_windowing, get_decoder
    from pydicom.pixels.utils import as_pixel_options
    from pydicom.uid import UID

    options = as_pixel_options(header.fields, number_of_frames=1, pixel_keyword="PixelData")
    colours = options["photometric_interpretation"]
    if colours == _PARTIAL:
        # JPEG frames hold their subsampling themselves.
        options["photometric_interpretation"] = "YBR_FULL_422"
    content = content if header.is_native else encapsulate([content], has_bot=False)
    values, found = get_decoder(UID(header.syntax)).as_array(content, index=0, raw=False, **options)
    stored = int(found["bits_stored"])
    if colours == "PALETTE COLOR":
        values = apply_color_lut(values, header.fields)
        stored = 8 * values.dtype.itemsize
    low = -(1 << (stored - 1)) if values.dtype.kind == "i" else 0
    levels = np.array([low, low + (1 << stored) - 1])
    if header.is_windowed:
        values = apply_windowing(apply_rescale(values, header.fields), header.fields)
        levels = apply_rescale(levels, header.fields)
    if values.dtype != np.uint8 or levels[1] != 255:
        values = np.rint(255 * np.clip((values.astype(np.float32) - levels[0]) / np.ptp(levels), 0, 1))
    values = values.astype(np.uint8)
    values = 255 - values if colours == "MONOCHROME1" else values
    return np.ascontiguousarray(np.broadcast_to(values.reshape(*values.shape[:2], -1), (*values.shape[:2], 3)))
