"""Figures of depth maps and renderings beside their frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from scopemap.report.sheet import picture_grid

_CELL_PX = (300, 250)


def colour_depth(depth_mm: np.ndarray, near_mm: float, far_mm: float) -> np.ndarray:
    """Return (H, W, 3) uint8 sRGB of depth (H, W) mm: `near_mm` blue, `far_mm` red (turbo), NaN black."""
    if not far_mm > near_mm:
        raise ValueError(f"colouring depth: far ({far_mm} mm) must be beyond near ({near_mm} mm)")
    known = np.isfinite(depth_mm)
    share = (np.where(known, depth_mm, near_mm) - near_mm) / (far_mm - near_mm)
    rgb = cv2.applyColorMap(np.round(255 * np.clip(share, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    rgb[~known] = 0
    return rgb


def draw_depths(images: Sequence[np.ndarray], depths_mm: Mapping[str, Sequence[np.ndarray]], file: Path) -> None:
    """Draw a contact sheet as a PNG: one row per image, one column per kind of depth ("raw depth", "refined depth").

    `images` are (H, W, 3) uint8, depths (H, W) mm with NaN = unknown, as many of each kind as images. All share one
    colour scale, from the 2nd to the 98th percentile.
    """
    near_mm, far_mm = percentiles([depth for depths in depths_mm.values() for depth in depths])
    rows = []
    for number, (image, *depths) in enumerate(zip(images, *depths_mm.values(), strict=True)):
        pictures = [colour_depth(depth, near_mm, far_mm) for depth in depths]
        # The first row names the columns.
        titles = [title if number == 0 else " " * column for column, title in enumerate(("image", *depths_mm))]
        rows.append(dict(zip(titles, [image, *pictures], strict=True)))
    picture_grid(rows, _CELL_PX, f"blue {near_mm:.0f} mm .. red {far_mm:.0f} mm, black unknown").save(file)


def draw_renderings(pairs: Mapping[int, tuple[np.ndarray, np.ndarray]], file: Path) -> None:
    """Draw a row per frame number as a PNG: the frame (H, W, 3) uint8, a rendering of it, their absolute difference."""
    rows = [
        {f"frame {number}": rgb, "surface, rendered": rendered, "difference": cv2.absdiff(rgb, rendered)}
        for number, (rgb, rendered) in pairs.items()
    ]
    picture_grid(rows, _CELL_PX).save(file)


def percentiles(maps: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of the known values, apart; 0 and 1 without any."""
    known = np.concatenate([values[np.isfinite(values)] for values in maps])
    low, high = np.percentile(known, (2, 98)) if len(known) else (0.0, 1.0)
    return float(low), float(max(high, low + 1e-3))
