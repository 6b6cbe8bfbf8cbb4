"""Pictures and depth out of ROS image messages: `sensor_msgs/Image` and `sensor_msgs/CompressedImage`.

Names of encodings are those of ROS's `sensor_msgs/image_encodings.hpp`; units of depth are those of REP 118: whole
numbers are mm, floating-point numbers m.
"""

from __future__ import annotations

import re
import struct
from typing import Any

import cv2
import numpy as np

from scopemap.errors import InputError
from scopemap.io.decoding import check_pixels, decoded

# Type of a sample, samples per pixel, and which of these are red, green and blue (one: all three are the same).
_PLAIN: dict[str, tuple[str, int, tuple[int, ...]]] = {
    "rgb8": ("u1", 3, (0, 1, 2)),
    "bgr8": ("u1", 3, (2, 1, 0)),
    "rgba8": ("u1", 4, (0, 1, 2)),
    "bgra8": ("u1", 4, (2, 1, 0)),
    "rgb16": ("u2", 3, (0, 1, 2)),
    "bgr16": ("u2", 3, (2, 1, 0)),
    "rgba16": ("u2", 4, (0, 1, 2)),
    "bgra16": ("u2", 4, (2, 1, 0)),
    "mono8": ("u1", 1, (0, 0, 0)),
    "mono16": ("u2", 1, (0, 0, 0)),
    "8UC1": ("u1", 1, (0, 0, 0)),
    "8UC3": ("u1", 3, (2, 1, 0)),
    "8UC4": ("u1", 4, (2, 1, 0)),
}
_YUV = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUYV,
    "yuyv": cv2.COLOR_YUV2RGB_YUYV,
}
_BAYER = re.compile(r"bayer_(rggb|bggr|gbrg|grbg)(8|16)")
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_COMPRESSED_DEPTH = "compressedDepth"
_DEPTH_HEADER = struct.Struct("<iff")
_MM_PER_METRE = 1000.0
_BITS = (8, 10, 12, 14, 16)


def encoding_of(message: Any) -> str:
    """Return the encoding of an image message, or the format of a compressed one."""
    return str(getattr(message, "encoding", None) or getattr(message, "format", ""))


def is_depth(encoding: str) -> bool:
    """Whether an encoding or format, as "16UC1; png compressed", is one of depth."""
    return bare(encoding) in ("16UC1", "32FC1") or _COMPRESSED_DEPTH in encoding


def bare(encoding: str) -> str:
    """Return an encoding without what a format says of its compression."""
    return encoding.split(";")[0].strip()


def bits_of(wide: np.ndarray) -> int:
    """Return how many bits of a picture of uint16 count, by its brightest sample: 8, 10, 12, 14 or 16.

    Cameras of 10 or 12 bits put them into the lower part of 16.
    """
    return next(bits for bits in _BITS if int(wide.max()) < 1 << bits)


def eight_bit(wide: np.ndarray, bits: int) -> np.ndarray:
    """Return a picture of uint16, of which `bits` count, as uint8; what is brighter than they hold is cut off."""
    return np.minimum(wide >> (bits - 8), 255).astype(np.uint8)


def picture_of(message: Any) -> np.ndarray:
    """Return an image message as (h, w, 3) RGB, uint8 or, where its samples have 16 bits, uint16.

    Raises `InputError` for an encoding that is not known and for data that do not make the image.
    """
    if hasattr(message, "format"):
        return _compressed(message)
    encoding = message.encoding
    if encoding in _PLAIN:
        sample, count, rgb = _PLAIN[encoding]
        values = _rows(message, sample, count)[..., list(rgb)]
    elif encoding in _YUV:
        values = _converted(_rows(message, "u1", 2), _YUV[encoding])
    elif match := _BAYER.fullmatch(encoding):
        values = _mosaic(_rows(message, "u1" if match[2] == "8" else "u2", 1)[..., 0], match[1])
    else:
        known = ", ".join([*_PLAIN, *_YUV, "bayer_*"])
        raise InputError(f"the encoding '{encoding}' of its images is not known (known are {known})")
    return np.ascontiguousarray(values)


