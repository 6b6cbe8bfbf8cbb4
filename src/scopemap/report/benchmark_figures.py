"""Figures of a benchmark: one panel per sequence or method, values as bars and points.

Methods are named at the bars, so that nothing has to be looked up in a legend, however many there are. All functions
take plain arrays and write a PNG.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scopemap.errors import check_shape
from scopemap.report.canvas import ESTIMATE_COLOUR, headline, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

BAR_COLOUR = "#4575b4"
_NOTE_COLOUR = "#666666"
_MEAN_COLOUR = "#d95f02"
_PANELS_ACROSS = 4
_LONGEST_NAME = 34
_SHOWN_MATCHES = 400


@dataclass(frozen=True)
class BarGrid:
    """Values of methods on sequences.

    Attributes
    ----------
    sequences, methods : their S and M names.
    values : (S, M) float, NaN where there is none. spreads : (S, M), half length of a whisker; NaN: none.
    absent : what stands where there is no value.
    """

    sequences: Sequence[str]
    methods: Sequence[str]
    values: np.ndarray
    spreads: np.ndarray | None = None
    absent: str = "no figure"

    def __post_init__(self) -> None:
        shape = (len(self.sequences), len(self.methods))
        check_shape("BarGrid.values", self.values, shape)
        if self.spreads is not None:
            check_shape("BarGrid.spreads", self.spreads, shape)
        if 0 in shape:
            raise ValueError("drawing bars: give at least one sequence and one method")


def draw_ate(ate_mm: BarGrid, file: Path, *, alignment: str) -> None:
    """Draw the ATE RMSE, mm, of every method on every sequence; `alignment` says how trajectories were aligned."""
    figure, panels = _panels(ate_mm)
    for row, axes in enumerate(panels):
        _draw_bars(axes, ate_mm, row, ".2f")
        axes.set_xlabel("ATE RMSE, mm")
    whiskers = "" if ate_mm.spreads is None else "; whisker: half the range over the seeds"
    headline(figure, f"Position error after alignment: {alignment}; lower is better{whiskers}")
    figure.savefig(file)


def draw_frames_until_loss(frames: BarGrid, lengths: Sequence[int], file: Path) -> None:
    """Draw the frames until tracking is lost first; `lengths` are the frames of each sequence, a dashed line.

    Bars of methods that hold to the end are green. Raises `ValueError` unless there is one length per sequence.
    """
    check_shape("lengths", np.asarray(lengths), (len(frames.sequences),))
    figure, panels = _panels(frames)
    for row, axes in enumerate(panels):
        bars = _draw_bars(axes, frames, row, ".0f", reach=float(lengths[row]))
        for bar, value in zip(bars, frames.values[row], strict=True):
            bar.set_color(ESTIMATE_COLOUR if value >= lengths[row] else BAR_COLOUR)
        axes.axvline(lengths[row], color="black", linestyle="--", linewidth=1)
        axes.set_xlabel(f"frames, of {lengths[row]}")
    headline(figure, "Frames until tracking is lost; green: never; higher is better")
    figure.savefig(file)


def draw_displacement_bars(mean_mm: BarGrid, median_mm: np.ndarray, file: Path, *, where: str) -> None:
    """Draw the mean ORB displacement, mm, its standard deviation (`spreads`) as a whisker and its median as a diamond.

    `median_mm` is (S, M) as the means; `where` says in which frame the points were compared ("world, true poses").
    """
    check_shape("median_mm", median_mm, np.shape(mean_mm.values))
    figure, panels = _panels(mean_mm)
    for row, axes in enumerate(panels):
        _draw_bars(axes, mean_mm, row, ".2f")
        places = np.arange(len(mean_mm.methods))
        axes.plot(median_mm[row], places, "D", color="white", markeredgecolor="black", markersize=6, linestyle="none")
        axes.set_xlabel("displacement, mm")
    marks = "bar: mean, whisker: standard deviation, diamond: median; lower is better"
    headline(figure, f"ORB displacement between consecutive frames, {where}; {marks}")
    figure.savefig(file)


def draw_displacement_scatter(pair_median_mm: Mapping[str, np.ndarray], file: Path, *, where: str) -> None:
    """Draw the median ORB displacement of each pair of consecutive frames, mm, one panel per method, one scale for all.

    `pair_median_mm` gives each method's (P,) values in order, NaN where nothing was matched. Raises `ValueError` for no
    method at all.
    """
    if not pair_median_mm:
        raise ValueError("drawing ORB displacements: give at least one method")
    across = min(_PANELS_ACROSS, len(pair_median_mm))
    down = -(-len(pair_median_mm) // across)
    figure = new_figure(3.4 * across + 0.6, 2.7 * down + 0.7)
    grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, (name, medians_mm) in zip(grid, pair_median_mm.items(), strict=False):
        check_shape(f"pair_median_mm of {name}", medians_mm, (None,))
        axes.plot(np.arange(1, len(medians_mm) + 1), medians_mm, ".", color=BAR_COLOUR, markersize=4, alpha=0.7)
        known = medians_mm[np.isfinite(medians_mm)]
        mean_mm = float(known.mean()) if len(known) else float("nan")
        if len(known):
            axes.axhline(mean_mm, color=_MEAN_COLOUR, linewidth=1.2)
        axes.set_title(
            f"{_short(name)}\nmean {mean_mm:.2f} mm" if len(known) else f"{_short(name)}\nno match", fontsize=10
        )
        axes.grid(alpha=0.3)
    grid[0].set_ylim(bottom=0)
    for place, axes in enumerate(grid):
        axes.set_visible(place < len(pair_median_mm))
        axes.tick_params(labelbottom=place + across >= len(pair_median_mm))
    figure.supxlabel("pair of consecutive frames")
    figure.supylabel("displacement, mm")
    headline(figure, f"ORB displacement, median of each pair, {where}; line: mean of the pairs")
    figure.savefig(file)


def draw_matched_points(points_mm: Mapping[str, tuple[np.ndarray, np.ndarray]], file: Path) -> None:
    """Draw matched points of two consecutive frames in space, mm, one panel per method: the closer, the better.

    Each method gives the ends in the previous and in the current frame, (N, 3) each, in one world; of more than 400
    matches every k-th is drawn. Raises `ValueError` for no method at all.
    """
    if not points_mm:
        raise ValueError("drawing matched points: give at least one method")
    across = min(_PANELS_ACROSS, len(points_mm))
    down = -(-len(points_mm) // across)
    figure = new_figure(4.2 * across, 4.2 * down)
    # The layout of the other figures does not see the labels of axes in space.
    figure.set_layout_engine(None)
    figure.subplots_adjust(left=0.02, right=1 - 0.3 / across, bottom=0.05, top=1 - 0.13 / down)
    for place, (name, (previous, current)) in enumerate(points_mm.items(), start=1):
        check_shape(f"current points of {name}", current, np.shape(previous))
        check_shape(f"previous points of {name}", previous, (None, 3))
        _draw_matches(figure.add_subplot(down, across, place, projection="3d"), previous, current)
        apart = np.linalg.norm(previous - current, axis=1)
        mean = f"mean {apart.mean():.2f} mm" if len(apart) else "no match"
        figure.axes[-1].set_title(f"{_short(name)}\n{len(apart)} matches, {mean}", fontsize=10)
    figure.axes[0].legend(loc="upper left", fontsize=8)
    figure.savefig(file)


def _draw_matches(axes: Axes3D, previous: np.ndarray, current: np.ndarray) -> None:
    step = max(1, -(-len(previous) // _SHOWN_MATCHES))
    # The world's y points down and its z forward: z goes into the picture.
    ends = [points[::step][:, [0, 2, 1]] * [1.0, 1.0, -1.0] for points in (previous, current)]
    joined = np.stack([*ends, np.full_like(ends[0], np.nan)], axis=1).reshape(-1, 3)
    axes.plot(*joined.T, color=_NOTE_COLOUR, linewidth=0.6)
    for label, points, colour in zip(("previous", "current"), ends, (BAR_COLOUR, _MEAN_COLOUR), strict=True):
        axes.plot(*points.T, ".", color=colour, markersize=3, alpha=0.8, label=label)
    axes.set(xlabel="x mm", ylabel="z mm", zlabel="-y mm")
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=5)


def _panels(grid: BarGrid) -> tuple[Figure, list[Axes]]:
    """Return a figure with one panel per sequence, all with the methods from top to bottom."""
    across = min(_PANELS_ACROSS, len(grid.sequences))
    down = -(-len(grid.sequences) // across)
    figure = new_figure(3.4 * across + 2.2, (0.32 * len(grid.methods) + 1.0) * down + 0.8)
    panels = list(figure.subplots(down, across, sharey=True, squeeze=False).ravel())
    for axes in panels[len(grid.sequences) :]:
        axes.set_visible(False)
    panels = panels[: len(grid.sequences)]
    for axes, sequence in zip(panels, grid.sequences, strict=True):
        axes.set_title(_short(sequence), fontsize=11)
    panels[0].set_yticks(range(len(grid.methods)), [_short(method) for method in grid.methods])
    panels[0].set_ylim(len(grid.methods) - 0.4, -0.6)
    return figure, panels


def _draw_bars(axes: Axes, grid: BarGrid, row: int, form: str, *, reach: float = 0.0) -> list:
    """Draw one sequence's bars with their values at the end, and room for these up to `reach` at least."""
    values = grid.values[row]
    spreads = np.full(len(values), np.nan) if grid.spreads is None else grid.spreads[row]
    places = np.arange(len(values))
    bars = axes.barh(places, np.nan_to_num(values), color=BAR_COLOUR, height=0.7)
    with_whisker = np.isfinite(values) & np.isfinite(spreads)
    # A distance below zero cannot be.
    below = np.minimum(spreads, values)[with_whisker]
    if with_whisker.any():
        axes.errorbar(
            values[with_whisker],
            places[with_whisker],
            xerr=np.stack([below, spreads[with_whisker]]),
            fmt="none",
            ecolor="black",
            elinewidth=1,
            capsize=3,
        )
    ends = np.nan_to_num(values) + np.nan_to_num(np.where(with_whisker, spreads, 0.0))
    longest = max(float(ends.max()), reach) or 1.0
    for place, value, end in zip(places.tolist(), values, ends, strict=True):
        known = np.isfinite(value)
        text = format(value, form) if known else grid.absent
        colour = "black" if known else _NOTE_COLOUR
        axes.text(end + 0.02 * longest, place, text, va="center", fontsize=8, color=colour)
    axes.set_xlim(0, 1.22 * longest)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    return list(bars)


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
