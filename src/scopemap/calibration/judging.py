"""What a calibration leaves open: warnings that a person should read before using it."""

from __future__ import annotations

import numpy as np

from scopemap.calibration.fitting import Fit

_TILTED_DEG, _TILTED_VIEWS = 15.0, 3
_LITTLE_COVERED = 0.5
_LARGE_RMS_PX = 1.0
_UNSURE_FOCAL = 0.01
_OTHER_ASPECT = 0.02
_FEW_VIEWS = 12
_UNMAPPED = 0.001


def tilts_deg(fit: Fit) -> np.ndarray:
    """Return the angle (V,) between each board's plane and the picture's, degrees."""
    return np.degrees(np.arccos(np.clip(np.abs(fit.T_camera_board[:, 2, 2]), 0, 1)))


def unmapped_share(fit: Fit) -> float:
    """Return the share of the picture's pixels that the fitted lens gives no ray."""
    u, v = np.meshgrid(np.arange(0, fit.camera.width, 4), np.arange(0, fit.camera.height, 4))
    return float(np.mean(np.isnan(fit.camera.unproject(np.stack([u, v], -1))[..., 2])))


def warnings_about(fit: Fit, covered: float, pixel_aspect: float) -> list[str]:
    """Return what is to be said about a fit.

    `covered` is the share of the picture within boards, `pixel_aspect` the width of a pixel over its height.
    """
    central, found = fit.camera.central, []
    views, tilted = len(fit.residuals_px), int(np.sum(tilts_deg(fit) > _TILTED_DEG))
    if views < _FEW_VIEWS:
        found.append(f"only {views} views that differ: 15 to 40 are usual")
    if tilted < _TILTED_VIEWS:
        found.append(
            f"the board is tilted by more than {_TILTED_DEG:g} deg in {tilted} view(s): focal length and distance can "
            "hardly be told apart; tilt it by 20 to 40 deg in several directions"
        )
    if covered < _LITTLE_COVERED:
        found.append(
            f"the boards cover {100 * covered:.0f} % of the picture: beyond them the distortion is a guess; hold the "
            "board into the corners, too"
        )
    if fit.rms_px > _LARGE_RMS_PX:
        found.append(
            f"corners are {fit.rms_px:.2f} px off on the whole: is the plate flat, the video sharp, the zoom untouched?"
        )
    unsure = fit.deviations["fx"] / central.fx
    if unsure > _UNSURE_FOCAL:
        found.append(f"the focal length is known to {100 * unsure:.1f} % only: add views with the board tilted")
    aspect = central.fy / central.fx
    if abs(aspect / pixel_aspect - 1) > _OTHER_ASPECT:
        found.append(
            f"by the fit pixels are {aspect:.3f} times as wide as high, by the input {pixel_aspect:.3f}: are the "
            "board's squares square, or the picture stretched?"
        )
    unmapped = unmapped_share(fit)
    if unmapped > _UNMAPPED:
        found.append(
            f"{100 * unmapped:.1f} % of the picture's pixels lie beyond the fitted lens and are left out by it"
        )
    return found
