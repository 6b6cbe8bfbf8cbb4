"""OpenEXR images, one channel of them, decoded by FFmpeg: OpenCV reads them only where its user has allowed it.

FFmpeg fills what a file that breaks off does not hold with 0, so that is looked for before. OpenEXR file layout,
openexr.com: a header of named attributes, then a table with the place of every block of lines, then the blocks.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame

from scopemap.errors import InputError
from scopemap.io.decoding import check_pixels

_MAGIC = b"\x76\x2f\x31\x01"
# Tiled, deep and multi-part files are laid out in another way.
_OTHER_LAYOUTS = 0x1A00
_LINES_OF_BLOCK = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)
_DTYPES = {"f16le": "<f2", "f32le": "<f4"}


def can_read_exr() -> bool:
    """Return whether this FFmpeg has a decoder for OpenEXR."""
    return "exr" in av.codecs_available


def read_exr_red(file: Path) -> np.ndarray:
    """Return the channel R (of a file with Y alone: that) as (h, w) float32.

    Raises `InputError` for a file that is damaged, breaks off, is not one image of lines with R, G and B,
    or claims more pixels than `decoding` allows.
    """
    try:
        content = file.read_bytes()
        _check_complete(content)
        context = VideoCodecContext.create("exr", "r")
        frames = context.decode(av.Packet(content))
        return _red(frames[0])
    except InputError as error:
        raise InputError(f"reading {file}: {error}") from None
    except (OSError, ValueError, IndexError, struct.error, av.FFmpegError) as error:
        raise InputError(f"reading {file}: it is damaged or no OpenEXR image that FFmpeg reads ({error})") from None


def _red(frame: VideoFrame) -> np.ndarray:
    kind = re.search(r"f(?:16|32)le$", frame.format.name)
    if kind is None:
        raise ValueError(f"its pixels are {frame.format.name}, not floats")
    plane = frame.planes[frame.format.components[0].plane]
    values = np.frombuffer(memoryview(plane), _DTYPES[kind[0]]).reshape(frame.height, -1)
    return values[:, : frame.width].astype(np.float32)


def _check_complete(content: bytes) -> None:
    """Raise `ValueError`, `IndexError` or `struct.error` unless every block of lines lies inside the file.

    Also where the picture is to be shown at another size, which is what FFmpeg allocates; `InputError` if it is huge.
    """
    if content[:4] != _MAGIC or struct.unpack_from("<I", content, 4)[0] & _OTHER_LAYOUTS:
        raise ValueError("no OpenEXR file of lines")
    attributes, place = _attributes(content)
    width, height = _size(attributes["dataWindow"])
    if min(width, height) < 1 or _size(attributes["displayWindow"]) != (width, height):
        raise ValueError(f"its size is {width}x{height} px, or it is shown at another")
    check_pixels(width * height)
    lines = _LINES_OF_BLOCK[attributes["compression"][0]]
    for offset in np.frombuffer(content, "<u8", -(-height // lines), place).tolist():
        size = struct.unpack_from("<i", content, offset + 4)[0] if 0 < offset < len(content) else -1
        if size < 0 or offset + 8 + size > len(content):
            raise ValueError("it breaks off")


def _size(window: bytes) -> tuple[int, int]:
    left, top, right, bottom = struct.unpack("<4i", window)
    return right - left + 1, bottom - top + 1


def _attributes(content: bytes) -> tuple[dict[str, bytes], int]:
    """Return the header's attributes by name, and the place behind them."""
    attributes: dict[str, bytes] = {}
    place = 8
    while content[place]:
        name_end = content.index(b"\0", place)
        type_end = content.index(b"\0", name_end + 1)
        size = struct.unpack_from("<I", content, type_end + 1)[0]
        name = content[place:name_end].decode(errors="replace")
        if name in attributes:
            raise ValueError(f"its header has two {name}")
        attributes[name] = content[type_end + 5 : type_end + 5 + size]
        place = type_end + 5 + size
    for name in ("dataWindow", "displayWindow", "compression"):
        if not attributes.get(name):
            raise ValueError(f"its header has no {name}")
    return attributes, place + 1
