"""Videos with what video systems do to pictures: two views, two fields, repeats, turns, other colours, odd clocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from tests.support.drawn_clips import RATE, SIZE, tissue

WIDTH, HEIGHT = SIZE
# Of H.264: without loss; the preset takes a tenth of the time of the usual one, and a third to decode.
LOSSLESS = {"qp": "0", "preset": "ultrafast"}


def stereo(number: int, disparity: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """Left and right view of a slanted plane: `disparity` widths apart in the middle, twice that below."""
    left = tissue(number)
    u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    seen = cv2.remap(left, u + 2 * disparity * WIDTH * v / HEIGHT, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    noise = np.random.default_rng(number).normal(0, 2, seen.shape)
    return left, np.clip(0.92 * seen + 5 + noise, 0, 255).astype(np.uint8)


def half(picture: np.ndarray, axis: int) -> np.ndarray:
    """Squeezed to half its height (axis 0) or width (axis 1)."""
    height, width = picture.shape[:2]
    size = (width, height // 2) if axis == 0 else (width // 2, height)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def beside(number: int) -> np.ndarray:
    return np.hstack(stereo(number))


def above(number: int) -> np.ndarray:
    return np.vstack(stereo(number))


def beside_squeezed(number: int) -> np.ndarray:
    return np.hstack([half(view, 1) for view in stereo(number)])


def above_squeezed(number: int) -> np.ndarray:
    return np.vstack([half(view, 0) for view in stereo(number)])


def woven(number: int, gap: int = 1) -> np.ndarray:
    """Even rows of one picture, odd rows of one `gap` later."""
    out = tissue(number).copy()
    out[1::2] = tissue(number + gap)[1::2]
    return out


def encode(
    file: Path,
    pictures: Sequence[np.ndarray],
    codec: str = "libx264",
    pix_fmt: str = "yuv444p",
    options: dict[str, str] | None = None,
    prepare: Callable[[av.VideoStream], None] = lambda stream: None,
) -> Path:
    """A video at 25 frames/s that loses next to nothing; `prepare` sets what the stream says of itself."""
    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=RATE, options=LOSSLESS if options is None else options)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pix_fmt
        prepare(stream)
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return file


def one_colour(
    file: Path, rgb: tuple[int, int, int], codec: str, pix_fmt: str, *, bt709: bool, full: bool, options: dict[str, str]
) -> Path:
    """Four frames of one colour in the given form; what Y, Cb and Cr are is worked out here (BT.601, BT.709)."""
    bits = 10 if "10" in pix_fmt else 8
    dtype = np.uint16 if bits == 10 else np.uint8
    frame = av.VideoFrame(64, 64, pix_fmt)
    for plane, value in zip(frame.planes, _coded(rgb, bits, bt709=bt709, full=full), strict=True):
        samples = np.full(plane.buffer_size // np.dtype(dtype).itemsize, value, dtype)
        plane.update(samples.tobytes())
    frame.colorspace, frame.color_range = (1 if bt709 else 5), (2 if full else 1)
    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=RATE, options=options)
        stream.width = stream.height = 64
        stream.pix_fmt = pix_fmt
        stream.codec_context.colorspace, stream.codec_context.color_range = frame.colorspace, frame.color_range
        for number in range(4):
            frame.pts, frame.time_base = number, Fraction(1, RATE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return file


def _coded(rgb: tuple[int, int, int], bits: int, *, bt709: bool, full: bool) -> list[int]:
    red, green, blue = (value / 255 for value in rgb)
    k_red, k_blue = (0.2126, 0.0722) if bt709 else (0.299, 0.114)
    luma = k_red * red + (1 - k_red - k_blue) * green + k_blue * blue
    chroma = ((blue - luma) / (2 * (1 - k_blue)), (red - luma) / (2 * (1 - k_red)))
    scale, middle = 2 ** (bits - 8), 2 ** (bits - 1)
    if full:
        return [round(luma * (2**bits - 1)), *(round(c * (2**bits - 1) + middle) for c in chroma)]
    return [round(scale * (16 + 219 * luma)), *(round(scale * (128 + 224 * c)) for c in chroma)]
