"""From frames with a board in them to a calibrated camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scopemap.calibration.choosing import FORMS, chosen, held_out_error_px
from scopemap.calibration.diagnosis import what_is_seen_instead
from scopemap.calibration.fitting import Fit, LensForm, fit_camera, with_bootstrap
from scopemap.calibration.judging import tilts_deg, warnings_about
from scopemap.calibration.outliers import agreeing
from scopemap.calibration.selection import LeftOut, coverage, select_views
from scopemap.calibration.targets import Board
from scopemap.calibration.views import Search, View
from scopemap.cameras.formats.reading import read_calibration
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import CalibrationError, InputError

FEWEST_VIEWS = 8


@dataclass(frozen=True)
class BoardCalibration:
    """A camera calibrated with a board, and how well.

    Attributes
    ----------
    fit : the camera, and the boards as it sees them. views : those that it was fitted to, in the input's order.
    held_out_px : error of every form tried, in those of `views` that it was not fitted to, px.
    left_out : views that do not fit. blurred : views that are blurred.
    alike : number of views that were not used because another one shows the same.
    coverage : share of the picture within boards.
    warnings : what is left open.
    """

    fit: Fit
    views: list[View]
    held_out_px: dict[LensForm, float]
    left_out: list[LeftOut]
    blurred: list[LeftOut]
    alike: int
    coverage: float
    warnings: list[str]

    @property
    def stray_corners(self) -> int:
        """How many corners of the views were left out, as they do not fit."""
        return sum(len(view.found.pixels) - len(view.corners.pixels) for view in self.views)

    @property
    def example(self) -> View:
        """The view with most corners found, of these the largest: to be shown."""
        return max(self.views, key=lambda view: (len(view.found.pixels), float(np.prod(np.ptp(view.found.pixels, 0)))))

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain numbers and texts: px, mm, degrees."""
        fit, tilts = self.fit, tilts_deg(self.fit)
        rows = zip(self.views, fit.view_rms_px, tilts, fit.T_camera_board, strict=True)
        return {
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
                    "corners": len(view.corners.pixels),
                    "rms_px": float(error),
                    "tilt_deg": float(tilt),
                    "distance_mm": float(np.median(view.corners.board_mm @ pose[2, :3] + pose[2, 3])),
                }
                for view, error, tilt, pose in rows
            ],
            "left_out": [_told(out) for out in self.left_out],
            "blurred": [_told(out) for out in self.blurred],
            "alike": self.alike,
            "stray_corners": self.stray_corners,
            "warnings": self.warnings,
        }


def calibrate(
    search: Search, board: Board, model: Literal["pinhole", "fisheye", "auto"] = "auto", pixel_aspect: float = 1.0
) -> BoardCalibration:
    """Return the camera that took the views of `board` found by `search`.

    Of the forms of `model` (auto: of both models) the simplest counts that predicts held-out views about as well as
    the best. `pixel_aspect` is what the input says of its pixels, width over height. Raises `InputError` for fewer than
    8 views that differ and agree, `CalibrationError` where no camera explains them.
    """
    found, size = len(search.views), search.size
    seen = f"the board was found in {found} of {search.looked_at} frames"
    if found < FEWEST_VIEWS:
        instead = what_is_seen_instead(board, search.without)
        raise _too_few(seen, instead or f"looked for a {board.described}")
    selected = select_views(search.views, size)
    if len(selected.views) < FEWEST_VIEWS:
        differ = f"but {len(selected.views)} of these views are sharp and differ"
        raise _too_few(f"{seen}, {differ}", "move the board through the picture and tilt it")
    forms = [form for form in FORMS if model in ("auto", form.model)]
    form = _flexible(selected.views, size, forms)
    views, out = agreeing(selected.views, size, form)
    views.sort(key=lambda view: view.index)
    errors = _held_out(views, size, forms)
    agreed, more = agreeing(views, size, chosen(errors))
    if _corners(agreed) < _corners(views) and len(agreed) >= FEWEST_VIEWS:
        errors = _held_out(agreed, size, forms)  # what is reported is of the views and corners that are used
    views, form = agreed, chosen(errors)
    out += more
    if len(views) < FEWEST_VIEWS:
        worst = out[0]
        raise _too_few(
            f"{seen}, but only {len(views)} of {len(selected.views)} views agree",
            f"frame {worst.view.index}: {worst.reason}; is the plate flat and the zoom untouched?",
        )
    fit = with_bootstrap(fit_camera(views, size, form), views)
    covered = coverage(views, size)
    warnings = warnings_about(fit, covered, pixel_aspect)
    return BoardCalibration(fit, views, errors, out, selected.blurred, selected.alike, covered, warnings)


def save_calibration(calibration: BoardCalibration, file: Path) -> None:
    """Write the camera to `file`, OpenCV YAML; raises `CalibrationError`, and writes none, where it could not be read.

    An earlier file is replaced.
    """
    camera = calibration.fit.camera
    unproven = file.with_name(f".{file.stem}.unproven{file.suffix}")
    try:
        write_calibration(camera, unproven)
        read_calibration(unproven, (camera.width, camera.height))
        unproven.replace(file)
    except CalibrationError as error:
        raise CalibrationError(
            f"the views lead to a camera that cannot be used, so none was written: {error}"
        ) from None
    except OSError as error:
        raise CalibrationError(f"cannot write the calibration to {file}: {error}") from None
    finally:
        unproven.unlink(missing_ok=True)


def _told(out: LeftOut) -> dict[str, Any]:
    return {"frame": out.view.index, "name": out.view.name, "reason": out.reason}


def _too_few(found: str, advice: str) -> InputError:
    return InputError(f"calibrating: {found}, at least {FEWEST_VIEWS} needed: {advice}")


def _flexible(views: list[View], size: tuple[int, int], forms: list[LensForm]) -> LensForm:
    """Return the form, of those with most coefficients, that most views fit best: to see which do not."""
    last = {form.model: form for form in forms}
    fits = []
    for form in last.values():
        try:
            fits.append(fit_camera(views, size, form))
        except CalibrationError:
            continue
    if not fits:
        raise CalibrationError(
            f"calibrating: no camera explains the {len(views)} views; is the plate flat, the board the one named?"
        )
    return min(fits, key=lambda fit: float(np.median(fit.view_rms_px))).form


def _corners(views: list[View]) -> int:
    return sum(len(view.corners.pixels) for view in views)


def _held_out(views: list[View], size: tuple[int, int], forms: list[LensForm]) -> dict[LensForm, float]:
    errors = {}
    for form in forms:
        try:
            errors[form] = held_out_error_px(views, fit_camera(views, size, form))
        except CalibrationError:
            errors[form] = np.inf
    return errors
