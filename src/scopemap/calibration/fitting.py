"""A camera fitted to views of a board: OpenCV's calibrations, pinhole with distortion (Zhang 2000) and fisheye."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from scopemap.calibration.views import View
from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.errors import CalibrationError
from scopemap.geometry.se3 import transform

ModelName = Literal["pinhole", "fisheye"]
_FIX = {"k1": cv2.CALIB_FIX_K1, "k2": cv2.CALIB_FIX_K2, "k3": cv2.CALIB_FIX_K3, "p1": cv2.CALIB_ZERO_TANGENT_DIST}
_FIX_FISHEYE = {f"k{k}": getattr(cv2.fisheye, f"CALIB_FIX_K{k}") for k in (1, 2, 3, 4)}
_STEPS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-8)
# Focal lengths over the width from which fits start beside OpenCV's own guess, which strong distortion misleads.
_FOCAL_GUESSES = (0.5, 0.9)
_RESAMPLES = 20
_INTRINSICS = ("fx", "fy", "cx", "cy")
_TERMS = {"pinhole": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}


@dataclass(frozen=True)
class LensForm:
    """A camera model and its coefficients that are not held at zero, such as ("k1", "k2")."""

    model: ModelName
    terms: tuple[str, ...]

    @property
    def described(self) -> str:
        """The form in a few words."""
        return f"{self.model} with {' '.join(self.terms)}" if self.terms else f"{self.model} without distortion"


@dataclass(frozen=True)
class Fit:
    """A camera, and the boards as it sees them.

    Attributes
    ----------
    form : what was free.
    T_camera_board : (V, 4, 4), mm, of the V views, in their order.
    residuals_px : V arrays (N, 2), corner seen minus corner projected; NaN beyond the field of the lens.
    deviations : standard deviations of fx, fy, cx, cy (px) and the free coefficients; empty before `with_bootstrap`.
    """

    form: LensForm
    camera: CameraModel
    T_camera_board: np.ndarray
    residuals_px: tuple[np.ndarray, ...]
    deviations: dict[str, float]

    @property
    def view_rms_px(self) -> np.ndarray:
        """(V,) root mean square of the distances between seen and projected corners, px; inf beyond the field."""
        squares = [np.mean(np.sum(residual**2, axis=1)) for residual in self.residuals_px]
        return np.nan_to_num(np.sqrt(squares), nan=np.inf)

    @property
    def rms_px(self) -> float:
        """The same over all corners of all views."""
        return rms(self.residuals_px)

    @property
    def parameters(self) -> dict[str, float]:
        """Focal lengths, principal point (px) and free coefficients by name."""
        central, order = self.camera.central, _TERMS[self.form.model]
        coefficients = self.camera.distortion if isinstance(self.camera, FisheyeCamera | OpenCvCamera) else ()
        known = dict(zip(order, coefficients, strict=False))
        values = {name: float(getattr(central, name)) for name in _INTRINSICS}
        return values | {term: float(known[term]) for term in self.form.terms}


def rms(residuals_px: tuple[np.ndarray, ...]) -> float:
    """Return the root mean square length of residuals (N, 2), px; inf where one is unknown."""
    value = float(np.sqrt(np.mean(np.sum(np.concatenate(residuals_px) ** 2, axis=1))))
    return value if np.isfinite(value) else np.inf


def fit_camera(views: list[View], size: tuple[int, int], form: LensForm, near: CameraModel | None = None) -> Fit:
    """Return the camera of `form` for frames of `size` (width, height) that projects the boards best.

    `near` is a fit of the same form to start from, else several starts are tried. Raises `CalibrationError` where none
    leads anywhere.
    """
    if near is not None:
        starts: list[PinholeCamera | None] = [near.central]
    elif form.model == "pinhole":
        starts = [None, *_guesses(size)]
    else:
        simple = _attempt(views, size, LensForm("pinhole", ("k1", "k2")), None)
        starts = [*_guesses(size), *([] if simple is None else [simple.camera.central])]
    fits = [_attempt(views, size, form, start) for start in starts]
    best = min((fit for fit in fits if fit is not None), key=lambda fit: fit.rms_px, default=None)
    if best is None:
        raise CalibrationError(
            f"fitting the camera ({form.described}) to {len(views)} views of the board failed: give views in which the "
            "board is tilted by 20 to 40 deg in different directions"
        )
    return best


def with_bootstrap(fit: Fit, views: list[View]) -> Fit:
    """Return `fit` with the standard deviations that fits to views drawn anew give (Efron 1979), 20 of them.

    What follows from the noise of single corners is less: a plate that bends spoils the corners of a view together.
    """
    size, rng = (fit.camera.width, fit.camera.height), np.random.default_rng(0)
    rows = []
    for _ in range(_RESAMPLES):
        drawn = [views[i] for i in rng.integers(0, len(views), len(views))]
        again = _attempt(drawn, size, fit.form, fit.camera.central)
        if again is not None:
            rows.append(list(again.parameters.values()))
    spread = np.std(rows, axis=0, ddof=1) if len(rows) > 2 else np.full(len(fit.parameters), np.inf)
    return replace(fit, deviations=dict(zip(fit.parameters, map(float, spread), strict=True)))


def _guesses(size: tuple[int, int]) -> list[PinholeCamera | None]:
    w, h = size
    return [PinholeCamera(f * w, f * w, (w - 1) / 2, (h - 1) / 2, w, h) for f in _FOCAL_GUESSES]


def _attempt(views: list[View], size: tuple[int, int], form: LensForm, start: PinholeCamera | None) -> Fit | None:
    boards = [view.corners.board_mm.astype(np.float32)[:, None] for view in views]
    pixels = [view.corners.pixels.astype(np.float32)[:, None] for view in views]
    try:
        fitted = _pinhole if form.model == "pinhole" else _fisheye
        matrix, terms, rotations, places = fitted(boards, pixels, size, form, start)
    except cv2.error:  # degenerate views
        return None
    if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(terms)) and min(matrix[0, 0], matrix[1, 1]) > 0):
        return None
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    pinhole = PinholeCamera(fx, fy, cx, cy, *size)
    camera: CameraModel = pinhole
    if form.model == "fisheye":
        camera = FisheyeCamera(pinhole, tuple(map(float, terms)))
    elif form.terms:
        camera = OpenCvCamera(pinhole, tuple(map(float, terms)))
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    for pose, rotation, place in zip(poses, rotations, places, strict=True):
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], np.ravel(place)
    residuals = tuple(
        view.corners.pixels - camera.project(transform(pose, view.corners.board_mm))
        for view, pose in zip(views, poses, strict=True)
    )
    return Fit(form, camera, poses, residuals, {})


_Fitted = tuple[np.ndarray, np.ndarray, Sequence[np.ndarray], Sequence[np.ndarray]]


def _pinhole(
    boards: list[np.ndarray],
    pixels: list[np.ndarray],
    size: tuple[int, int],
    form: LensForm,
    start: PinholeCamera | None,
) -> _Fitted:
    flags = sum(flag for term, flag in _FIX.items() if term not in form.terms)
    matrix = np.eye(3) if start is None else start.matrix
    flags |= 0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS
    _, matrix, terms, rotations, places = cv2.calibrateCamera(
        boards, pixels, size, matrix, np.zeros(5), flags=flags, criteria=_STEPS
    )
    return np.asarray(matrix), terms.ravel()[:5], rotations, places


def _fisheye(
    boards: list[np.ndarray],
    pixels: list[np.ndarray],
    size: tuple[int, int],
    form: LensForm,
    start: PinholeCamera | None,
) -> _Fitted:
    assert start is not None
    flags = sum(flag for term, flag in _FIX_FISHEYE.items() if term not in form.terms)
    flags |= cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW | cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
    _, matrix, terms, rotations, places = cv2.fisheye.calibrate(
        boards, pixels, size, start.matrix, np.zeros((4, 1)), flags=flags, criteria=_STEPS
    )
    return np.asarray(matrix), terms.ravel(), rotations, places
