"""A white sheet for pictures, text and curves, drawn by OpenCV and Pillow."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

INK = "#17202b"
SOFT = "#566373"
FAINT = "#dfe4ea"
_SUBPIXEL_BITS = 4
_JPEG_QUALITY = 88
_GAP_PX = 8
_TITLE_PX = 14
_TICKS = 5
_LETTER_SHARE = 0.52  # mean width of a letter over the size of the font


def rgb_of(colour: str) -> tuple[int, int, int]:
    """Return the red, green and blue of "#rrggbb", 0..255."""
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return red, green, blue


class Sheet:
    """A picture (height, width, 3) uint8, white at first; x goes right, y down, px. Colours are "#rrggbb"."""

    def __init__(self, width: float, height: float) -> None:
        self.rgb = np.full((round(height), round(width), 3), 255, np.uint8)

    @classmethod
    def over(cls, rgb: np.ndarray) -> Sheet:
        """Return a sheet that draws on a picture (H, W, 3) uint8, in place."""
        sheet = cls(0, 0)
        sheet.rgb = rgb
        return sheet

    def picture(self, rgb: np.ndarray, box: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        """Draw a picture (h, w, 3) uint8 as large as fits in the middle of a box: left, top, width, height.

        Returns where it is drawn, a box again.
        """
        left, top, width, height = box
        scale = min(width / rgb.shape[1], height / rgb.shape[0])
        size = max(1, round(scale * rgb.shape[1])), max(1, round(scale * rgb.shape[0]))
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST
        shown = cv2.resize(np.ascontiguousarray(rgb), size, interpolation=how)
        x, y = round(left + (width - size[0]) / 2), round(top + (height - size[1]) / 2)
        self.rgb[y : y + size[1], x : x + size[0]] = shown
        return x, y, *size

    def text(
        self, place: tuple[float, float], words: str, size: int = 13, colour: str = INK, anchor: str = "la"
    ) -> None:
        """Write one or more lines at a place; anchor : Pillow's, "la": its left upper corner, "mm": its middle."""
        lines, step = words.splitlines(), round(1.25 * size)
        # Only the rows around it: to copy all of a sheet for each label takes a third of a report's time.
        top = max(0, int(place[1]) - 2 * step)
        rows = self.rgb[top : max(top, int(place[1]) + (len(lines) + 2) * step)]
        if not rows.size:
            return
        image = Image.fromarray(rows)
        draw = ImageDraw.Draw(image)
        for row, line in enumerate(lines):
            draw.text((place[0], place[1] - top + row * step), line, colour, _font(size), anchor=anchor)
        rows[:] = np.asarray(image)

    def line(self, points: np.ndarray, colour: str, width_px: int = 1) -> None:
        """Draw a line through points (n, 2); rows that hold NaN are gaps."""
        known = np.isfinite(points).all(1)
        ends = _fixed_point(np.where(known[:, None], points, 0))
        for row in np.flatnonzero(known[:-1] & known[1:]):
            first, last = ends[row].tolist(), ends[row + 1].tolist()
            cv2.line(self.rgb, first, last, rgb_of(colour), width_px, cv2.LINE_AA, _SUBPIXEL_BITS)

    def dots(self, points: np.ndarray, colour: str, radius_px: float = 2.0) -> None:
        """Draw a dot at each of some points (n, 2); rows that hold NaN have none."""
        radius = round(radius_px * (1 << _SUBPIXEL_BITS))
        for x, y in _fixed_point(points[np.isfinite(points).all(1)]).tolist():
            cv2.circle(self.rgb, (x, y), radius, rgb_of(colour), cv2.FILLED, cv2.LINE_AA, _SUBPIXEL_BITS)

    def fill(self, box: tuple[float, float, float, float], colour: str) -> None:
        """Fill a box: left, top, width, height."""
        left, top, width, height = box
        rows = slice(max(round(top), 0), max(round(top + height), 0))
        self.rgb[rows, max(round(left), 0) : max(round(left + width), 0)] = rgb_of(colour)

    def legend(self, place: tuple[float, float], colours: Mapping[str, str], step_px: float, size: int = 12) -> None:
        """Draw what colours "#rrggbb" mean, by their words, in a row from a left upper corner."""
        for number, (words, colour) in enumerate(colours.items()):
            x, y = place[0] + step_px * number, place[1]
            self.fill((x, y, size + 4, size + 4), colour)
            self.text((x + size + 10, y + 1), words, size)

    def headline(self, words: str, size: int = 16) -> None:
        """Write a title in the middle of the sheet's top, in as many lines as its width asks for."""
        middle = self.rgb.shape[1] / 2
        letters = max(int(2 * middle / (_LETTER_SHARE * size)) - 2, 10)
        for row, line in enumerate(textwrap.wrap(words, letters)):
            self.text((middle, 8 + 1.25 * size * row), line, size, anchor="ma")

    def save(self, file: Path) -> None:
        """Write the sheet as the kind of image that the name says. Raises `OSError` where it cannot be written."""
        # PNG has no quality, and ignores it.
        Image.fromarray(self.rgb).save(file, quality=_JPEG_QUALITY)

    @property
    def jpeg(self) -> bytes:
        """The sheet as JPEG, for a page that needs no other file."""
        content = io.BytesIO()
        Image.fromarray(self.rgb).save(content, "JPEG", quality=_JPEG_QUALITY)
        return content.getvalue()


