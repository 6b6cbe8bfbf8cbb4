"""Images, depth (REP 118: integers mm, floats m) and cameras of ROS messages, by `sensor_msgs/image_encodings.hpp`."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from scopemap.engine.errors import CalibrationError, InputError
from scopemap.input.camera_files.calibration import Calibration
from scopemap.input.camera_files.parsing import Fields
from scopemap.input.camera_files.reading import of_fields
from scopemap.input.decoding import check_pixels, decoded

_PLAIN = re.compile(r"(rgb|bgr|mono)(a?)(8|16)")
# OpenCV's names of the same; colours are in its order.
_OPENCV = {"8UC1": "mono8", "8UC3": "bgr8", "8UC4": "bgra8"}
_YUV = dict.fromkeys(("yuv422", "uyvy"), cv2.COLOR_YUV2RGB_UYVY)
_YUV |= dict.fromkeys(("yuv422_yuy2", "yuyv"), cv2.COLOR_YUV2RGB_YUYV)
_BAYER = re.compile(r"bayer_(rggb|bggr|gbrg|grbg)(8|16)")
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_COMPRESSED_DEPTH = "compressedDepth"
_DEPTH_HEADER = struct.Struct("<iff")
_MM_PER_METRE = 1000.0
_BIT_DEPTHS = (8, 10, 12, 14, 16)
_OPENCV_TERMS = (4, 5, 8)


def encoding_of(message: Any) -> str:
    """Return the encoding of an image message, or the format of a compressed one."""
    return str(getattr(message, "encoding", None) or getattr(message, "format", ""))


def is_depth(encoding: str) -> bool:
    """Whether an encoding or format, as "16UC1; png compressed", is one of depth."""
    return encoding.split(";")[0].strip() in ("16UC1", "32FC1") or _COMPRESSED_DEPTH in encoding


def is_grey(encoding: str) -> bool:
    """Whether an encoding or format is one of grey images."""
    return encoding.split(";")[0].strip() in ("mono8", "mono16", "8UC1")


def bit_depth(wide: np.ndarray) -> int:
    """Return how many bits of a uint16 image are used, by its brightest sample: 8, 10, 12, 14 or 16."""
    return next(bits for bits in _BIT_DEPTHS if int(wide.max()) < 1 << bits)


def eight_bit(wide: np.ndarray, bits: int) -> np.ndarray:
    """Return a uint16 image, of which `bits` are used, as uint8; brighter samples are clipped."""
    return np.minimum(wide >> (bits - 8), 255).astype(np.uint8)


def image_of(message: Any) -> np.ndarray:
    """Return a message as (h, w, 3) RGB, uint8 or uint16; `InputError` for an unknown encoding or wrong data."""
    if hasattr(message, "format"):
        return _compressed_image(message)
    encoding = _OPENCV.get(message.encoding, message.encoding)
    if plain := _PLAIN.fullmatch(encoding):
        channels = 1 if plain[1] == "mono" else 3 + len(plain[2])
        values = _samples(message, f"u{int(plain[3]) // 8}", channels)[..., :3]
        values = values[..., ::-1] if plain[1] == "bgr" else np.broadcast_to(values, (*values.shape[:2], 3))
    elif encoding in _YUV:
        values = _converted(_samples(message, "u1", 2), _YUV[encoding])
    elif bayer := _BAYER.fullmatch(encoding):
        values = _converted(_samples(message, f"u{int(bayer[2]) // 8}", 1)[..., 0], _bayer_code(bayer))
    else:
        known = "rgb8, bgr8, rgba8, bgra8, mono8, the same with 16, " + ", ".join([*_OPENCV, *_YUV, "bayer_*"])
        raise InputError(f"the encoding '{encoding}' of its images is not known (known are {known})")
    return np.ascontiguousarray(values)


def depth_of(message: Any) -> np.ndarray:
    """Return a message as (h, w) float32, mm along the axis, NaN = unknown; `InputError` for what is no depth."""
    if hasattr(message, "format"):
        depth_mm = _compressed_depth(message)
    elif message.encoding in _DEPTH:
        values = _samples(message, _DEPTH[message.encoding], 1)[..., 0]
        depth_mm = values.astype(np.float32) * (_MM_PER_METRE if values.dtype.kind == "f" else 1.0)
    else:
        raise InputError(f"its encoding '{message.encoding}' is none of depth ({', '.join(_DEPTH)})")
    return np.where(np.isfinite(depth_mm) & (depth_mm > 0), depth_mm, np.nan).astype(np.float32)


def calibration_of(info: Any, size: tuple[int, int], rectified: bool, topic: str, bag: str) -> Calibration | None:
    """Return the calibration in a `CameraInfo` message for images of `size` (width, height), px; None: uncalibrated.

    `rectified` : whether the images are free of distortion; then P is their matrix, else K with D. `topic`, `bag` :
    where the message is. Raises `CalibrationError` for what `of_fields` does not read.
    """
    # ROS 2 names these fields with a small letter, ROS 1 with a capital one.
    D, K, P = (np.asarray(getattr(info, name, getattr(info, name.lower(), None)), dtype=float) for name in "DKP")
    if not K.any():
        return None
    roi = Fields([(name, int(getattr(info.roi, name))) for name in ("x_offset", "y_offset", "width", "height")])
    pairs: list[tuple[str, Any]] = [("roi", roi)]
    pairs += [(name, int(getattr(info, name))) for name in ("binning_x", "binning_y")]
    if info.width and info.height:
        pairs += [("image_width", int(info.width)), ("image_height", int(info.height))]
    if rectified:
        pairs += [("camera_matrix", P.tolist())]
    else:
        terms = np.trim_zeros(D, "b").tolist()
        terms += [0.0] * (next((count for count in _OPENCV_TERMS if len(terms) <= count), len(terms)) - len(terms))
        pairs += [("camera_matrix", K.ravel().tolist()), ("distortion_model", str(info.distortion_model))]
        pairs += [("distortion_coefficients", terms)]
    try:
        calibration = of_fields(Fields(pairs), size)
    except ValueError as error:
        raise CalibrationError(
            f"the camera in {bag}, {topic} cannot be used: {error}; give a calibration file (--camera)"
        ) from None
    note = ", P of rectified images" if rectified else ""
    return replace(calibration, source=f"{topic} of the bag{note}{calibration.source}")


def _samples(message: Any, sample: str, channels: int) -> np.ndarray:
    """Return the samples (h, w, channels) of an uncompressed image without the padding of its rows."""
    height, width, data = int(message.height), int(message.width), message.data
    check_pixels(float(height) * width)
    dtype = np.dtype(sample).newbyteorder(">" if message.is_bigendian else "<")
    length = width * channels * dtype.itemsize
    step = int(message.step) or length
    if min(height, width) < 1 or step < length or data.size < step * height:
        raise InputError(
            f"its data do not make the image: {data.size} bytes for {height} rows of {step} bytes, {width} px wide"
        )
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :length])
    return rows.view(dtype).reshape(height, width, channels).astype(dtype.newbyteorder("="), copy=False)


def _converted(values: np.ndarray, code: int) -> np.ndarray:
    try:
        return cv2.cvtColor(values, code)
    except cv2.error:
        raise InputError(f"its colours cannot be converted at {values.shape[1]}x{values.shape[0]} px") from None


def _bayer_code(match: re.Match[str]) -> int:
    return int(getattr(cv2, f"COLOR_Bayer{match[1].upper()}2RGB"))


def _compressed_image(message: Any) -> np.ndarray:
    # The encoding of what was compressed comes after the semicolon.
    bayer = _BAYER.search(message.format.split(";")[-1])
    values = decoded(message.data.tobytes(), (0 if bayer else cv2.IMREAD_COLOR) | cv2.IMREAD_ANYDEPTH)
    if values is None or values.dtype not in (np.uint8, np.uint16):
        raise InputError(f"its compressed image ('{message.format[:40]}') cannot be decoded")
    return _converted(values, _bayer_code(bayer) if bayer else cv2.COLOR_BGR2RGB)


def _compressed_depth(message: Any) -> np.ndarray:
    """Return depth, mm, of a 16-bit PNG, which `compressed_depth_image_transport` puts behind a header of 12 bytes."""
    content = message.data.tobytes()
    header = _DEPTH_HEADER.size if _COMPRESSED_DEPTH in message.format else 0
    values = decoded(content[header:])
    if values is None or values.ndim != 2 or values.dtype != np.uint16:
        raise InputError(f"its compressed depth ('{message.format[:40]}') cannot be decoded: PNG of 16 bit is read")
    if not message.format.startswith("32FC1"):
        return values.astype(np.float32)
    if not header:
        raise InputError(f"its compressed depth ('{message.format[:40]}') has no header of its quantization")
    _, a, b = _DEPTH_HEADER.unpack(content[:header])
    # Inverse depth in equal steps.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(values > 0, _MM_PER_METRE * a / (values.astype(np.float32) - b), np.nan)
