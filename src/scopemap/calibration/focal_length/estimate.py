"""One focal length for a sequence, with an honest spread: what its windows say together, or why they do not tell.

Windows disagree by more than their deviations admit, so their scatter is estimated with their mean (DerSimonian and
Laird, "Meta-analysis in clinical trials", 1986). And they err together: a lamp that moves along pulls the flow, and
the camera seems to turn by about 0.4 degrees more or less than it does. Where its axis tilts by T degrees, the focal
length is wrong by the share 0.4 / T, however many windows there are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from scopemap.calibration.focal_length.adjustment import WindowFit, adjusted
from scopemap.calibration.focal_length.windows import MOST_FRAMES, windows_of
from scopemap.config import Config
from scopemap.io.sequence import Sequence

FOV_RANGE_DEG = (30.0, 150.0)
"""Horizontal fields of view that endoscopes have."""

_TURN_ERROR_DEG = 0.4
_LEAST_TILT_DEG = 0.05
_LEAST_SHARE = 0.01  # of any window's deviation
_LARGEST_RESIDUAL = 0.001  # share of the width: what no still scene explains better than that is tissue that moves
_LEAST_WINDOWS = 2
_SIGNIFICANT = 2.0


@dataclass(frozen=True)
class FocalEstimate:
    """What the motion tells of a focal length.

    Attributes
    ----------
    focal_px : horizontal focal length at the sequence's working size, NaN where nothing is told. share : its standard
    deviation over itself. fov_deg : horizontal field of view. windows : how many told something. bend : by which share
    of its distance from the optical axis the lens pulls in what lies half a picture's width away. reason : why nothing
    is told, or "".
    """

    focal_px: float
    share: float
    fov_deg: float
    windows: int
    bend: float = 0.0
    reason: str = ""

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the focal length, px at the working size."""
        return self.share * self.focal_px

    def differs_from(self, focal_px: float) -> bool:
        """Whether it is two deviations off another focal length, or more."""
        return bool(abs(math.log(self.focal_px / focal_px)) >= _SIGNIFICANT * self.share)


def focal_from_motion(sequence: Sequence, config: Config) -> FocalEstimate:
    """Return what the first frames of a sequence tell of its camera's focal length; its own is the first guess.

    The optical axis is taken where the sequence's camera has it.
    """
    camera = sequence.camera
    fits = []
    for window in windows_of(sequence, config):
        fit = adjusted(window, camera.fx * 2 * window.half_width_px / camera.width)
        if fit is not None and fit.residual_px <= _LARGEST_RESIDUAL * 2 * window.half_width_px:
            fits.append(_at_width(fit, camera.width / (2 * window.half_width_px)))
    return together(fits, camera.width)


def _at_width(fit: WindowFit, scale: float) -> WindowFit:
    return WindowFit(
        fit.log_focal + math.log(scale), fit.deviation, fit.residual_px * scale, fit.tilt_deg, fit.distortion
    )


def together(fits: Iterable[WindowFit], width_px: float) -> FocalEstimate:
    """Return what windows tell together, of pictures that are `width_px` wide; the spread is never below 1 %."""
    told = [fit for fit in fits if fit.tilt_deg >= _LEAST_TILT_DEG]
    if len(told) < _LEAST_WINDOWS:
        reason = f"{len(told)} stretch(es) of the first {MOST_FRAMES} frames show a camera that turns, two are needed"
        return FocalEstimate(math.nan, math.inf, math.nan, len(told), reason=reason)
    logs = np.array([fit.log_focal for fit in told])
    shared = np.array([_TURN_ERROR_DEG / fit.tilt_deg for fit in told])
    own = np.array([fit.deviation for fit in told]) ** 2 + _LEAST_SHARE**2
    scatter = _scatter(logs, own + shared**2)
    weight = 1 / (own + shared**2 + scatter)
    weight /= weight.sum()
    share = math.hypot(math.sqrt(float((weight**2 * (own + scatter)).sum())), float(weight @ shared))
    focal_px = math.exp(float(weight @ logs))
    fov_deg = 2 * math.degrees(math.atan(width_px / 2 / focal_px))
    plausible = FOV_RANGE_DEG[0] <= fov_deg <= FOV_RANGE_DEG[1]
    reason = "" if plausible else f"a horizontal field of view of {fov_deg:.0f} deg is no endoscope's"
    bend = float(np.median([fit.distortion for fit in told]))
    return FocalEstimate(focal_px, share, fov_deg, len(told), bend, reason)


def _scatter(values: np.ndarray, variances: np.ndarray) -> float:
    """Return the variance of the values beyond their own (DerSimonian and Laird, 1986)."""
    weight = 1 / variances
    mean = weight @ values / weight.sum()
    excess = weight @ (values - mean) ** 2 - (len(values) - 1)
    return max(0.0, float(excess / (weight.sum() - (weight**2).sum() / weight.sum())))
