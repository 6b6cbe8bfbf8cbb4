"""One DICOM file: what its header says of the pictures, and these, one at a time, through `pydicom` (an extra).

Only what is needed for the pictures is taken out of the header; names, dates and numbers of patients are never read,
and messages do not repeat what a header holds. Tags and transfer syntaxes are those of DICOM PS3.3, C.7.6.3 and
C.7.6.5, and PS3.5, 8 and A.
"""

from __future__ import annotations

import io
import re
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from scopemap.errors import InputError, ScopemapError
from scopemap.io.decoding import check_pixels

_PREAMBLE, _MAGIC, _META_GROUP, _META_BYTES = 128, b"DICM", b"\x02\x00", 512
# The SOP class of a list of what a medium holds, as an element of the file's own header.
_INDEX = b"\x02\x00\x02\x00UI\x14\x001.2.840.10008.1.3.10"
_IMPLICIT, _EXPLICIT, _DEFLATED = "1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.1.99"
_RLE = "1.2.840.10008.1.2.5"
_BASELINE = {f"1.2.840.10008.1.2.4.{number}" for number in (50, 51)}
_JPEG = _BASELINE | {f"1.2.840.10008.1.2.4.{number}" for number in (90, 91)}
_MPEG = {f"1.2.840.10008.1.2.4.{number}" for number in range(100, 109)} | {
    f"1.2.840.10008.1.2.4.{number}.1" for number in range(100, 107)
}
_PIXEL_DATA = (0x7FE0, 0x0010)
_UNDEFINED = 0xFFFFFFFF
_LARGEST_PICTURE_BYTES = 256 << 20
_WHOLE = re.compile(r"-?\d{1,12}")
_RATES = ("CineRate", "RecommendedDisplayFrameRate")
_SLOWEST_HZ, _FASTEST_HZ = 1e-3, 1e5
_TAGS = (
    *("Rows", "Columns", "NumberOfFrames", "SamplesPerPixel", "PhotometricInterpretation", "PlanarConfiguration"),
    *("BitsAllocated", "BitsStored", "PixelRepresentation", "PixelAspectRatio", "BurnedInAnnotation"),
    *("WindowCenter", "WindowWidth", "VOILUTFunction", "RescaleSlope", "RescaleIntercept"),
    *("FrameTime", "FrameTimeVector", "CineRate", "RecommendedDisplayFrameRate", "InstanceNumber", "SeriesInstanceUID"),
    *(
        f"{colour}PaletteColorLookupTable{part}"
        for colour in ("Red", "Green", "Blue")
        for part in ("Data", "Descriptor")
    ),
)


@dataclass(frozen=True)
class Header:
    """What a file says of its pictures.

    Attributes
    ----------
    path : the file.
    syntax : UID of the transfer syntax: how the pictures are packed.
    rows, columns : size of a picture, px.
    frames : number of pictures that the file claims, and has room for.
    missing : number of pictures that it claims beyond these.
    start, length : place of the pixel data in the file, bytes; length None: in fragments.
    fields : the tags that were read.
    """

    path: Path
    syntax: str
    rows: int
    columns: int
    frames: int
    missing: int
    start: int
    length: int | None
    fields: Any

    @property
    def is_video(self) -> bool:
        """Whether the pictures are one MPEG stream."""
        return self.syntax in _MPEG

    @property
    def is_jpeg(self) -> bool:
        """Whether each picture is a JPEG, with a header of its own."""
        return self.syntax in _BASELINE

    @property
    def is_several(self) -> bool:
        """Whether the file holds more than one picture."""
        return self.is_video or self.frames + self.missing > 1

    @property
    def instance(self) -> int | None:
        """The file's number in its series."""
        value = str(self.fields.get("InstanceNumber", ""))
        return int(value) if _WHOLE.fullmatch(value) else None

    @property
    def series(self) -> str:
        """What tells one series from another; not for messages."""
        return str(self.fields.get("SeriesInstanceUID", ""))

    @property
    def may_show_patient(self) -> bool:
        """Whether the file says that notes are burned into its pictures."""
        return str(self.fields.get("BurnedInAnnotation", "")).upper() == "YES"

    @property
    def pixel_aspect(self) -> float | None:
        """Width of a pixel over its height; None where the file does not say."""
        with telling(self.path):
            stated = [float(side) for side in _several(self.fields.get("PixelAspectRatio"))]
        # PS3.3, C.7.6.3.1.7: the vertical side comes first.
        return stated[1] / stated[0] if len(stated) == 2 and 0.1 < stated[1] / (stated[0] or np.nan) < 10 else None

    @property
    def window(self) -> tuple[float, float] | None:
        """Lowest and highest stored level that are shown, of grey pictures; None where the file does not say.

        PS3.3, C.11.1.1.2 (rescaling) and C.11.2.1.2.1 (linear window), solved for the stored level.
        """
        if not str(self.fields.get("PhotometricInterpretation", "")).startswith("MONOCHROME"):
            return None
        if str(self.fields.get("VOILUTFunction") or "LINEAR") != "LINEAR":
            return None
        with telling(self.path):
            ends = (_several(self.fields.get(f"Window{name}")) for name in ("Center", "Width"))
            centre, width = (float(values[0]) if values else np.nan for values in ends)
            slope, intercept = (float(self.fields.get(f"Rescale{x}") or d) for x, d in (("Slope", 1), ("Intercept", 0)))
        low, high = ((centre - 0.5 + side * (width - 1) / 2 - intercept) / (slope or np.nan) for side in (-1, 1))
        return (low, high) if low < high and np.isfinite((low, high)).all() else None

    def clock(self) -> tuple[np.ndarray | None, float | None, str]:
        """Return times (frames,), s from the first, or None; pictures per second, or None; and which tag says so."""
        with telling(self.path):
            steps_ms = np.array([float(step) for step in _several(self.fields.get("FrameTimeVector"))])[: self.frames]
            if len(steps_ms) == self.frames > 1 and np.isfinite(steps_ms).all() and (steps_ms[1:] > 0).all():
                return np.cumsum([0.0, *steps_ms[1:]]) / 1000, None, "FrameTimeVector"
            period_ms = float(self.fields.get("FrameTime") or 0)
            rates_hz = {"FrameTime": 1000 / period_ms if period_ms > 0 else 0.0}
            rates_hz |= {name: float(self.fields.get(name) or 0) for name in _RATES}
        for name, rate_hz in rates_hz.items():
            if _SLOWEST_HZ < rate_hz < _FASTEST_HZ:
                return None, rate_hz, f"frame number / {rate_hz:g} s ({name})"
        return None, None, ""


