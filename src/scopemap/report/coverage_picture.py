"""The map of what was seen of a space, unrolled: place along and clock direction, in colours with a legend."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.errors import reporting
from scopemap.report.sheet import SOFT, Plot, Sheet, rgb_of

COLOURS = {"seen": "#2a9d8f", "from afar or obliquely only": "#e9c46a", "probably not seen": "#9b2226"}
"""Of the classes 1, 2 and 3; seen is the paler the fewer frames see it."""
OUTSIDE = "#bebebe"  # of a surface, where it was not examined
_PALEST = 0.45
_BOX = (60.0, 46.0, 820.0, 360.0)
_SIZE = (900, 500)


def draw_coverage(
    classes: np.ndarray,
    frames: np.ndarray,
    along: tuple[float, float],
    along_label: str,
    spots: list[tuple[float, float | None]],
    headline: str,
    file: Path,
) -> None:
    """Draw classes (S, 36) uint8, 0 outside, and the share of frames that see each bin, as an image.

    along : values at the first and the last row's edge. spots : place along and clock of blind spots, numbered from 1;
    clock None: all round. Raises `InputError` where the file cannot be written.
    """
    sheet = Sheet(*_SIZE)
    rows = np.nan_to_num(frames / max(float(np.nanmax(frames, initial=0.0)), 1e-9))
    paleness = np.where(classes == 1, _PALEST * (1 - np.sqrt(rows)), 0)[..., None]
    palette = np.array([[255, 255, 255], *map(rgb_of, COLOURS.values())], float)
    picture = palette[classes] * (1 - paleness) + 255 * paleness
    picture = np.round(picture).astype(np.uint8).transpose(1, 0, 2)[::-1]
    left, top, width, height = _BOX
    sheet.rgb[round(top) : round(top + height), round(left) : round(left + width)] = cv2.resize(
        np.ascontiguousarray(picture), (round(width), round(height)), interpolation=cv2.INTER_NEAREST
    )
    plot = Plot(sheet, _BOX, along, (0.0, 12.0))
    plot.frame(along_label, "")
    sheet.text((left, top - 16), "clock direction, 12 = up in the first picture", 12)
    for number, (place, hours) in enumerate(spots, 1):
        at = plot.place(np.array([[place, 6.0 if hours is None else hours]]))
        sheet.dots(at, "#ffffff", 9)
        sheet.text((at[0, 0], at[0, 1]), str(number), 12, anchor="mm")
    sheet.headline(headline)
    sheet.legend((left, _SIZE[1] - 32), COLOURS, 210)
    sheet.text((left + 630, _SIZE[1] - 31), "paler: by few frames; white: not judged", 11, SOFT)
    with reporting(f"cannot write {file}"):
        sheet.save(file)
