"""An inspection as a picture (frames, the mask of a run, a time line), and as a mask for `mask.files`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.inspection.checks import repeated
from scopemap.inspection.frame_measures import InspectedFrame, smaller
from scopemap.inspection.inspecting import Inspection
from scopemap.report.sheet import Plot, Sheet

Box = tuple[float, float, float, float]
"""Left, top, width and height, px."""

Band = tuple[str, tuple[tuple[int, int], ...]]
"""Code of a finding, and the first and last frame of each part where it was found."""

MASK_NAME = "mask.png"
_SHOWN, _SHOWN_PX = 4, 640
_WIDTH_PX, _LEFT_PX, _HEAD_PX, _LINE_PX, _BAND_PX = 1300, 110, 50, 85, 20
_LINE_COLOUR, _SHOWN_COLOUR = "#404040", "#9ecae1"
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
    cell_px = (_WIDTH_PX - _LEFT_PX) / _SHOWN
    shapes = (views[0].rgb.shape, views[0].frame.rgb.shape)
    rows_px = [cell_px * min(height / width, 1.6) + 25 for height, width, _ in shapes]
    bands_px = _BAND_PX * len(bands) + 14 * (len(bands) > 0)
    sheet = Sheet(_WIDTH_PX, _HEAD_PX + sum(rows_px) + (_LINE_PX + 14) * len(_LINES) + bands_px + 50)
    top = float(_HEAD_PX)
    for row, draw in zip(rows_px, (_draw_found, _draw_masked), strict=True):
        for column, view in enumerate(views):
            draw(sheet, (_LEFT_PX + column * cell_px, top, cell_px - 8, row), view, inspection)
        top += row
    _draw_times(sheet, top, inspection, bands, [view.measures.position for view in views])
    sheet.headline(_title(inspection))
    sheet.save(file)


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


def _draw_found(sheet: Sheet, box: Box, view: InspectedFrame, inspection: Inspection) -> None:
    left, top, width, height = sheet.picture(smaller(view.rgb, _SHOWN_PX), _below_title(box))
    corner, size = np.array([left, top]) - 0.5, np.array([width, height])
    if inspection.field.shape != "full":
        outline = np.vstack([inspection.field.outline, inspection.field.outline[:1]])
        sheet.line(corner + outline * size, _FIELD_COLOUR, 2)
    boxes = [(one.box, _OVERLAY_COLOUR) for one in inspection.overlays]
    boxes += [(box, _INSET_COLOUR) for box in inspection.insets]
    for (x0, y0, x1, y1), colour in boxes:
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        sheet.line(corner + corners * size, colour, 2)
    title = f"frame {view.measures.position}, {view.measures.time_s:.2f} s"
    sheet.text((box[0] + box[2] / 2, box[1] + 3), title, 12, anchor="ma")


def _draw_masked(sheet: Sheet, box: Box, view: InspectedFrame, inspection: Inspection) -> None:
    rgb = view.frame.rgb.astype(np.float64)
    rgb[~view.frame.valid] = 0.4 * rgb[~view.frame.valid] + 0.6 * _MASK_TINT
    sheet.picture(rgb.round().astype(np.uint8), _below_title(box))
    title = f"in a run: {view.measures.usable:.0%} usable"
    sheet.text((box[0] + box[2] / 2, box[1] + 3), title, 12, anchor="ma")


def _below_title(box: Box) -> Box:
    left, top, width, height = box
    return left, top + 20, width, height - 25


def _draw_times(sheet: Sheet, top: float, inspection: Inspection, bands: list[Band], shown: list[int]) -> None:
    """Draw the figures over time, and a band for each kind of finding, from `top` px downwards."""
    positions, again = inspection.clip["position"], np.flatnonzero(repeated(inspection.clip))
    x, width = (float(positions[0]) - 0.5, float(positions[-1]) + 0.5), _WIDTH_PX - _LEFT_PX - 10.0
    heights = [_LINE_PX] * len(_LINES) + [_BAND_PX * len(bands)] * (len(bands) > 0)
    for row, height in enumerate(heights):
        name, label = _LINES[row] if row < len(_LINES) else ("", "")
        values = np.zeros(0) if not name else inspection.clip[name] * (100 if name == "motion" else 1)
        known = values[np.isfinite(values)]
        most = 1.15 * float(known.max()) if known.size and known.max() > 0 else 1.0
        plot = Plot(sheet, (_LEFT_PX, top, width, height), x, (0.0, most) if name else (float(len(bands)), 0.0))
        last = row == len(heights) - 1
        if name:
            plot.frame(
                f"frame, counted from 0{' (orange dots: repeated)' if again.size else ''}" * last, x_numbers=last
            )
        for position in shown:
            sheet.line(plot.place(np.array([[position, plot.y[0]], [position, plot.y[1]]])), _SHOWN_COLOUR)
        if name:
            places = plot.place(np.column_stack([positions, values]))
            sheet.line(places, _LINE_COLOUR)
            sheet.dots(places[again], _BANDS["duplicates"], 2)
            sheet.text((_LEFT_PX + 6, top + 3), label, 12)
        else:
            _draw_bands(plot, bands)
            sheet.text((_LEFT_PX + width / 2, top + height + 6), "frame, counted from 0", 12, anchor="ma")
        top += height + 14


def _draw_bands(plot: Plot, bands: list[Band]) -> None:
    for row, (code, segments) in enumerate(bands):
        for first, last in segments:
            (left, top), (right, bottom) = plot.place(np.array([[first - 0.5, row + 0.1], [last + 0.5, row + 0.9]]))
            plot.sheet.fill((left, top, max(right - left, 1), bottom - top), _BANDS[code])
        middle = plot.place(np.array([[plot.x[0], row + 0.5]]))[0]
        plot.sheet.text((middle[0] - 6, middle[1]), code, 11, anchor="rm")


def _title(inspection: Inspection) -> str:
    width, height = inspection.size
    facts = f"{inspection.path.name}: {len(inspection.clip)} pictures of {width}x{height} px"
    codes = [finding.code for finding in inspection.findings if finding.severity != "info"]
    return f"{facts}; {', '.join(dict.fromkeys(codes)) or 'nothing to warn of'}"
