"""Camera calibration with a target: views selected, outliers left out, a camera fitted, judged and written."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scopemap.calibration.intrinsics import (
    FORMS,
    Fit,
    LensForm,
    choose_form,
    fit_camera,
    held_out_error_px,
    with_deviations,
    without_outliers,
)
from scopemap.calibration.targets import Target
from scopemap.calibration.views import BoardView, LeftOut, Search, select_views, views_per_pixel
from scopemap.cameras.formats.calibration import check_plausible
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import CalibrationError, InputError

FEWEST_VIEWS = 8
_FEW_VIEWS = 12
_TILTED_DEG, _TILTED_VIEWS = 15.0, 3
_LITTLE_COVERED = 0.5
_LARGE_RMS_PX = 1.0
_UNSURE_FOCAL = 0.01


@dataclass(frozen=True)
class CameraCalibration:
    """A camera calibrated with a target, and how well.

    fit, views : the camera and the poses of the target, and the views that they were fitted to, in the input's order.
    held_out_px : error of every form tried, in views that it was not fitted to, px. left_out, blurred : views that do
    not fit, and views that are not sharp. coverage : share of the image within targets. warnings : shortcomings.
    """

    fit: Fit
    views: list[BoardView]
    held_out_px: dict[LensForm, float]
    left_out: list[LeftOut]
    blurred: list[LeftOut]
    coverage: float
    warnings: list[str]

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain numbers and texts: px, mm, degrees."""
        fit = self.fit
        rows = zip(self.views, fit.view_rms_px, tilts_deg(fit), fit.T_camera_board, strict=True)
        unused = {
            name: [{"frame": out.view.index, "name": out.view.name, "reason": out.reason} for out in views]
            for name, views in (("left_out", self.left_out), ("blurred", self.blurred))
        }
        return unused | {
            "model": fit.form.model,
            "terms": list(fit.form.terms),
            "image_size": [fit.camera.width, fit.camera.height],
            "parameters": fit.parameters,
            "deviations": fit.deviations,
            "rms_px": fit.rms_px,
            "held_out_px": {form.described: error for form, error in self.held_out_px.items()},
            "coverage": self.coverage,
            "views": [
                {
                    "frame": view.index,
                    "name": view.name,
                    "corners": len(view.corners),
                    "rms_px": float(error),
                    "tilt_deg": float(tilt),
                    "distance_mm": float(np.median(view.corners.board_mm @ pose[2, :3] + pose[2, 3])),
                }
                for view, error, tilt, pose in rows
            ],
            "warnings": self.warnings,
        }


def calibrate(
    search: Search, target: Target, model: Literal["pinhole", "fisheye", "auto"] = "auto"
) -> CameraCalibration:
    """Return the camera that took the views of `target` found by `search`.

    Of the forms of `model` (auto: of both models) the simplest is taken that predicts held-out views about as well as
    the best. Raises `InputError` for fewer than 8 views that differ and agree, `CalibrationError` where no camera
    explains them.
    """
    found, size = f"the board was found in {len(search.views)} of {search.looked_at} frames", search.size
    _check_count(search.views, found, f"looked for a {target.described}; is it this one, and whole in the picture?")
    selected, blurred = select_views(search.views, size)
    differ = f"{found}, but {len(selected)} of these views are sharp and differ"
    _check_count(selected, differ, "move the board through the picture and tilt it")
    forms = [form for form in FORMS if model in ("auto", form.model)]
    # Of each model the form with most coefficients, the last, is fitted first.
    flexible: dict[str, Fit] = {}
    for last in {form.model: form for form in forms}.values():
        with suppress(CalibrationError):
            flexible[last.model] = fit_camera(selected, size, last)
    if not flexible:
        raise CalibrationError(
            f"calibrating: no camera explains the {len(selected)} views; is the board flat and the one named?"
        )
    best = min(flexible.values(), key=lambda fit: float(np.median(fit.view_rms_px)))
    views, out = without_outliers(selected, size, best.form)
    views.sort(key=lambda view: view.index)
    agree = f"{found}, but only {len(views)} of {len(selected)} views agree"
    _check_count(views, agree, "is the board flat and the zoom untouched?")
    near = {model: fit.camera for model, fit in flexible.items()}
    errors = {form: held_out_error_px(views, size, form, near[form.model]) for form in forms if form.model in near}
    form = choose_form(errors)
    fit = with_deviations(fit_camera(views, size, form, near[form.model]), views)
    covered = float((views_per_pixel(views, size) > 0).mean())
    warnings = warnings_about(fit, covered)
    return CameraCalibration(fit, views, errors, out, blurred, covered, warnings)


def save_calibration(calibration: CameraCalibration, file: Path) -> None:
    """Write the camera to `file`, OpenCV YAML; `CalibrationError`, and no file, where no command would take it."""
    check_plausible(calibration.fit.camera, "no file was written: the fitted camera")
    write_calibration(calibration.fit.camera, file)


def tilts_deg(fit: Fit) -> np.ndarray:
    """Return the angle (V,) between each target's plane and the image's, degrees."""
    return np.degrees(np.arccos(np.clip(np.abs(fit.T_camera_board[:, 2, 2]), 0, 1)))


def warnings_about(fit: Fit, covered: float) -> list[str]:
    """Return the shortcomings of a fit; `covered` is the share of the image within targets."""
    views, tilted = len(fit.residuals_px), int(np.sum(tilts_deg(fit) > _TILTED_DEG))
    unsure = fit.deviations["fx"] / fit.camera.central.fx
    found = []
    if views < _FEW_VIEWS:
        found.append(f"only {views} views that differ: 15 to 40 are usual")
    if tilted < _TILTED_VIEWS:
        inseparable = "focal length and distance can hardly be separated; tilt it by 20 to 40 deg in several directions"
        found.append(f"the board is tilted by more than {_TILTED_DEG:g} deg in {tilted} view(s): {inseparable}")
    if covered < _LITTLE_COVERED:
        beyond = "beyond them the distortion is extrapolated; hold the board into the corners, too"
        found.append(f"the boards cover {100 * covered:.0f} % of the picture: {beyond}")
    if fit.rms_px > _LARGE_RMS_PX:
        asked = "is the board flat, the video sharp, the zoom fixed?"
        found.append(f"corners are {fit.rms_px:.2f} px off on the whole: {asked}")
    if unsure > _UNSURE_FOCAL:
        found.append(f"the focal length is known to {100 * unsure:.1f} % only: add views with the board tilted")
    return found


def _check_count(views: list[BoardView], found: str, advice: str) -> None:
    if len(views) < FEWEST_VIEWS:
        raise InputError(f"calibrating: {found}, at least {FEWEST_VIEWS} needed: {advice}")
