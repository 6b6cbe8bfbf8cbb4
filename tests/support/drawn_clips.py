"""Made-up endoscope videos: tissue that moves under a lamp, with one peculiarity each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np

SIZE = (320, 240)
RATE = 25
Change = Callable[[int, np.ndarray], np.ndarray]


@cache
def _canvas(seed: int) -> np.ndarray:
    """Tissue, larger than any picture: red, with folds and vessels."""
    rng = np.random.default_rng(seed)
    level = np.zeros((900, 1200), np.float32)
    for sigma, amount in ((40, 45), (8, 30), (2.5, 14)):
        noise = cv2.GaussianBlur(rng.normal(0, 1, level.shape).astype(np.float32), (0, 0), sigma)
        level += amount * noise / noise.std()
    return np.clip(np.array([165.0, 85.0, 75.0]) + level[..., None] * [0.5, 0.45, 0.4], 20, 215).astype(np.uint8)


@cache
def _noise() -> np.ndarray:
    return np.random.default_rng(9).normal(0, 1.5, (1100, 1400, 3)).astype(np.float32)


def tissue(number: int, size: tuple[int, int] = SIZE, seed: int = 0) -> np.ndarray:
    """What the camera sees in frame `number`: it goes round and about over the tissue."""
    x = round(400 + 3.2 * number + 30 * np.sin(number / 5)) % (1200 - size[0])
    y = round(300 + 60 * np.sin(number / 9) + 20 * np.cos(number / 3))
    picture = _canvas(seed)[y : y + size[1], x : x + size[0]]
    # The sensor's noise: no picture repeats another.
    x, y = np.random.default_rng(1000 * seed + number).integers(0, 200, 2)
    noise = _noise()[y : y + size[1], x : x + size[0]]
    return cv2.add(picture, noise, dtype=cv2.CV_8U)


def clip(count: int = 60, *changes: Change, size: tuple[int, int] = SIZE) -> list[np.ndarray]:
    """Pictures of tissue, each changed by all `changes` in turn."""
    pictures = []
    for number in range(count):
        picture = tissue(number, size)
        for change in changes:
            picture = change(number, picture)
        pictures.append(picture)
    return pictures


def write(file: Path, pictures: Sequence[np.ndarray], times: Sequence[int] | None = None, codec: str = "mpeg4") -> Path:
    """A video of the pictures; `times`: stamps, in 25ths of a second."""
    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=RATE)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.bit_rate, stream.gop_size = "yuv420p", 6_000_000, 10
        stream.codec_context.time_base = Fraction(1, RATE)
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = (number if times is None else times[number]), Fraction(1, RATE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return file


def inside(draw: Callable[[np.ndarray], object]) -> Change:
    """Black but for what `draw` draws."""

    def change(_: int, picture: np.ndarray) -> np.ndarray:
        mask = np.zeros(picture.shape[:2], np.uint8)
        draw(mask)
        return np.where(mask[..., None] > 0, picture, 0).astype(np.uint8)

    return change


def circle(mask: np.ndarray) -> None:
    cv2.circle(mask, (160, 120), 112, 1, -1)


def octagon(mask: np.ndarray) -> None:
    corners = [[60, 0], [260, 0], [319, 60], [319, 180], [260, 239], [60, 239], [0, 180], [0, 60]]
    cv2.fillConvexPoly(mask, np.array(corners), 1)


def rounded(mask: np.ndarray) -> None:
    cv2.rectangle(mask, (50, 0), (269, 239), 1, -1)
    cv2.rectangle(mask, (0, 50), (319, 189), 1, -1)
    for centre in ((50, 50), (269, 50), (50, 189), (269, 189)):
        cv2.circle(mask, centre, 50, 1, -1)


def bars(mask: np.ndarray) -> None:
    mask[:, 30:290] = 1


def text(words: str = "SMITH 12:34", at: tuple[int, int] = (90, 60), *, scale: float = 0.5, level: int = 250) -> Change:
    def change(_: int, picture: np.ndarray) -> np.ndarray:
        out, thick = picture.copy(), max(1, round(2 * scale))
        cv2.putText(out, words, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (level, level, level), thick, cv2.LINE_AA)
        return out

    return change


def during(first: int, last: int, change: Change) -> Change:
    """`change` in the frames `first` to `last` alone."""
    return lambda number, picture: change(number, picture) if first <= number <= last else picture


def blurred(_: int, picture: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(picture, (0, 0), 9)


def black(_: int, picture: np.ndarray) -> np.ndarray:
    return np.zeros_like(picture)


def drape(number: int, picture: np.ndarray) -> np.ndarray:
    """A blue cloth."""
    return np.ascontiguousarray(tissue(number, picture.shape[1::-1], seed=3)[..., ::-1])


def inset(number: int, picture: np.ndarray) -> np.ndarray:
    """Another camera's picture in the upper right corner."""
    out = picture.copy()
    out[:80, 220:] = np.clip(tissue(3 * number, (100, 80), seed=7) // 2 + 60, 0, 255)[:, :, [1, 1, 0]]
    return out
