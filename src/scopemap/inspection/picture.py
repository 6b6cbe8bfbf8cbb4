"""An inspection as a picture (frames, the mask of a run, a time line), and as a mask for `mask.files`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from scopemap.inspection.checks import repeated
from scopemap.inspection.frame_measures import InspectedFrame, smaller
from scopemap.inspection.inspecting import Inspection
from scopemap.report.canvas import headline, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MASK_NAME = "mask.png"
_SHOWN, _SHOWN_PX = 4, 640
_WIDTH_IN, _LINE_IN, _BANDS_IN = 13.0, 1.0, 0.22
_FIELD_COLOUR, _OVERLAY_COLOUR, _INSET_COLOUR = "#00e5ff", "#ffea00", "#ff00ff"
_MASK_TINT = np.array([0.0, 90.0, 255.0])
_LINES = (("detail", "detail"), ("brightness", "brightness"), ("motion", "motion, % of width"))
_BANDS = {
    "black": "#000000",
    "one-colour": "#777777",
    "frozen": "#b2182b",
    "duplicates": "#ef8a62",
    "blurred": "#762a83",
    "not-tissue": "#1b7837",
    "clipped": "#e6c200",
    "dark": "#2166ac",
    "highlights": "#80cdc1",
    "frames-dropped": "#8c510a",
    "time-order": "#c51b7d",
}


def draw_inspection(inspection: Inspection, file: Path) -> None:
    """Draw an inspection as a PNG.

    Above, frames of the video: field of view cyan, overlays yellow, pictures in the picture magenta. Below them, what
    the mask of a run leaves out, in blue. Then figures over time, and a band for each kind of finding.
    """
    views = _chosen(inspection.samples)
    bands = [(f.code, f.segments) for f in inspection.findings if f.segments and f.code in _BANDS]
    shapes = (views[0].rgb.shape, views[0].frame.rgb.shape)
    rows_in = [_WIDTH_IN / _SHOWN * min(height / width, 1.6) + 0.25 for height, width, _ in shapes]
    heights = [*rows_in, *[_LINE_IN] * len(_LINES), *([_BANDS_IN * len(bands) + 0.4] if bands else [])]
    figure = new_figure(_WIDTH_IN, sum(heights) + 0.6)
    grid = figure.add_gridspec(len(heights), _SHOWN, height_ratios=heights)
    for column, view in enumerate(views):
        _draw_found(figure.add_subplot(grid[0, column]), view, inspection)
        _draw_masked(figure.add_subplot(grid[1, column]), view)
    lower = [figure.add_subplot(grid[row, :]) for row in range(2, len(heights))]
    positions, again = inspection.clip["position"], np.flatnonzero(repeated(inspection.clip))
    for axes, (name, label) in zip(lower, _LINES, strict=False):
        values = inspection.clip[name] * (100 if name == "motion" else 1)
        axes.plot(positions, values, color="#404040", linewidth=1.0)
        axes.plot(positions[again], values[again], ".", color=_BANDS["duplicates"], markersize=4)
        axes.set_ylabel(label, fontsize=8)
        axes.set_ylim(bottom=0)
    if bands:
        _draw_bands(lower[-1], bands)
    for axes in lower:
        for view in views:
            axes.axvline(view.measures.position, color="#9ecae1", linewidth=0.8, zorder=0)
        axes.set_xlim(positions[0] - 0.5, positions[-1] + 0.5)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    lower[-1].set_xlabel(f"frame, counted from 0{' (orange dots: repeated)' if again.size else ''}")
    headline(figure, _title(inspection))
    figure.savefig(file)


def write_mask(inspection: Inspection, folder: Path) -> bool:
    """Write a PNG, white on overlays and pictures in the picture, for all frames; False, and nothing, without any.

    These are what a run does not find by itself. Raises `OSError` where the folder cannot be written.
    """
    boxes = [*inspection.insets, *(overlay.box for overlay in inspection.overlays if overlay.in_field)]
    if not boxes:
        return False
    width, height = inspection.size
    mask = np.zeros((height, width), np.uint8)
    for left, top, right, bottom in boxes:
        rows = slice(int(np.floor(top * height)), int(np.ceil(bottom * height)))
        mask[rows, int(np.floor(left * width)) : int(np.ceil(right * width))] = 255
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MASK_NAME).write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    return True


def _chosen(samples: tuple[InspectedFrame, ...]) -> list[InspectedFrame]:
    """Return four views, evenly spread, of those that show something where there are any."""
    shown = [view for view in samples if not view.measures.blank] or list(samples)
    places = np.unique(np.linspace(0, len(shown) - 1, _SHOWN).round().astype(int))
    return [shown[place] for place in places]


def _draw_found(axes: Axes, view: InspectedFrame, inspection: Inspection) -> None:
    from matplotlib.patches import Polygon

    picture = smaller(view.rgb, _SHOWN_PX)
    size = np.array([picture.shape[1], picture.shape[0]])
    axes.imshow(picture)
    # Polygons are drawn in pixel centres.
    if inspection.field.shape != "full":
        axes.add_patch(Polygon(inspection.field.outline * size - 0.5, fill=False, color=_FIELD_COLOUR, linewidth=1.2))
    boxes = [(one.box, _OVERLAY_COLOUR) for one in inspection.overlays]
    boxes += [(box, _INSET_COLOUR) for box in inspection.insets]
    for (left, top, right, bottom), colour in boxes:
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        axes.add_patch(Polygon(corners * size - 0.5, fill=False, color=colour, linewidth=1.4))
    axes.set_title(f"frame {view.measures.position}, {view.measures.time_s:.2f} s", fontsize=8)
    axes.set_axis_off()


def _draw_masked(axes: Axes, view: InspectedFrame) -> None:
    rgb = view.frame.rgb.astype(np.float64)
    rgb[~view.frame.valid] = 0.4 * rgb[~view.frame.valid] + 0.6 * _MASK_TINT
    axes.imshow(rgb.round().astype(np.uint8))
    axes.set_title(f"in a run: {view.measures.usable:.0%} usable", fontsize=8)
    axes.set_axis_off()


def _draw_bands(axes: Axes, bands: list[tuple[str, tuple[tuple[int, int], ...]]]) -> None:
    for row, (code, segments) in enumerate(bands):
        spans = [(first - 0.5, last - first + 1) for first, last in segments]
        axes.broken_barh(spans, (row - 0.4, 0.8), color=_BANDS[code])
    axes.set_yticks(range(len(bands)), [code for code, _ in bands], fontsize=8)
    axes.set_ylim(len(bands) - 0.5, -0.5)


def _title(inspection: Inspection) -> str:
    width, height = inspection.size
    facts = f"{inspection.path.name}: {len(inspection.clip)} pictures of {width}x{height} px"
    codes = [finding.code for finding in inspection.findings if finding.severity != "info"]
    return f"{facts}; {', '.join(dict.fromkeys(codes)) or 'nothing to warn of'}"
