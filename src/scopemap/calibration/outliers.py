"""Views and corners that do not agree with the others: another board, a bent or moved one, a reflection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scopemap.calibration.choosing import resected
from scopemap.calibration.fitting import Fit, LensForm, fit_camera, rms
from scopemap.calibration.selection import LeftOut
from scopemap.calibration.targets import Corners
from scopemap.calibration.views import View
from scopemap.cameras.camera import CameraModel
from scopemap.geometry.least_squares import robust_sigma

# A view that is farther off than the median, and than the usual spread about it, by so much does not fit.
_OFF, _OFF_SPREADS, _OFF_PX = 3.0, 6.0, 0.1
_MOST_OUTLIERS = 1 / 3
# Lengths of residuals with the same spread both ways exceed so many medians (5 sigma) once in 300,000.
_STRAY_MEDIANS, _STRAY_PX = 4.25, 0.25
_FEWEST_CORNERS = 6
_MENDED = 10


def agreeing(views: list[View], size: tuple[int, int], form: LensForm) -> tuple[list[View], list[LeftOut]]:
    """Return the views that agree on a camera of `form`, without stray corners, and those that do not: a third at most.

    The worst view goes and the rest is fitted anew, as long as the worst one is far from what is usual. Where a tenth
    of its corners is to blame, such as those at the rim of the field of view, these go instead.
    """
    kept, out = list(views), list[LeftOut]()
    fit = fit_camera(kept, size, form)
    for _ in views:
        error = fit.view_rms_px
        usual = float(np.median(error))
        if not np.isfinite(usual) or len(out) >= _MOST_OUTLIERS * len(views):
            break
        spread = robust_sigma(error - usual)
        limit = max(_OFF * usual, usual + _OFF_SPREADS * spread, usual + _OFF_PX)
        worst = int(np.argmax(error))
        if error[worst] <= limit:
            break
        mended = _mended(kept[worst], fit.camera, fit.T_camera_board[worst], limit)
        if mended is None:
            out.append(LeftOut(kept[worst], f"it does not fit: {error[worst]:.2f} px off, the others {usual:.2f} px"))
        kept[worst : worst + 1] = [] if mended is None else [mended]
        fit = fit_camera(kept, size, form, near=fit.camera)
    return _without_stray_corners(kept, fit), out


def _mended(view: View, camera: CameraModel, T_camera_board: np.ndarray, limit_px: float) -> View | None:
    """Return the view without the corners that keep it from `limit_px`, None where these are more than a tenth."""
    corners = view.corners
    for _ in range(len(corners.pixels) // _MENDED):
        length = np.linalg.norm(resected(camera, corners, T_camera_board), axis=1)
        good = np.arange(len(length)) != np.argmax(np.nan_to_num(length, nan=np.inf))
        corners = Corners(corners.board_mm[good], corners.pixels[good])
        if rms((resected(camera, corners, T_camera_board),)) <= limit_px:
            return replace(view, corners=corners)
    return None


def _without_stray_corners(views: list[View], fit: Fit) -> list[View]:
    """Return the views without corners that lie far from where `fit` sees them; fewer than 6 are no view."""
    lengths = [np.linalg.norm(residual, axis=1) for residual in fit.residuals_px]
    limit = max(_STRAY_MEDIANS * float(np.median(np.concatenate(lengths))), _STRAY_PX)
    kept = [
        replace(view, corners=Corners(view.corners.board_mm[length <= limit], view.corners.pixels[length <= limit]))
        for view, length in zip(views, lengths, strict=True)
    ]
    return [view for view in kept if len(view.corners.pixels) >= _FEWEST_CORNERS]
