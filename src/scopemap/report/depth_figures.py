"""Figures of depth maps: raw, refined and true depth of some frames, and its change between consecutive frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from scopemap.errors import check_shape
from scopemap.report.canvas import new_figure
from scopemap.report.sheet import picture_grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CHANGE_COLOURS = "YlOrRd"
_CELL_PX = (300, 250)


@dataclass(frozen=True)
class DepthScene:
    """Two consecutive frames and each method's depth of both.

    Attributes
    ----------
    name : of the sequence and frames. images : the previous and the current one, (H, W, 3) uint8.
    depths_mm : by method, the previous and the current depth, (H, W) mm, NaN = unknown.
    """

    name: str
    images: tuple[np.ndarray, np.ndarray]
    depths_mm: Mapping[str, tuple[np.ndarray, np.ndarray]]


def colour_depth(depth_mm: np.ndarray, near_mm: float, far_mm: float) -> np.ndarray:
    """Return (H, W, 3) uint8 sRGB of depth (H, W) mm: `near_mm` blue, `far_mm` red (turbo), NaN black."""
    check_shape("depth_mm", depth_mm, (None, None))
    if not far_mm > near_mm:
        raise ValueError(f"colouring depth: far ({far_mm} mm) must be beyond near ({near_mm} mm)")
    known = np.isfinite(depth_mm)
    share = (np.where(known, depth_mm, near_mm) - near_mm) / (far_mm - near_mm)
    rgb = cv2.applyColorMap(np.round(255 * np.clip(share, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
    rgb[~known] = 0
    return rgb


def draw_depths(images: Sequence[np.ndarray], depths_mm: Mapping[str, Sequence[np.ndarray | None]], file: Path) -> None:
    """Draw a contact sheet as a PNG: one row per image, one column per kind of depth ("raw depth", "true depth").

    `images` are (H, W, 3) uint8, depths (H, W) mm with NaN = unknown, None: no depth. All share one colour scale, from
    the 2nd to the 98th percentile. Raises `ValueError` when the lists are empty or of different length.
    """
    if not images or any(len(depths) != len(images) for depths in depths_mm.values()):
        raise ValueError(
            f"drawing depths of {len(images)} images: give one or more, and as many depth maps of each kind"
        )
    near_mm, far_mm = _percentiles([depth for depths in depths_mm.values() for depth in depths if depth is not None])
    rows = []
    for number, (image, depths) in enumerate(zip(images, zip(*depths_mm.values(), strict=True), strict=True)):
        pictures = [np.zeros_like(image) if depth is None else colour_depth(depth, near_mm, far_mm) for depth in depths]
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


def draw_depth_change(scene: DepthScene, file: Path) -> None:
    """Draw a row per method as a PNG: frame, previous depth, current depth, their absolute difference.

    The paper's experiments 1 and 2 (arXiv 2508.11282). Methods share the scales of depth (turbo) and of difference
    (white to red), whose far end is the 98th percentile; unknown is black. The first two rows show the two frames.
    """
    count = max(len(scene.depths_mm), 2)
    figure = new_figure(12.6, 2.5 * count + 0.6)
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    grid = figure.subplots(count, 4, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for axes, head in zip(grid[0], ("frame", "depth, previous", "depth, current", "|difference|"), strict=True):
        axes.set_title(head, fontsize=11)
    for axes, image, when in zip(grid[:, 0], scene.images, ("previous", "current"), strict=False):
        axes.imshow(image)
        _caption(axes, f"{scene.name}, {when}")
    near_mm, far_mm = _percentiles([depth for pair in scene.depths_mm.values() for depth in pair])
    changes_mm = [np.abs(current - previous) for previous, current in scene.depths_mm.values()]
    largest_mm = _percentiles(changes_mm)[1]
    for row, (method, depths), change_mm in zip(grid, scene.depths_mm.items(), changes_mm, strict=False):
        for axes, depth_mm in zip(row[1:3], depths, strict=True):
            axes.imshow(colour_depth(depth_mm, near_mm, far_mm))
        known = np.isfinite(change_mm)
        coloured = colormaps[_CHANGE_COLOURS](np.where(known, change_mm, 0.0) / largest_mm, bytes=True)[..., :3]
        row[3].imshow(np.where(known[..., None], coloured, np.uint8(0)))
        _caption(row[1], method)
        _caption(row[3], f"{method}: mean {change_mm[known].mean():.2f} mm" if known.any() else f"{method}: unknown")
    scales = (("turbo", near_mm, far_mm, "depth, mm", 2), (_CHANGE_COLOURS, 0.0, largest_mm, "mm", 3))
    for colours, low, high, label, column in scales:
        bar = ScalarMappable(Normalize(low, high), colours)
        figure.colorbar(bar, ax=list(grid[:, column]), label=label, fraction=0.05, pad=0.02)
    figure.savefig(file)


def _caption(axes: Axes, text: str) -> None:
    axes.text(0.5, -0.03, text, transform=axes.transAxes, ha="center", va="top", fontsize=9)


def _percentiles(maps: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of the known values, apart; 0 and 1 without any."""
    known = np.concatenate([values[np.isfinite(values)] for values in maps])
    low, high = np.percentile(known, (2, 98)) if len(known) else (0.0, 1.0)
    return float(low), float(max(high, low + 1e-3))