@dataclass(frozen=True)
class Plot:
    """A diagram on a sheet.

    box : left, top, width, height of its inside, px. x, y : values at the left and the right, below and above.
    """

    sheet: Sheet
    box: tuple[float, float, float, float]
    x: tuple[float, float]
    y: tuple[float, float]

    def place(self, points: np.ndarray) -> np.ndarray:
        """Return where values (n, 2) are on the sheet."""
        left, top, width, height = self.box
        across = (points[:, 0] - self.x[0]) / (self.x[1] - self.x[0])
        up = (points[:, 1] - self.y[0]) / (self.y[1] - self.y[0])
        return np.column_stack([left + across * width, top + (1 - up) * height])

    def frame(
        self, x_label: str = "", y_label: str = "", *, x_numbers: bool = True, y_numbers: bool = True, size: int = 11
    ) -> None:
        """Draw a grid with its values, and the names of the axes, around the inside."""
        left, top, width, height = self.box
        right, bottom = left + width, top + height
        for value in ticks(*sorted(self.x)):
            at = self.place(np.array([[value, self.y[0]]]))[0, 0]
            self.sheet.line(np.array([[at, top], [at, bottom]]), FAINT)
            if x_numbers:
                self.sheet.text((at, bottom + 4), f"{value:g}", size, SOFT, "ma")
        for value in ticks(*sorted(self.y)) if y_numbers else []:
            at = self.place(np.array([[self.x[0], value]]))[0, 1]
            self.sheet.line(np.array([[left, at], [right, at]]), FAINT)
            self.sheet.text((left - 5, at), f"{value:g}", size, SOFT, "rm")
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
        self.sheet.line(corners, SOFT)
        self.sheet.text((left + width / 2, bottom + (6 + 1.4 * size) * x_numbers + 3), x_label, size + 1, INK, "ma")
        self.sheet.text((left + 6, top + 4), y_label, size + 1, INK)


def ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers between two values."""
    rough = max((high - low) / _TICKS, 1e-12)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough)
    return [round(n * step, 12) for n in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def picture_grid(rows: Sequence[Mapping[str, np.ndarray]], cell_px: tuple[int, int], headline: str = "") -> Sheet:
    """Return a sheet of pictures (h, w, 3) uint8 with their titles above them; titles of one letter or less are none.

    cell_px : width and height of a picture at most.
    """
    lines = [max((title.count("\n") + 1) * (len(title.strip()) > 0) for title in row) for row in rows]
    heads = [round(1.25 * _TITLE_PX * count) + _GAP_PX for count in lines]
    top = 36 if headline else 0
    width, height = cell_px[0] + _GAP_PX, cell_px[1] + _GAP_PX
    sheet = Sheet(width * max(map(len, rows), default=1) + _GAP_PX, top + sum(heads) + height * max(len(rows), 1))
    for row, head in zip(rows, heads, strict=True):
        for column, (title, picture) in enumerate(row.items()):
            left = _GAP_PX + column * width
            sheet.text((left + cell_px[0] / 2, top + 4), title, _TITLE_PX, anchor="ma")
            sheet.picture(picture, (left, top + head, *cell_px))
        top += head + height
    if headline:
        sheet.headline(headline)
    return sheet


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _fixed_point(points: np.ndarray) -> np.ndarray:
    """Return points in OpenCV's fixed point, limited so that they do not overflow."""
    return np.round(np.clip(points, -1e6, 1e6) * (1 << _SUBPIXEL_BITS)).astype(np.int32)
