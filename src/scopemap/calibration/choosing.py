"""Which model, and how many coefficients: what predicts views that it was not fitted to."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.optimize import least_squares

from scopemap.calibration.fitting import Fit, LensForm, fit_camera, rms
from scopemap.calibration.targets import Corners
from scopemap.calibration.views import View
from scopemap.cameras.camera import CameraModel
from scopemap.errors import CalibrationError

FORMS = (
    LensForm("pinhole", ()),
    LensForm("pinhole", ("k1",)),
    LensForm("pinhole", ("k1", "k2")),
    LensForm("pinhole", ("k1", "k2", "p1", "p2")),
    LensForm("pinhole", ("k1", "k2", "p1", "p2", "k3")),
    LensForm("fisheye", ("k1",)),
    LensForm("fisheye", ("k1", "k2")),
    LensForm("fisheye", ("k1", "k2", "k3", "k4")),
)
"""What is fitted, of each model the simpler first."""

_FOLDS = 5
_PRECISE = 1e-6
# A form with more coefficients, or the fisheye, has to predict better by this share, or chance would choose.
_WORTH_IT = 0.02


def chosen(errors_px: dict[LensForm, float]) -> LensForm:
    """Return the form to use, given each one's error on held-out views, px, in the order of `FORMS`.

    Raises `CalibrationError` where no form predicts anything.
    """
    best: LensForm | None = None
    for form, error_px in errors_px.items():
        if np.isfinite(error_px) and (best is None or error_px < (1 - _WORTH_IT) * errors_px[best]):
            best = form
    if best is None:
        raise CalibrationError(
            "fitting the camera: no model predicts views that it was not fitted to; is the plate flat, the board the "
            "one named, and the lens the same in all frames (no zoom)?"
        )
    return best


def held_out_error_px(views: list[View], fit: Fit) -> float:
    """Return the RMS reprojection error, px, in views that `fit`'s form was not fitted to (5 folds); inf: it failed.

    In these only the board's pose is fitted. `fit`, of all views, is where the fits start from.
    """
    size, residuals = (fit.camera.width, fit.camera.height), []
    if not np.isfinite(fit.rms_px):
        return np.inf
    for fold in range(_FOLDS):
        kept = [view for place, view in enumerate(views) if place % _FOLDS != fold]
        try:
            camera = fit_camera(kept, size, fit.form, near=fit.camera).camera
        except CalibrationError:
            return np.inf
        left = zip(views[fold::_FOLDS], fit.T_camera_board[fold::_FOLDS], strict=True)
        residuals += [resected(camera, view.corners, pose) for view, pose in left]
    return rms(tuple(residuals))


def resected(camera: CameraModel, corners: Corners, T_camera_board: np.ndarray) -> np.ndarray:
    """Return corners seen minus projected (N, 2), px, with the board where `camera` sees it best, near the given pose.

    NaN beyond the field of the lens.
    """

    def residuals(pose: np.ndarray) -> np.ndarray:
        return corners.pixels - camera.project(corners.board_mm @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])

    start = np.concatenate([cv2.Rodrigues(T_camera_board[:3, :3])[0].ravel(), T_camera_board[:3, 3]])
    solved = least_squares(
        # What lies beyond the field is answered by a residual that no fit wants.
        lambda pose: np.nan_to_num(residuals(pose), nan=float(camera.width)).ravel(),
        start,
        x_scale="jac",
        method="lm",
        ftol=_PRECISE,
        xtol=_PRECISE,
    )
    return residuals(solved.x)
