"""A bar on a picture that says how long some millimetres are there."""

from __future__ import annotations

import math

import numpy as np

from scopemap.report.sheet import Sheet

_SHARE = 0.25
_MARGIN_PX = 8
_TEXT_PX = 13


def draw_scale_bar(picture: np.ndarray, px_per_mm: float, words: str = "") -> None:
    """Draw a bar of a round length, about a quarter of a picture (H, W, 3) uint8, in place; nothing where unknown."""
    height, width, _ = picture.shape
    if not (math.isfinite(px_per_mm) and px_per_mm > 0):
        return
    longest = _SHARE * width / px_per_mm
    power = 10.0 ** math.floor(math.log10(longest))
    length = next(digit * power for digit in (5, 2, 1) if digit * power <= longest)
    sheet, text = Sheet.over(picture), f"{length:g} mm{words}"
    wide = max(length * px_per_mm, 0.55 * _TEXT_PX * len(text))
    sheet.fill((_MARGIN_PX - 4, height - 32, wide + 8, 28), "#101010")
    sheet.fill((_MARGIN_PX, height - 11, length * px_per_mm, 3), "#ffffff")
    sheet.text((_MARGIN_PX, height - 30), text, _TEXT_PX, "#ffffff")
