"""The map of what was seen of a space: a lumen is cut open at 12 o'clock, a cavity is a disc, as the camera looks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from scopemap.engine.errors import reporting
from scopemap.report.sheet import FAINT, INK, SOFT, Plot, Sheet, rgb_of

COLOURS = {"seen": "#2a9d8f", "from afar or obliquely only": "#e9c46a", "probably not seen": "#9b2226"}
"""Of the classes 1, 2 and 3; seen is the paler the fewer frames see it."""
OUTSIDE = "#bebebe"  # of a surface, where it was not examined
_PALEST = 0.45
# By hand: the window's panel shows the picture at two fifths of its size, so that letters of 26 px are 10 px there.
_SIZE = (960, 880)
_LETTERS_PX = 26
_LINE_PX = 36
_BOX = (90.0, 90.0, 820.0, 500.0)
_LEGEND_TOP = 724
_MIDDLE = (480.0, 350.0)
_DISC_PX = 250.0
_CLOCK = (12, 3, 6, 9)


@dataclass(frozen=True)
class DrawnMap:
    """What is drawn of a map.

    kind : "lumen", whose rows are places along it, or "cavity", whose rows are angles from the mean direction of view,
    degrees. unit : of places along a lumen. classes : (S, 36) uint8, 0 outside. frames : (S, 36), the share of the
    frames that see each bin. along : values at the first and the last row's edge. spots : place along and clock of
    blind spots, numbered from 1; clock None: all round.
    """

    kind: Literal["lumen", "cavity"]
    unit: str
    classes: np.ndarray
    frames: np.ndarray
    along: tuple[float, float]
    spots: list[tuple[float, float | None]]
    headline: str

    @property
    def colours(self) -> np.ndarray:
        """(S, 36, 3) uint8, white outside."""
        rows = np.nan_to_num(self.frames / max(float(np.nanmax(self.frames, initial=0.0)), 1e-9))
        paleness = np.where(self.classes == 1, _PALEST * (1 - np.sqrt(rows)), 0)[..., None]
        palette = np.array([[255, 255, 255], *map(rgb_of, COLOURS.values())], float)
        return np.round(palette[self.classes] * (1 - paleness) + 255 * paleness).astype(np.uint8)


def legend_of(classes: np.ndarray) -> dict[str, str]:
    """Return the words and colours "#rrggbb" of those classes 1, 2 and 3 that occur."""
    return {words: colour for number, (words, colour) in enumerate(COLOURS.items(), 1) if (classes == number).any()}


def draw_coverage(drawn: DrawnMap, file: Path) -> None:
    """Draw a map as an image. Raises `InputError` where the file cannot be written."""
    sheet = Sheet(*_SIZE)
    sheet.headline(drawn.headline, _LETTERS_PX)
    places = _draw_lumen(sheet, drawn) if drawn.kind == "lumen" else _draw_cavity(sheet, drawn)
    for number, place in enumerate(places, 1):
        sheet.dots(place[None], "#ffffff", 17)
        sheet.text((place[0], place[1]), str(number), _LETTERS_PX, anchor="mm")
    legend, left = legend_of(drawn.classes), _BOX[0]
    for row, (words, colour) in enumerate(legend.items()):
        sheet.legend((left, _LEGEND_TOP + _LINE_PX * row), {words: colour}, 0, _LETTERS_PX)
    below = _LEGEND_TOP + _LINE_PX * len(legend)
    sheet.text((left, below), "paler: seen by few frames; white: not judged", _LETTERS_PX, SOFT)
    with reporting(f"cannot write {file}"):
        sheet.save(file)


def _draw_lumen(sheet: Sheet, drawn: DrawnMap) -> list[np.ndarray]:
    """Draw a lumen cut open: along it to the right, the clock upwards; return where its spots are, px."""
    left, top, width, height = _BOX
    picture = np.ascontiguousarray(drawn.colours.transpose(1, 0, 2)[::-1])
    sheet.rgb[round(top) : round(top + height), round(left) : round(left + width)] = cv2.resize(
        picture, (round(width), round(height)), interpolation=cv2.INTER_NEAREST
    )
    plot = Plot(sheet, _BOX, drawn.along, (0.0, 12.0))
    plot.frame(f"along the centreline, {drawn.unit}", y_numbers=False, size=_LETTERS_PX - 1)
    for hours in (*_CLOCK, 0):
        place = plot.place(np.array([[drawn.along[0], hours]]))[0]
        sheet.line(np.array([[left, place[1]], [left + width, place[1]]]), FAINT)
        sheet.text((left - 8, place[1]), str(hours or 12), _LETTERS_PX, SOFT, "rm")
    sheet.text((left, top - _LINE_PX), "o'clock; 12 is up in the first picture", _LETTERS_PX)
    spots = [(place, 6.0 if hours is None else hours) for place, hours in drawn.spots]
    return list(plot.place(np.array(spots).reshape(-1, 2)))


def _draw_cavity(sheet: Sheet, drawn: DrawnMap) -> list[np.ndarray]:
    """Draw a cavity as the camera looks into it, its mean direction of view in the middle; return its spots, px."""
    rows, columns = drawn.classes.shape
    y, x = np.mgrid[: _SIZE[1], : _SIZE[0]].astype(float)
    right, up = x - _MIDDLE[0], _MIDDLE[1] - y
    share = np.hypot(right, up) / _DISC_PX
    row = np.minimum((share * rows).astype(int), rows - 1)
    column = (np.arctan2(right, up) / (2 * np.pi) % 1 * columns).astype(int) % columns
    inside = share < 1
    sheet.rgb[inside] = drawn.colours[row[inside], column[inside]]

    def place(share: float, hours: float) -> np.ndarray:
        turn = 2 * np.pi * hours / 12
        return np.array([_MIDDLE[0] + share * _DISC_PX * np.sin(turn), _MIDDLE[1] - share * _DISC_PX * np.cos(turn)])

    sheet.line(np.array([place(1.0, hours) for hours in np.linspace(0, 12, 121)]), SOFT)
    for hours in _CLOCK:
        at = place(1.1, hours)
        sheet.text((at[0], at[1]), str(hours), _LETTERS_PX, SOFT, "mm")
    rim = f"as the camera looks: the rim is {drawn.along[1]:.0f} degrees from its mean"
    words = f"{rim}\ndirection of view; 12 o'clock is up in the first picture"
    sheet.text((_MIDDLE[0], _MIDDLE[1] + 1.2 * _DISC_PX), words, _LETTERS_PX, INK, "ma")
    return [place(0.0 if hours is None else along / drawn.along[1], hours or 0.0) for along, hours in drawn.spots]
