"""Camera calibration with a target, pinhole (Zhang 2000) or fisheye, by OpenCV's fits and errors in held-out views."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from scopemap.apps.calibrate.targets import (
    Corners,
    DetectedBoard,
    LeftOut,
    Search,
    Target,
    select_views,
    views_per_pixel,
)
from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.engine.geometry.least_squares import robust_sigma_2d
from scopemap.engine.geometry.se3 import se3, transform
from scopemap.input.camera_files.calibration import check_plausible
from scopemap.input.camera_files.writing import write_calibration

_TERMS = {"pinhole": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
_FIX = {"k1": cv2.CALIB_FIX_K1, "k2": cv2.CALIB_FIX_K2, "k3": cv2.CALIB_FIX_K3, "p1": cv2.CALIB_ZERO_TANGENT_DIST}
# OpenCV 4 has the flags of fisheye lenses by themselves, OpenCV 5 with the others.
_OF_FISHEYE: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_K1") else cv2
_FIX_FISHEYE = {f"k{k}": getattr(_OF_FISHEYE, f"CALIB_FIX_K{k}") for k in (1, 2, 3, 4)}
_FISHEYE_FLAGS = _OF_FISHEYE.CALIB_RECOMPUTE_EXTRINSIC | _OF_FISHEYE.CALIB_FIX_SKEW
_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-8)
# Focal lengths over the width from which fits start beside OpenCV's own guess, which strong distortion misleads.
_FOCAL_GUESSES = (0.5, 0.9)
_RESAMPLES = 20
_FOLDS = 5
# A form with more coefficients, or the fisheye, has to predict better by this share.
_WORTH_IT = 0.02
# A view does not fit where no larger share of its corners do.
_LEAST_AGREEING = 0.5
_MOST_OUTLIERS = 1 / 3
# Corners farther off than 5 standard deviations do not fit; by chance so is one in 300,000.
_STRAY_SIGMAS = 5.0
_STRAY_PX = 0.25
_FEWEST_CORNERS = 6


@dataclass(frozen=True)
class LensForm:
    """A camera model and its coefficients that are not held at zero, such as ("k1", "k2")."""

    model: Literal["pinhole", "fisheye"]
    terms: tuple[str, ...]

    @property
    def described(self) -> str:
        """The form in a few words."""
        return f"{self.model} with {' '.join(self.terms)}" if self.terms else f"{self.model} without distortion"


FORMS = (
    *(LensForm("pinhole", _TERMS["pinhole"][:count]) for count in (0, 1, 2, 4, 5)),
    *(LensForm("fisheye", _TERMS["fisheye"][:count]) for count in (1, 2, 4)),
)
"""The forms that are fitted, of each model the simpler first."""


@dataclass(frozen=True)
class Fit:
    """A camera, and the poses of the target in its views.

    form : the free coefficients. T_camera_board : (V, 4, 4), mm. residuals_px : V arrays (N, 2), seen minus projected,
    NaN beyond the lens' field. deviations : standard deviations of fx, fy, cx, cy (px) and `form`; or empty.
    """

    form: LensForm
    camera: CameraModel
    T_camera_board: np.ndarray
    residuals_px: tuple[np.ndarray, ...]
    deviations: dict[str, float]

    @property
    def view_rms_px(self) -> np.ndarray:
        """(V,) root mean square distance of seen from projected corners, px; inf beyond the field of the lens."""
        return np.array([_rms(residual) for residual in self.residuals_px])

    @property
    def rms_px(self) -> float:
        """The same over all corners of all views."""
        return _rms(np.concatenate(self.residuals_px))

    @property
    def parameters(self) -> dict[str, float]:
        """Focal lengths, principal point (px) and free coefficients by name."""
        central, coefficients = self.camera.central, getattr(self.camera, "distortion", ())
        known = {name: getattr(central, name) for name in ("fx", "fy", "cx", "cy")}
        known |= dict(zip(_TERMS[self.form.model], coefficients, strict=False))
        return {name: float(known[name]) for name in ("fx", "fy", "cx", "cy", *self.form.terms)}


def fit_camera(
    views: list[DetectedBoard], size: tuple[int, int], form: LensForm, near: CameraModel | None = None
) -> Fit:
    """Return the camera of `form` with the smallest reprojection error, from `near` or several starts."""
    w, h = size
    starts: list[PinholeCamera | None] = [near.central] if near is not None else []
    if near is None:
        starts += [PinholeCamera(f * w, f * w, (w - 1) / 2, (h - 1) / 2, w, h) for f in _FOCAL_GUESSES]
        if form.model == "pinhole":
            starts.append(None)
        elif simple := _attempt(views, size, LensForm("pinhole", ("k1", "k2")), None):
            starts.append(simple.camera.central)
    fits = [_attempt(views, size, form, start) for start in starts]
    best = min((fit for fit in fits if fit is not None), key=lambda fit: fit.rms_px, default=None)
    if best is None:
        raise CalibrationError(
            f"fitting the camera ({form.described}) to {len(views)} views of the board failed: give views in which the "
            "board is tilted by 20 to 40 deg in different directions"
        )
    return best


def with_deviations(fit: Fit, views: list[DetectedBoard]) -> Fit:
    """Return `fit` with standard deviations by the bootstrap (Efron 1979): fits to resampled views, 20 of them."""
    size, rng = (fit.camera.width, fit.camera.height), np.random.default_rng(0)
    drawn = [[views[i] for i in rng.integers(0, len(views), len(views))] for _ in range(_RESAMPLES)]
    fits = [_attempt(some, size, fit.form, fit.camera.central) for some in drawn]
    rows = [list(again.parameters.values()) for again in fits if again is not None]
    spread = np.std(rows, axis=0, ddof=1) if len(rows) > 2 else np.full(len(fit.parameters), np.inf)
    return replace(fit, deviations=dict(zip(fit.parameters, map(float, spread), strict=True)))


def choose_form(errors_px: dict[LensForm, float]) -> LensForm:
    """Return the simplest form that predicts about as well as the best, by held-out errors, px; `CalibrationError`."""
    best: LensForm | None = None
    for form, error_px in errors_px.items():
        if np.isfinite(error_px) and (best is None or error_px < (1 - _WORTH_IT) * errors_px[best]):
            best = form
    if best is None:
        raise CalibrationError(
            "fitting the camera: no model predicts views that it was not fitted to; is the board flat and the one "
            "named, and the lens the same in all frames (no zoom)?"
        )
    return best


def held_out_error_px(views: list[DetectedBoard], size: tuple[int, int], form: LensForm, near: CameraModel) -> float:
    """Return the RMS reprojection error, px, in views that the form was not fitted to (5 folds); inf: a fit failed."""
    try:
        fit = fit_camera(views, size, form, near)
        residuals = []
        for fold in range(_FOLDS if np.isfinite(fit.rms_px) else 0):
            kept = [view for place, view in enumerate(views) if place % _FOLDS != fold]
            camera = fit_camera(kept, size, form, near=fit.camera).camera
            held_out = zip(views[fold::_FOLDS], fit.T_camera_board[fold::_FOLDS], strict=True)
            residuals += [_resected(camera, view.corners, pose) for view, pose in held_out]
        return _rms(np.concatenate(residuals)) if residuals else np.inf
    except CalibrationError:
        return np.inf


def without_outliers(
    views: list[DetectedBoard], size: tuple[int, int], form: LensForm
) -> tuple[list[DetectedBoard], list[LeftOut]]:
    """Return the views that agree on a camera of `form`, without stray corners, and the others: a third at most."""
    kept, out = list(views), list[LeftOut]()
    while True:
        fit = fit_camera(kept, size, form)
        lengths = [_lengths(residual) for residual in fit.residuals_px]
        limit = max(_STRAY_SIGMAS * robust_sigma_2d(np.concatenate(lengths)), _STRAY_PX)
        agree = [length <= limit for length in lengths]
        worst = min(range(len(kept)), key=lambda i: (agree[i].mean() > _LEAST_AGREEING, -fit.view_rms_px[i]))
        if agree[worst].mean() > _LEAST_AGREEING or len(out) >= _MOST_OUTLIERS * len(views):
            break
        error, usual = fit.view_rms_px[worst], float(np.median(fit.view_rms_px))
        out.append(LeftOut(kept.pop(worst), f"it does not fit: {error:.2f} px off, the others {usual:.2f} px"))
    kept = [replace(view, corners=view.corners.where(close)) for view, close in zip(kept, agree, strict=True)]
    return [view for view in kept if len(view.corners) >= _FEWEST_CORNERS], out


def _attempt(
    views: list[DetectedBoard], size: tuple[int, int], form: LensForm, start: PinholeCamera | None
) -> Fit | None:
    """Return OpenCV's fit from `start`, None: its own guess; None where it fails."""
    # Rows, not columns: OpenCV 5 fits no fisheye to columns.
    boards = [view.corners.board_mm.astype(np.float32)[None] for view in views]
    pixels = [view.corners.pixels.astype(np.float32)[None] for view in views]
    matrix, is_fisheye = np.eye(3) if start is None else start.matrix, form.model == "fisheye"
    flags = sum(flag for term, flag in (_FIX_FISHEYE if is_fisheye else _FIX).items() if term not in form.terms)
    try:
        if is_fisheye:
            flags |= _FISHEYE_FLAGS | _OF_FISHEYE.CALIB_USE_INTRINSIC_GUESS
            found = cv2.fisheye.calibrate(boards, pixels, size, matrix, np.zeros((4, 1)), flags=flags, criteria=_STEPS)
        else:
            flags |= 0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS
            found = cv2.calibrateCamera(boards, pixels, size, matrix, np.zeros(5), flags=flags, criteria=_STEPS)
    except cv2.error:  # degenerate views
        return None
    matrix, terms = np.asarray(found[1]), tuple(map(float, np.ravel(found[2])[: len(_TERMS[form.model])]))
    if not (np.isfinite(matrix).all() and np.isfinite(terms).all() and min(matrix[0, 0], matrix[1, 1]) > 0):
        return None
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    pinhole = PinholeCamera(fx, fy, cx, cy, *size)
    camera: CameraModel = FisheyeCamera(pinhole, terms) if is_fisheye else OpenCvCamera(pinhole, terms)
    camera = camera if form.terms else pinhole
    poses = np.stack([se3(cv2.Rodrigues(r)[0], np.ravel(t)) for r, t in zip(found[3], found[4], strict=True)])
    residuals = tuple(
        view.corners.pixels - camera.project(transform(pose, view.corners.board_mm))
        for view, pose in zip(views, poses, strict=True)
    )
    return Fit(form, camera, poses, residuals, {})