@contextmanager
def telling(path: Path) -> Iterator[None]:
    """Turn what `pydicom` ends in into an `InputError` that repeats nothing of the file; keep its warnings quiet."""
    try:
        with warnings.catch_warnings():
            # They quote what they warn of.
            warnings.simplefilter("ignore")
            yield
    except ScopemapError:
        raise
    # Other people's parsers end in anything at all where bytes are damaged.
    except Exception as error:
        raise InputError(f"reading {path}: the DICOM file is damaged or incomplete ({type(error).__name__})") from None


def is_dicom(file: Path) -> bool:
    """Whether a file is DICOM by its magic word, or without that by its ending."""
    start = _start_of(file)
    return start is not None and (start[_PREAMBLE:][:4] == _MAGIC or file.suffix.lower() == ".dcm")


def is_index(file: Path) -> bool:
    """Whether a file is the list of what a medium holds (PS3.3, F; PS3.10, 8.6), by its name or its SOP class."""
    return file.name.upper() == "DICOMDIR" or _INDEX in (_start_of(file) or b"")


def is_installed() -> bool:
    """Whether the package `pydicom` is there."""
    try:
        import pydicom  # noqa: F401
    except ImportError:
        return False
    return True


def require_pydicom(path: Path) -> None:
    """Raise `InputError` where the package `pydicom` is not installed."""
    if not is_installed():
        raise InputError(f"reading {path}: it is DICOM; install its reader: pip install 'scopemap[dicom]'")


def read_header(file: Path) -> Header:
    """Return what a file says of its pictures; `InputError` for none, and for kinds that are not read."""
    import pydicom

    with telling(file), file.open("rb") as stream:
        # A deflated file is unpacked as a whole before anything is known of it.
        if _stated_syntax(file, stream) == _DEFLATED:
            raise InputError(f"reading {file}: deflated DICOM is not read; unpack it first, for example with dcmconv")
        fields = pydicom.dcmread(stream, stop_before_pixels=True, force=True, specific_tags=list(_TAGS))
        syntax = str(fields.file_meta.get("TransferSyntaxUID", "")) if hasattr(fields, "file_meta") else ""
        if not syntax:
            syntax = _IMPLICIT if fields.is_implicit_VR else _EXPLICIT
        rows, columns = int(fields.get("Rows") or 0), int(fields.get("Columns") or 0)
        length = _pixel_length(stream, syntax)
        if min(rows, columns) < 1 or length is None:
            raise InputError(f"reading {file}: the DICOM file holds no pictures")
        if syntax not in {_IMPLICIT, _EXPLICIT, _RLE} | _JPEG | _MPEG:
            # An unknown UID is its own name; it may hold anything.
            known = syntax in pydicom.uid.UID_dictionary
            way = f"as {pydicom.uid.UID(syntax).name[:60]}" if known else "in an unknown way"
            raise InputError(
                f"reading {file}: pictures packed {way} are not read (native, RLE, "
                "JPEG, JPEG 2000 and MPEG are); convert it first, for example with dcmconv or dcmdjpeg"
            )
        check_pixels(float(rows) * columns)
        start, claimed = stream.tell(), max(int(fields.get("NumberOfFrames") or 1), 1)
        unpacked = length if length != _UNDEFINED else None
        header = Header(file, syntax, rows, columns, claimed, 0, start, unpacked, fields)
        if header.is_video:
            return header
        found = min(claimed, _room(header, stream))
        return Header(file, syntax, rows, columns, found, claimed - found, start, unpacked, fields)


