"""Figures of a benchmark: one panel per sequence or method, values as bars and points.

Bars are named after their methods, so that no legend is needed. Data frames have one row per sequence and one column
per method, NaN where there is no figure. All functions write a PNG.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scopemap.engine.errors import check_shape
from scopemap.report.mesh_figures import ESTIMATE_COLOUR

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.container import BarContainer
    from mpl_toolkits.mplot3d import Axes3D

_LETTERS_PER_INCH = 12
BAR_COLOUR = "#4575b4"
_NOTE_COLOUR = "#666666"
_MEAN_COLOUR = "#d95f02"
_PANELS_ACROSS = 4
_LONGEST_NAME = 34
_SHOWN_MATCHES = 400
_BARS_PT = 140.0  # width of a panel, less the gaps between its bars


def draw_ate(ate_mm: pd.DataFrame, file: Path, *, alignment: str) -> None:
    """Draw the ATE RMSE, mm, of every method on every sequence; `alignment` names that of the trajectories."""
    figure, panels = _bar_panels(ate_mm)
    for axes, values in zip(panels, ate_mm.to_numpy(), strict=True):
        _draw_bars(axes, values, ".2f")
        axes.set_xlabel("ATE RMSE, mm")
    _headline(figure, f"Position error after alignment: {alignment}; lower is better")
    figure.savefig(file)


def draw_frames_until_loss(frames: pd.DataFrame, lengths: Sequence[int], file: Path) -> None:
    """Draw the frames until tracking is lost first, green if never; `lengths` of the sequences are dashed lines."""
    check_shape("lengths", np.asarray(lengths), (len(frames),))
    figure, panels = _bar_panels(frames)
    for axes, values, length in zip(panels, frames.to_numpy(), lengths, strict=True):
        for bar, value in zip(_draw_bars(axes, values, ".0f", at_least=length), values, strict=True):
            bar.set_color(ESTIMATE_COLOUR if value >= length else BAR_COLOUR)
        axes.axvline(length, color="black", linestyle="--", linewidth=1)
        axes.set_xlabel(f"frames, of {length}")
    _headline(figure, "Frames until tracking is lost; green: never; higher is better")
    figure.savefig(file)


def draw_frames_until_contradicted(
    frames: pd.DataFrame, least: pd.DataFrame, most: pd.DataFrame, file: Path, *, limits: str
) -> None:
    """Draw the frames until poses contradict the pictures as bars, with a line from `least` to `most` over `limits`.

    A sequence without any figure is left out, which its title says.
    """
    figure, panels = _bar_panels(frames)
    for axes, sequence, low, high in zip(panels, frames.index, least.to_numpy(), most.to_numpy(), strict=True):
        values = frames.loc[sequence].to_numpy()
        axes.set_xlabel("frames")
        if not np.isfinite(values).any():
            axes.set_title(f"{_short(sequence)}\nleft out: contradicts true poses", fontsize=11)
            continue
        _draw_bars(axes, values, ".0f", at_least=float(np.nanmax(high)), past=high)
        axes.hlines(np.arange(len(values)), low, high, "black", linewidth=1.2)
    _headline(figure, f"Frames until the poses contradict the pictures' flow; line: {limits}; higher is better")
    figure.savefig(file)


def draw_displacements(displacements_mm: Mapping[str, np.ndarray], file: Path, *, bar: str, where: str) -> None:
    """Draw ORB displacements (N,), mm, NaN = unmatched, as bars, one panel per method; `bar` names what each is of.

    The paper's experiment 2, `where` the poses that took the points into one world are named.
    """
    across, down = _grid_size(len(displacements_mm))
    figure = _new_figure(3.4 * across + 0.6, 2.7 * down + 0.7)
    grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, (name, values_mm) in zip(grid, displacements_mm.items(), strict=False):
        known, result = np.isfinite(values_mm), "no match"
        # Lines, not bars of their own: there may be thousands.
        width_pt = max(0.5, _BARS_PT / len(values_mm)) if len(values_mm) else 1.0
        axes.vlines(1 + np.flatnonzero(known), 0, values_mm[known], BAR_COLOUR, linewidth=width_pt)
        if known.any():
            mean, median = values_mm[known].mean(), np.median(values_mm[known])
            axes.axhline(mean, color=_MEAN_COLOUR, linewidth=1.2)
            axes.axhline(median, color="black", linewidth=1.2, linestyle="--")
            result = f"mean {mean:.2f}, median {median:.2f} mm"
        axes.set_title(f"{_short(name)}\n{result}", fontsize=10)
        axes.grid(alpha=0.3)
    grid[0].set_ylim(bottom=0)
    for place, axes in enumerate(grid):
        axes.set_visible(place < len(displacements_mm))
        axes.tick_params(labelbottom=place + across >= len(displacements_mm))
    figure.supxlabel(bar)
    figure.supylabel("displacement, mm")
    _headline(figure, f"ORB displacement of each {bar}, {where}; line: mean, dashed: median; lower is better")
    figure.savefig(file)


def draw_matched_points(points_mm: Mapping[str, tuple[np.ndarray, np.ndarray]], file: Path, *, where: str) -> None:
    """Draw matched points of two consecutive frames in one world, `where`, mm, one panel per method, 400 at most.

    Each method gives the ends in the previous and in the current frame, (N, 3) each.
    """
    across, down = _grid_size(len(points_mm))
    figure = _new_figure(4.2 * across, 4.2 * down)
    # The constrained layout ignores the labels of 3D axes.
    figure.set_layout_engine(None)
    figure.subplots_adjust(left=0.02, right=1 - 0.3 / across, bottom=0.05, top=1 - 0.13 / down)
    for place, (name, (previous, current)) in enumerate(points_mm.items(), start=1):
        check_shape(f"current points of {name}", current, np.shape(previous))
        axes = figure.add_subplot(down, across, place, projection="3d")
        _draw_matches(axes, previous, current)
        distances = np.linalg.norm(previous - current, axis=1)
        mean = f"mean {distances.mean():.2f} mm" if len(distances) else "no match"
        axes.set_title(f"{_short(name)}\n{len(distances)} matches, {mean}", fontsize=10)
    figure.axes[0].legend(loc="upper left", fontsize=8)
    figure.suptitle(where, fontsize=10, y=0.995)
    figure.savefig(file)


def _draw_matches(axes: Axes3D, previous: np.ndarray, current: np.ndarray) -> None:
    step = max(1, -(-len(previous) // _SHOWN_MATCHES))
    # The world's y points down and its z forward: z goes into the picture.
    ends = [points[::step][:, [0, 2, 1]] * [1.0, 1.0, -1.0] for points in (previous, current)]
    lines = np.stack([*ends, np.full_like(ends[0], np.nan)], axis=1).reshape(-1, 3)
    axes.plot(*lines.T, color=_NOTE_COLOUR, linewidth=0.6)
    for label, points, colour in zip(("previous", "current"), ends, (BAR_COLOUR, _MEAN_COLOUR), strict=True):
        axes.plot(*points.T, ".", color=colour, markersize=3, alpha=0.8, label=label)
    axes.set(xlabel="x mm", ylabel="z mm", zlabel="-y mm")
    axes.tick_params(labelsize=7)
    axes.locator_params(nbins=5)


def _new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure of this size, 100 dots per inch, with its own canvas: there is no global state."""
    figure = Figure(figsize=(width_in, height_in), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _headline(figure: Figure, text: str) -> None:
    """Write a title over the whole figure, in lines of about the same length."""
    width = int(_LETTERS_PER_INCH * figure.get_figwidth())
    even = min(width, len(text) // len(textwrap.wrap(text, width)) + 12)
    figure.suptitle(textwrap.fill(text, even), fontsize=11)


def _grid_size(panels: int) -> tuple[int, int]:
    """Return columns and rows of a grid of panels."""
    across = min(_PANELS_ACROSS, panels)
    return across, -(-panels // across)


def _bar_panels(values: pd.DataFrame) -> tuple[Figure, list[Axes]]:
    """Return a figure with one panel per sequence, all with the methods from top to bottom."""
    across, down = _grid_size(len(values))
    figure = _new_figure(3.4 * across + 2.2, (0.32 * len(values.columns) + 1.0) * down + 0.8)
    panels = list(figure.subplots(down, across, sharey=True, squeeze=False).ravel())
    for axes in panels[len(values) :]:
        axes.set_visible(False)
    for axes, sequence in zip(panels, values.index, strict=False):
        axes.set_title(_short(sequence), fontsize=11)
    panels[0].set_yticks(range(len(values.columns)), [_short(method) for method in values.columns])
    panels[0].set_ylim(len(values.columns) - 0.4, -0.6)
    return figure, panels[: len(values)]


def _draw_bars(
    axes: Axes, values: np.ndarray, form: str, *, at_least: float = 0.0, past: np.ndarray | None = None
) -> BarContainer:
    """Draw one sequence's bars, their values at the end or at `past`; the axis reaches to `at_least`."""
    lengths = np.nan_to_num(values)
    bars = axes.barh(np.arange(len(values)), lengths, color=BAR_COLOUR, height=0.7)
    labels = [format(value, form) if np.isfinite(value) else "no figure" for value in values]
    ends = lengths if past is None else np.fmax(lengths, past)
    for place, (end, label) in enumerate(zip(ends, labels, strict=True)):
        axes.annotate(label, (end, place), (4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set_xlim(0, 1.22 * (max(float(lengths.max()), at_least) or 1.0))
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    return bars


def _short(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
