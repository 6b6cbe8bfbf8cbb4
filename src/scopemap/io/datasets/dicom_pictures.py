"""DICOM's pixel data as RGB pictures of 8 bit."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from scopemap.errors import InputError
from scopemap.io.datasets.dicom_files import Header, packed_frames, telling

_MONOCHROME = ("MONOCHROME1", "MONOCHROME2")
_PALETTE = "PALETTE COLOR"
_COLOUR = ("RGB", "YBR_FULL", "YBR_FULL_422", "YBR_ICT", "YBR_RCT")
# Of JPEG frames the file's word for their colours is no more than that: their own headers say how they are stored.
_PARTIAL = "YBR_PARTIAL_420"
_NOT_READ = ("HSV", "ARGB", "CMYK", "YBR_PARTIAL_422", _PARTIAL, "XYB")
# PackBits takes one byte in 128 more than it packs at worst (PS3.5, G.3.1), and there is a header.
_RLE_OVERHEAD = 1.05
_RLE_HEADER_BYTES = 1024


def pictures(
    header: Header, wanted: range, window: tuple[float, float] | None = None
) -> Iterator[tuple[int, np.ndarray | None]]:
    """Yield number, from 0, and picture (rows, columns, 3) uint8, of those `wanted`; None where it cannot be decoded.

    window : lowest and highest level that are shown, of grey pictures; None: all that the stored bits can hold. One
    decoded picture is held at a time. Raises `InputError` for colours that are not read, and where a picture's own
    header claims another size than the file's.
    """
    colours = str(header.fields.get("PhotometricInterpretation", ""))
    if colours == _PARTIAL and header.is_jpeg:
        colours = "YBR_FULL_422"
    if colours not in (*_MONOCHROME, _PALETTE, *_COLOUR):
        way = f"as '{colours}'" if colours in _NOT_READ else "in an unknown way"
        raise InputError(f"reading {header.path}: colours stored {way} are not read")
    for number, frame in enumerate(packed_frames(header)):
        if number >= min(wanted.stop, header.frames):
            return
        if number not in wanted:
            continue
        if not _is_sized(header, frame, number):
            yield number, None
            continue
        try:
            with telling(header.path):
                values, stored = _decoded(header, frame, colours)
                yielded = _eight_bit(header, values, colours, stored, window)
        except InputError:
            yield number, None
        else:
            yield number, yielded


def _decoded(header: Header, frame: bytes, colours: str) -> tuple[np.ndarray, int]:
    """Return the samples of one picture as stored or, of colours, as RGB; and how many bits of them count."""
    from pydicom.encaps import encapsulate
    from pydicom.pixels import get_decoder
    from pydicom.uid import UID

    fields = header.fields
    samples, allocated = int(fields.get("SamplesPerPixel") or 1), int(fields.get("BitsAllocated") or 8)
    options: Any = {
        "rows": header.rows,
        "columns": header.columns,
        "number_of_frames": 1,
        "samples_per_pixel": samples,
        "bits_allocated": allocated,
        "bits_stored": int(fields.get("BitsStored") or allocated),
        "pixel_representation": int(fields.get("PixelRepresentation") or 0),
        "photometric_interpretation": colours,
        "pixel_keyword": "PixelData",
    }
    if samples > 1:
        options["planar_configuration"] = int(fields.get("PlanarConfiguration") or 0)
    content = encapsulate([frame], has_bot=False) if header.length is None else frame
    values, found = get_decoder(UID(header.syntax)).as_array(content, index=0, raw=False, **options)
    return values, int(found.get("bits_stored", allocated))


def _is_sized(header: Header, frame: bytes, number: int) -> bool:
    """Whether a picture says how large it is; refuses one that would unpack to something else than the file says."""
    if header.length is not None:
        return True
    if header.syntax == "1.2.840.10008.1.2.5":
        fields = header.fields
        samples, bits = int(fields.get("SamplesPerPixel") or 1), int(fields.get("BitsAllocated") or 8)
        most = header.rows * header.columns * samples * bits / 8 * _RLE_OVERHEAD + _RLE_HEADER_BYTES
        if len(frame) > most:
            raise InputError(f"reading {header.path}: picture {number} takes {len(frame)} bytes, more than unpacked")
        return True
    from PIL import Image

    try:
        with telling(header.path), Image.open(io.BytesIO(frame), formats=("JPEG", "JPEG2000")) as image:
            size = image.size
    except InputError:
        return False
    if size != (header.columns, header.rows):
        raise InputError(
            f"reading {header.path}: picture {number} is {size[0]}x{size[1]} px, the file's header says "
            f"{header.columns}x{header.rows} px"
        )
    return True


def _eight_bit(
    header: Header, values: np.ndarray, colours: str, stored: int, window: tuple[float, float] | None
) -> np.ndarray:
    if colours == _PALETTE:
        from pydicom.pixels import apply_color_lut

        values = apply_color_lut(values, header.fields)
        stored = 8 * values.dtype.itemsize
    if values.ndim == 2:
        values = np.repeat(values[..., None], 3, axis=2)
    if window is not None:
        low, high = window
        values, stored = np.rint(255 * np.clip((values.astype(np.float32) - low) / (high - low), 0, 1)), 8
    if values.dtype.kind == "i":
        values = values.astype(np.int32) + (1 << (stored - 1))
    if stored > 8:
        values = values >> (stored - 8)
    elif stored < 8:
        values = values.astype(np.uint16) * 255 // ((1 << stored) - 1)
    rgb = np.clip(values, 0, 255).astype(np.uint8)
    return 255 - rgb if colours == _MONOCHROME[0] else np.ascontiguousarray(rgb)