def packed_frames(header: Header) -> Iterator[bytes]:
    """Yield the bytes of each picture, as they are in the file."""
    from pydicom.encaps import generate_frames

    with header.path.open("rb") as stream:
        stream.seek(header.start)
        if header.length is None:
            frames = generate_frames(stream, number_of_frames=header.frames)
            while True:
                with telling(header.path):
                    frame = next(frames, None)
                if frame is None:
                    return
                yield frame
        else:
            for _ in range(header.frames):
                yield stream.read(_frame_bytes(header))


def fragments(header: Header) -> list[tuple[int, int]]:
    """Return start and length, bytes, of the fragments of the pixel data, without the table of offsets before them."""
    from pydicom.encaps import parse_fragments

    with telling(header.path), header.path.open("rb") as stream:
        stream.seek(header.start)
        _, items = parse_fragments(stream)
        found = []
        for item in items[1:]:
            stream.seek(item + 4)
            found.append((item + 8, struct.unpack("<L", stream.read(4))[0]))
        return found


def _start_of(file: Path) -> bytes | None:
    """Return the first bytes; None of a file without permission, and of pipes: who opens one waits forever."""
    try:
        if not file.is_file():
            return None
        with file.open("rb") as stream:
            return stream.read(_META_BYTES)
    except OSError:
        return None


def _stated_syntax(file: Path, stream: BinaryIO) -> str:
    """Return the transfer syntax that the file's own header names, "" where it has no such header."""
    from pydicom.filereader import read_file_meta_info

    start = stream.read(_PREAMBLE + 4)
    stream.seek(0)
    if start[_PREAMBLE:] == _MAGIC:
        return str(read_file_meta_info(file).get("TransferSyntaxUID", ""))
    if start[:2] == _META_GROUP:
        raise InputError(
            f"reading {file}: the DICOM file lacks its first 132 bytes; restore them, for example with dcmconv"
        )
    return ""


def _pixel_length(stream: BinaryIO, syntax: str) -> int | None:
    """Read on to the first byte of the pixel data; return its length, None where there is none."""
    start = stream.read(8)
    if len(start) < 8 or struct.unpack("<HH", start[:4]) != _PIXEL_DATA:
        return None
    # PS3.5, 7.1: an explicit VR is followed by two empty bytes and the length.
    return int(struct.unpack("<L", start[4:] if syntax == _IMPLICIT else stream.read(4))[0])


def _frame_bytes(header: Header) -> int:
    fields = header.fields
    samples, bits = int(fields.get("SamplesPerPixel") or 1), int(fields.get("BitsAllocated") or 8)
    pixels = header.rows * header.columns
    # PS3.3, C.7.6.3.1.2: of two neighbours one pair of colours is kept.
    halved = samples == 3 and fields.get("PhotometricInterpretation") == "YBR_FULL_422"
    return (pixels * 2 if halved else pixels * samples) * bits // 8


def _room(header: Header, stream: BinaryIO) -> int:
    """Return how many pictures there is room for, at most."""
    if header.length is None:
        lengths = [length for _, length in fragments(header)]
        if max(lengths, default=0) > _LARGEST_PICTURE_BYTES:
            raise InputError(f"reading {header.path}: a picture takes {max(lengths) >> 20} MB; is the file damaged?")
        return len(lengths)
    size = stream.seek(0, io.SEEK_END) - header.start
    bits = int(header.fields.get("BitsAllocated") or 8)
    if bits not in (8, 16) or header.syntax not in (_IMPLICIT, _EXPLICIT):
        raise InputError(
            f"reading {header.path}: pictures of {bits} bits per sample, or not packed as said, are not read"
        )
    return min(size, header.length) // max(_frame_bytes(header), 1)


def _several(value: Any) -> list[Any]:
    """Return a value of several, of one or of none as a list."""
    if value is None:
        return []
    return [value] if isinstance(value, str | int | float) else list(value)
