"""How much depth changes from one frame to the next, as pictures: plain depth and MAPIS-Depth on one scale.

The paper's experiments 1 and 2 (arXiv 2508.11282): consecutive depth maps of each method and their absolute difference.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scopemap.errors import check_shape
from scopemap.report.canvas import new_figure
from scopemap.report.pictures import colour_depth

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DIFFERENCE_COLOURS = "YlOrRd"
_HEADS = ("frame", "depth, previous", "depth, current", "|difference|")


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

    def __post_init__(self) -> None:
        if not self.depths_mm:
            raise ValueError(f"drawing depth of {self.name}: give the depth of at least one method")
        for name, depths in self.depths_mm.items():
            for depth in depths:
                check_shape(f"depth of {name}", depth, np.shape(self.images[0])[:2])


def draw_depth_differences(scenes: Sequence[DepthScene], file: Path) -> None:
    """Draw one row per scene and method as a PNG: frame, depth before, depth now, their absolute difference.

    The methods of a scene share the scales of depth (turbo) and of difference (white to red), whose far end is the 98th
    percentile; unknown is black. A scene's first two rows show its two frames. Raises `ValueError` for no scene.
    """
    if not scenes:
        raise ValueError("drawing depth differences: give at least one scene")
    rows = sum(max(len(scene.depths_mm), 2) for scene in scenes)
    figure = new_figure(12.6, 2.5 * rows + 0.6)
    grid = figure.subplots(rows, len(_HEADS), squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for axes, head in zip(grid[0], _HEADS, strict=True):
        axes.set_title(head, fontsize=11)
    top = 0
    for scene in scenes:
        below = top + max(len(scene.depths_mm), 2)
        _draw_scene(grid[top:below], scene)
        top = below
    figure.savefig(file)


def _draw_scene(grid: np.ndarray, scene: DepthScene) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    near_mm, far_mm = _percentiles([depth for pair in scene.depths_mm.values() for depth in pair], (2, 98))
    changes_mm = [np.abs(current - previous) for previous, current in scene.depths_mm.values()]
    most_mm = _percentiles(changes_mm, (2, 98))[1]
    for axes, image, when in zip(grid[:, 0], scene.images, ("previous", "current"), strict=False):
        axes.imshow(image)
        _caption(axes, f"{scene.name}, {when}")
    for row, (method, depths), change_mm in zip(grid, scene.depths_mm.items(), changes_mm, strict=False):
        for axes, depth_mm in zip(row[1:3], depths, strict=True):
            axes.imshow(colour_depth(depth_mm, near_mm, far_mm))
        row[3].imshow(_coloured_change(change_mm, most_mm))
        known = change_mm[np.isfinite(change_mm)]
        _caption(row[1], method)
        _caption(row[3], f"{method}: mean {known.mean():.2f} mm" if len(known) else f"{method}: nothing known")
    scales = (
        ("turbo", near_mm, far_mm, "depth, mm", grid[:, 2]),
        (_DIFFERENCE_COLOURS, 0.0, most_mm, "mm", grid[:, 3]),
    )
    for colours, low, high, label, beside in scales:
        bar = ScalarMappable(Normalize(low, high), colours)
        grid[0, 0].figure.colorbar(bar, ax=list(beside), label=label, fraction=0.05, pad=0.02)


def _caption(axes: Axes, text: str) -> None:
    axes.text(0.5, -0.03, text, transform=axes.transAxes, ha="center", va="top", fontsize=9)


def _coloured_change(change_mm: np.ndarray, most_mm: float) -> np.ndarray:
    """Return (H, W, 3) uint8: 0 nearly white, `most_mm` and more dark red, unknown black."""
    from matplotlib import colormaps

    known = np.isfinite(change_mm)
    coloured = colormaps[_DIFFERENCE_COLOURS](np.where(known, change_mm, 0.0) / most_mm, bytes=True)[..., :3]
    return np.where(known[..., None], coloured, np.uint8(0))


def _percentiles(maps: Sequence[np.ndarray], percents: tuple[float, float]) -> tuple[float, float]:
    known = np.concatenate([values[np.isfinite(values)] for values in maps])
    low, high = np.percentile(known, percents) if len(known) else (0.0, 1.0)
    return float(low), float(max(high, low + 1e-3))
