"""The picture of a calibration: all residuals over the image, and the error of each view."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scopemap.calibration.camera_calibration import CameraCalibration
from scopemap.calibration.views import views_per_pixel
from scopemap.errors import InputError
from scopemap.report.canvas import headline, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# The longer residuals are drawn this share of the picture's width long.
_DRAWN_SHARE = 0.04
_LONGER_PERCENT = 95


def draw_calibration(calibration: CameraCalibration, file: Path) -> None:
    """Draw how well `calibration` explains its views into `file`, a PNG; `InputError` where it cannot be written."""
    # Imported here, so that importing the package stays fast.
    from matplotlib import colormaps

    colours = colormaps["turbo"](np.linspace(0.05, 0.95, len(calibration.views)))
    figure = new_figure(11, 5)
    residuals, bars = figure.subplots(1, 2, width_ratios=(1.15, 1))
    _draw_residuals(residuals, calibration, colours)
    _draw_errors(bars, calibration, colours)
    central = calibration.fit.camera.central
    headline(
        figure,
        f"{calibration.fit.form.described}: fx {central.fx:.1f}, fy {central.fy:.1f}, cx {central.cx:.1f}, "
        f"cy {central.cy:.1f} px; reprojection error {calibration.fit.rms_px:.3f} px RMS",
    )
    try:
        figure.savefig(file)
    except OSError as error:
        raise InputError(f"drawing the calibration into {file}: {error}") from None


def _draw_residuals(axes: Axes, calibration: CameraCalibration, colours: np.ndarray) -> None:
    width, height = calibration.fit.camera.width, calibration.fit.camera.height
    count = views_per_pixel(calibration.views, (width, height))
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    shown = axes.imshow(count, cmap="Greys", vmin=0, vmax=max(2 * int(count.max()), 1), extent=extent)
    axes.figure.colorbar(shown, ax=axes, shrink=0.7, label="views")
    lengths = np.linalg.norm(np.concatenate(calibration.fit.residuals_px), axis=1)
    longer = max(float(np.percentile(lengths, _LONGER_PERCENT)), 1e-9)
    magnified = _DRAWN_SHARE * width / longer
    for view, residual, colour in zip(calibration.views, calibration.fit.residuals_px, colours, strict=True):
        arrows = (*view.corners.pixels.T, *residual.T * magnified)
        axes.quiver(*arrows, color=colour, angles="xy", scale_units="xy", scale=1, width=0.0025)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_title(
        f"residuals, {magnified:.0f} times as long; boards cover {100 * calibration.coverage:.0f} %", fontsize=10
    )


def _draw_errors(axes: Axes, calibration: CameraCalibration, colours: np.ndarray) -> None:
    places = range(len(calibration.views))
    axes.bar(places, calibration.fit.view_rms_px, color=colours)
    axes.axhline(calibration.fit.rms_px, color="black", linestyle="--", linewidth=1)
    axes.set_xticks(places, [str(view.index) for view in calibration.views], rotation=90, fontsize=7)
    axes.set_xlabel("frame")
    axes.set_ylabel("reprojection error, px RMS")
    unused = f"{len(calibration.blurred)} blurred, {len(calibration.left_out)} unfit"
    axes.set_title(f"{len(places)} views used, {unused}; dashed: all", fontsize=10)
