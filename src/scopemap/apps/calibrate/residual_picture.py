"""The picture of a calibration: all residuals over the image, and the error of each view."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.apps.calibrate.camera_calibration import CameraCalibration
from scopemap.apps.calibrate.targets import views_per_pixel
from scopemap.engine.errors import InputError
from scopemap.report.sheet import INK, Plot, Sheet

_SHEET_PX = (1100, 500)
_RESIDUALS_PX = (45.0, 70.0, 560.0, 400.0)  # left, top, width, height
_ERRORS_PX = (665.0, 70.0, 415.0, 370.0)
_MOST_NUMBERS = 14
# The longer residuals are drawn this share of the picture's width long.
_DRAWN_SHARE = 0.04
_LONGER_PERCENT = 95


def draw_calibration(calibration: CameraCalibration, file: Path) -> None:
    """Draw how well `calibration` explains its views into `file`, a PNG; `InputError` where it cannot be written."""
    levels = np.linspace(12, 243, len(calibration.views)).astype(np.uint8)
    colours = [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0]]
    sheet = Sheet(*_SHEET_PX)
    _draw_residuals(sheet, calibration, colours)
    _draw_errors(sheet, calibration, colours)
    central = calibration.fit.camera.central
    sheet.headline(
        f"{calibration.fit.form.described}: fx {central.fx:.1f}, fy {central.fy:.1f}, cx {central.cx:.1f}, "
        f"cy {central.cy:.1f} px; reprojection error {calibration.fit.rms_px:.3f} px RMS"
    )
    try:
        sheet.save(file)
    except OSError as error:
        raise InputError(f"drawing the calibration into {file}: {error}") from None


def _draw_residuals(sheet: Sheet, calibration: CameraCalibration, colours: list[str]) -> None:
    width, height = calibration.fit.camera.width, calibration.fit.camera.height
    count = views_per_pixel(calibration.views, (width, height))
    most = int(count.max())
    grey = np.round(255 - 255 * count / max(2 * most, 1)).astype(np.uint8)
    scale = min(_RESIDUALS_PX[2] / width, _RESIDUALS_PX[3] / height)
    inside = (*_RESIDUALS_PX[:2], scale * width, scale * height)
    plot = Plot(sheet, inside, (-0.5, width - 0.5), (height - 0.5, -0.5))
    plot.frame()
    sheet.picture(np.repeat(grey[..., None], 3, -1), inside)
    lengths = np.linalg.norm(np.concatenate(calibration.fit.residuals_px), axis=1)
    longer = max(float(np.percentile(lengths, _LONGER_PERCENT)), 1e-9)
    magnified = _DRAWN_SHARE * width / longer
    for view, residuals, colour in zip(calibration.views, calibration.fit.residuals_px, colours, strict=True):
        ends = plot.place(view.corners.pixels + magnified * residuals)
        for first, last in zip(plot.place(view.corners.pixels), ends, strict=True):
            sheet.line(np.stack([first, last]), colour, 1)
        sheet.dots(ends, colour, 1.5)
    covered = f"boards cover {100 * calibration.coverage:.0f} %, white 0 to grey {most} views"
    title = f"residuals (dot: end), {magnified:.0f} times as long; {covered}"
    sheet.text((_RESIDUALS_PX[0], _RESIDUALS_PX[1] - 20), title, 12)


def _draw_errors(sheet: Sheet, calibration: CameraCalibration, colours: list[str]) -> None:
    errors = np.asarray(calibration.fit.view_rms_px)
    plot = Plot(sheet, _ERRORS_PX, (-0.5, len(errors) - 0.5), (0.0, 1.1 * max(float(errors.max()), 1e-9)))
    plot.frame("", "reprojection error, px RMS", x_numbers=False)
    sheet.text((_ERRORS_PX[0] + _ERRORS_PX[2] / 2, _ERRORS_PX[1] + _ERRORS_PX[3] + 26), "frame", 12, anchor="ma")
    every = -(-len(errors) // _MOST_NUMBERS)
    for number, (view, error, colour) in enumerate(zip(calibration.views, errors, colours, strict=True)):
        (left, top), (right, bottom) = plot.place(np.array([[number - 0.4, error], [number + 0.4, 0.0]]))
        sheet.fill((left, top, max(right - left, 1), bottom - top), colour)
        if number % every == 0:
            sheet.text(((left + right) / 2, bottom + 6), str(view.index), 10, anchor="ma")
    for start in np.arange(-0.5, len(errors) - 0.5, len(errors) / 40):
        ends = np.array([[start, calibration.fit.rms_px], [start + len(errors) / 80, calibration.fit.rms_px]])
        sheet.line(plot.place(ends), INK)
    unused = f"{len(calibration.blurred)} blurred, {len(calibration.left_out)} unfit"
    title = f"{len(errors)} views used, {unused}; dashed: all"
    sheet.text((_ERRORS_PX[0], _ERRORS_PX[1] - 20), title, 12)