def depth_of(message: Any) -> np.ndarray:
    """Return a depth message as (h, w) float32, mm along the optical axis, NaN = unknown.

    Raises `InputError` for what holds no depth, and for data that do not make the image.
    """
    if hasattr(message, "format"):
        depth_mm = _compressed_depth(message)
    elif message.encoding in _DEPTH:
        values = _rows(message, _DEPTH[message.encoding], 1)[..., 0]
        depth_mm = values.astype(np.float32) * (_MM_PER_METRE if values.dtype.kind == "f" else 1.0)
    else:
        raise InputError(f"its encoding '{message.encoding}' is none of depth ({', '.join(_DEPTH)})")
    return np.where(np.isfinite(depth_mm) & (depth_mm > 0), depth_mm, np.nan).astype(np.float32)


def _rows(message: Any, sample: str, count: int) -> np.ndarray:
    """Return the samples (h, w, count) of an uncompressed image, what fills up its rows left out."""
    height, width, data = int(message.height), int(message.width), message.data
    check_pixels(float(height) * width)
    kind = np.dtype(sample).newbyteorder(">" if message.is_bigendian else "<")
    length = width * count * kind.itemsize
    step = int(message.step) or length
    if min(height, width) < 1 or step < length or data.size < step * height:
        raise InputError(
            f"its data do not make the image: {data.size} bytes for {height} rows of {step} bytes, {width} px wide"
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :length])
    return rows.view(kind).reshape(height, width, count).astype(kind.newbyteorder("="), copy=False)


def _converted(values: np.ndarray, code: int) -> np.ndarray:
    try:
        return cv2.cvtColor(values, code)
    except cv2.error:
        raise InputError(f"its colours cannot be restored at {values.shape[1]}x{values.shape[0]} px") from None


def _mosaic(values: np.ndarray, order: str) -> np.ndarray:
    return _converted(values, getattr(cv2, f"COLOR_Bayer{order.upper()}2RGB"))


def _compressed(message: Any) -> np.ndarray:
    content = message.data.tobytes()
    # What comes after the semicolon is what was compressed.
    match = _BAYER.search(message.format.split(";")[-1])
    if match:
        values = decoded(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    else:
        values = decoded(content, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if values is None or values.dtype not in (np.uint8, np.uint16):
        raise InputError(f"its compressed image ('{message.format[:40]}') cannot be decoded")
    return _mosaic(values, match[1]) if match else _converted(values, cv2.COLOR_BGR2RGB)


def _compressed_depth(message: Any) -> np.ndarray:
    """As ROS's `compressed_depth_image_transport` writes it: a header of 12 bytes, then a PNG of 16 bit.

    `compressed_image_transport` leaves out the header.
    """
    content = message.data.tobytes()
    if _COMPRESSED_DEPTH not in message.format and bare(message.format) == "16UC1":
        values = decoded(content)
        if values is None or values.ndim != 2 or values.dtype != np.uint16:
            raise _no_depth(message)
        return values.astype(np.float32)
    values = decoded(content[_DEPTH_HEADER.size :]) if len(content) > _DEPTH_HEADER.size else None
    if _COMPRESSED_DEPTH not in message.format or values is None or values.ndim != 2 or values.dtype != np.uint16:
        raise _no_depth(message)
    if not message.format.startswith("32FC1"):
        return values.astype(np.float32)
    _, a, b = _DEPTH_HEADER.unpack(content[: _DEPTH_HEADER.size])
    # Inverse depth in equal steps.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(values > 0, _MM_PER_METRE * a / (values.astype(np.float32) - b), np.nan)


def _no_depth(message: Any) -> InputError:
    return InputError(f"its compressed depth ('{message.format[:40]}') cannot be decoded: PNG of 16 bit is read")
