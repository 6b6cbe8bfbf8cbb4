"""An inspection as a picture (frames, the mask of a run, a time line), and as a mask for `mask.files`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.apps.inspect.frame_measures import InspectedFrame
from scopemap.apps.inspect.inspecting import Inspection
from scopemap.report.frame_pictures import shrunk
from scopemap.report.sheet import Plot, Sheet

Box = tuple[float, float, float, float]
"""Left, top, width and height, px."""

MASK_NAME = "mask.png"
_SHOWN = 4
_SHOWN_PX = 640
_WIDTH_PX = 1300
_LEFT_PX = 110
_HEAD_PX = 50
_LINE_PX = 85
_BAND_PX = 20
_GAP_PX = 14
_LINE_COLOUR = "#404040"
_SHOWN_COLOUR = "#9ecae1"
_FIELD_COLOUR = "#00e5ff"
_OVERLAY_COLOUR = "#ffea00"
_INSET_COLOUR = "#ff00ff"
_MASK_TINT = np.array([0.0, 90.0, 255.0])
_LINES = (("sharpness", "sharpness", 1), ("brightness", "brightness", 1), ("motion", "motion, % of width", 100))
_BANDS = {
    "black": "#000000",
    "one-colour": "#777777",
    "frozen": "#b2182b",
    "duplicates": "#ef8a62",
    "blurred": "#762a83",
    "not-tissue": "#1b7837",
}


def draw_inspection(inspection: Inspection, file: Path) -> None:
    """Draw an inspection as a PNG.

    Above, frames of the video: field of view cyan, overlays yellow, pictures in the picture magenta. Below them, what
    the mask of a run leaves out, in blue. Then figures over time, and a band for each kind of finding.
    """
    # Four views, evenly spread, of those that show something where there are any.
    shown = [view for view in inspection.samples if not view.measures.blank] or list(inspection.samples)
    views = [shown[n] for n in np.unique(np.linspace(0, len(shown) - 1, _SHOWN).round().astype(int))]
    bands = sum(finding.code in _BANDS for finding in inspection.findings if finding.segments)
    cell_px = (_WIDTH_PX - _LEFT_PX) / _SHOWN
    rows_px = [cell_px * min(rgb.shape[0] / rgb.shape[1], 1.6) + 25 for rgb in (views[0].rgb, views[0].frame.rgb)]
    bands_px = _BAND_PX * bands + _GAP_PX * (bands > 0)
    sheet = Sheet(_WIDTH_PX, _HEAD_PX + sum(rows_px) + (_LINE_PX + _GAP_PX) * len(_LINES) + bands_px + 50)
    top = float(_HEAD_PX)
    for row, draw in zip(rows_px, (_draw_found, _draw_masked), strict=True):
        for column, view in enumerate(views):
            left = _LEFT_PX + column * cell_px
            title = draw(sheet, (left, top + 20, cell_px - 8, row - 25), view, inspection)
            sheet.text((left + (cell_px - 8) / 2, top + 3), title, 12, anchor="ma")
        top += row
    _draw_times(sheet, top, inspection, [view.measures.position for view in views])
    width, height = inspection.size
    codes = [finding.code for finding in inspection.findings if finding.severity != "info"]
    facts = f"{inspection.path.name}: {inspection.clip.count} pictures of {width}x{height} px"
    sheet.headline(f"{facts}; {', '.join(dict.fromkeys(codes)) or 'nothing to warn of'}")
    sheet.save(file)


def write_mask(inspection: Inspection, folder: Path) -> bool:
    """Write a PNG, white on overlays and pictures in the picture, for all frames; return whether there are any.

    These are what a run does not find by itself. Without any the mask is black: a run that reads it leaves nothing out.
    Raises `OSError` where the folder cannot be written.
    """
    boxes = [*inspection.insets, *(overlay.box for overlay in inspection.overlays if overlay.in_field)]
    width, height = inspection.size
    mask = np.zeros((height, width), np.uint8)
    for left, top, right, bottom in boxes:
        rows = slice(int(np.floor(top * height)), int(np.ceil(bottom * height)))
        mask[rows, int(np.floor(left * width)) : int(np.ceil(right * width))] = 255
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MASK_NAME).write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    return bool(boxes)


def _draw_found(sheet: Sheet, box: Box, view: InspectedFrame, inspection: Inspection) -> str:
    """Draw a frame of the video with what was found in it, and return its title."""
    left, top, width, height = sheet.picture(shrunk(view.rgb, _SHOWN_PX), box)
    corner, size = np.array([left, top]) - 0.5, np.array([width, height])
    if inspection.field.shape != "full":
        outline = np.vstack([inspection.field.outline, inspection.field.outline[:1]])
        sheet.line(corner + outline * size, _FIELD_COLOUR, 2)
    boxes = [(one.box, _OVERLAY_COLOUR) for one in inspection.overlays]
    boxes += [(inset, _INSET_COLOUR) for inset in inspection.insets]
    for (x0, y0, x1, y1), colour in boxes:
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        sheet.line(corner + corners * size, colour, 2)
    return f"frame {view.measures.position}, {view.measures.time_s:.2f} s"


def _draw_masked(sheet: Sheet, box: Box, view: InspectedFrame, inspection: Inspection) -> str:
    """Draw a frame as a run sees it, and return its title."""
    rgb = view.frame.rgb.astype(np.float64)
    rgb[~view.frame.valid] = 0.4 * rgb[~view.frame.valid] + 0.6 * _MASK_TINT
    sheet.picture(rgb.round().astype(np.uint8), box)
    return f"in a run: {view.measures.usable:.0%} usable"


def _draw_times(sheet: Sheet, top: float, inspection: Inspection, shown: list[int]) -> None:
    """Draw the figures over time, and a band for each kind of finding, from `top` px downwards; mark frames `shown`."""
    clip = inspection.clip
    positions, again = clip["position"], np.flatnonzero(clip.repeats)
    bands = [finding for finding in inspection.findings if finding.segments and finding.code in _BANDS]
    x, width = (float(positions[0]) - 0.5, float(positions[-1]) + 0.5), _WIDTH_PX - _LEFT_PX - 10.0

    def marked(height: float, y: tuple[float, float], label: str = "") -> Plot:
        plot = Plot(sheet, (_LEFT_PX, top, width, height), x, y)
        if y[0] < y[1]:
            plot.frame(label, x_numbers=bool(label))
        for position in shown:
            sheet.line(plot.place(np.array([[position, y[0]], [position, y[1]]])), _SHOWN_COLOUR)
        return plot

    for row, (name, words, factor) in enumerate(_LINES, 1):
        values = clip[name] * factor
        known = values[np.isfinite(values)]
        most = 1.15 * float(known.max()) if known.size and known.max() > 0 else 1.0
        label = f"frame, counted from 0{' (orange dots: repeated)' if again.size else ''}"
        plot = marked(_LINE_PX, (0.0, most), label * (row == len(_LINES) and not bands))
        places = plot.place(np.column_stack([positions, values]))
        for part in np.unique(clip["part"]):
            sheet.line(places[clip["part"] == part], _LINE_COLOUR)
        sheet.dots(places[again], _BANDS["duplicates"], 2)
        sheet.text((_LEFT_PX + 6, top + 3), words, 12)
        top += _LINE_PX + _GAP_PX
    if not bands:
        return
    plot = marked(_BAND_PX * len(bands), (float(len(bands)), 0.0))
    for row, band in enumerate(bands):
        for first, last in band.segments:
            (left, upper), (right, lower) = plot.place(np.array([[first - 0.5, row + 0.1], [last + 0.5, row + 0.9]]))
            sheet.fill((left, upper, max(right - left, 1), lower - upper), _BANDS[band.code])
        sheet.text((_LEFT_PX - 6, top + _BAND_PX * (row + 0.5)), band.code, 11, anchor="rm")
    sheet.text((_LEFT_PX + width / 2, top + _BAND_PX * len(bands) + 6), "frame, counted from 0", 12, anchor="ma")