def _resected(camera: CameraModel, corners: Corners, T_camera_board: np.ndarray) -> np.ndarray:
    """Return corners seen minus projected (N, 2), px, for the refined pose; NaN beyond the lens' field."""
    rays = camera.unproject(corners.pixels)
    seen = np.isfinite(rays).all(axis=1)
    # A column: OpenCV 5 starts elsewhere from a flat translation.
    rotation, translation = cv2.Rodrigues(T_camera_board[:3, :3])[0], T_camera_board[:3, 3:].copy()
    if seen.sum() >= _FEWEST_CORNERS:
        board, plane = corners.board_mm[seen], rays[seen, :2]
        rotation, translation = cv2.solvePnPRefineLM(board, plane, np.eye(3), None, rotation, translation)
    pose = se3(cv2.Rodrigues(rotation)[0], np.ravel(translation))
    return corners.pixels - camera.project(transform(pose, corners.board_mm))


def _lengths(residual_px: np.ndarray) -> np.ndarray:
    return np.nan_to_num(np.linalg.norm(residual_px, axis=1), nan=np.inf)


def _rms(residual_px: np.ndarray) -> float:
    return float(np.sqrt(np.mean(_lengths(residual_px) ** 2)))


FEWEST_VIEWS = 8
_FEW_VIEWS = 12
_TILTED_DEG = 15.0
_TILTED_VIEWS = 3
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
    views: list[DetectedBoard]
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
        inseparable = "so focal length and distance cannot be separated; tilt it by 20 to 40 deg in several directions"
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


def _check_count(views: list[DetectedBoard], found: str, advice: str) -> None:
    if len(views) < FEWEST_VIEWS:
        raise InputError(f"calibrating: {found}, at least {FEWEST_VIEWS} needed: {advice}")
