"""RTDL: rotation first, then the whole motion, by dog-leg on photometric residuals from coarse to fine.

METHOD section WEMA-RTDL. The reference is a keyframe with depth; its points are moved, not the tracked frame's (the
paper's formula lifts with the tracked frame's depth, which is not known yet when tracking comes first).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scopemap.config import TrackingSettings
from scopemap.geometry.least_squares import DenseModel, Options, Problem, minimise, robust_sigma
from scopemap.geometry.se3 import orthonormalised, se3_exp
from scopemap.tracking.residuals import PARAMETERS, Loss, View, depth_residuals, normal_equations, residual_images

_LIT = np.array([True, False])  # grey, normalised: the channels of a pyramid
_INLIER = 0.5
_LEAST_SIGMA = 1e-3  # keeps flat images from dividing by zero


class Motion(NamedTuple):
    """Motion (4, 4) that takes points of the reference to the current camera, and (gain, bias) of its brightness."""

    T_current_reference: np.ndarray
    affine: np.ndarray


@dataclass(frozen=True)
class Alignment:
    """Where the alignment of two frames ended.

    Attributes
    ----------
    motion : the best motion found. residual : robust standard deviation of the residuals at the finest level, of the
    normalised channel whatever was minimised, so in local deviations of the grey value.
    inlier_share : share of the used pixels whose residual is below half a local deviation. correlation : -1..1, of
    both frames' normalised channel over these pixels; near 0 where there is nothing but noise, however well that fits.
    texture : root mean square of that channel in the reference, 1 where tissue shows itself everywhere.
    overlap : share of the reference's usable pixels that project into usable pixels. iterations : over all levels.
    """

    motion: Motion
    residual: float
    inlier_share: float
    correlation: float
    texture: float
    overlap: float
    iterations: int


def align(
    reference: list[View], current: list[View], start: np.ndarray, settings: TrackingSettings, *, down_to: int = 0
) -> Alignment:
    """Align two pyramids (finest level first), starting from the motion `start` (4, 4).

    `down_to` leaves out so many of the finest levels, which cost most of the time; judged is at the finest one anyhow.
    """
    motion, iterations = Motion(start, np.array([1.0, 0.0])), 0
    depth = reference[-1].depth_mm
    unit_mm = float(np.nanmean(depth)) if np.isfinite(depth).any() else 1.0
    for level in reversed(range(min(down_to, len(reference) - 1), len(reference))):
        rotation_only = settings.rotation_first and level == len(reference) - 1 and len(reference) > 1
        motion, steps = _align_level(reference[level], current[level], motion, settings, rotation_only, unit_mm)
        iterations += steps
    # Inverting by transposing doubles a deviation from a rotation each time round: cut it off at every frame.
    motion = motion._replace(T_current_reference=orthonormalised(motion.T_current_reference))
    return judged(reference, current, motion, settings, iterations)


def judged(
    reference: list[View], current: list[View], motion: Motion, settings: TrackingSettings, iterations: int = 0
) -> Alignment:
    """Return what two pyramids say of a motion, as it is."""
    residuals = _residuals(reference[0], current[0], motion, settings)
    compared = np.isfinite(residuals[-1])
    used, shown = residuals[-1][compared], reference[0].channels[-1][compared]
    usable = int(((reference[0].weight > 0) & np.isfinite(reference[0].depth_mm)).sum())
    sigma = robust_sigma(used, _LEAST_SIGMA)
    if not used.size:
        return Alignment(motion, sigma, 0.0, 0.0, 0.0, 0.0, iterations)
    inliers, found = float(np.mean(np.abs(used) < _INLIER)), shown + used
    power = float(np.sqrt(np.mean(shown**2) * np.mean(found**2)))
    correlation = float(np.mean(shown * found)) / max(power, 1e-9)
    texture = float(np.sqrt(np.mean(shown**2)))
    return Alignment(motion, sigma, inliers, correlation, texture, used.size / max(usable, 1), iterations)


def _loss(sigma: np.ndarray, settings: TrackingSettings) -> Loss:
    share = {"grey": (1.0, 0.0), "normalised": (0.0, 1.0), "both": (settings.grey_share, 1.0)}[settings.channels]
    return Loss(sigma, settings.huber, np.array(share), _LIT, settings.lamp_gamma)


def _residuals(reference: View, current: View, motion: Motion, settings: TrackingSettings) -> np.ndarray:
    loss = _loss(np.ones(len(reference.channels)), settings)
    return residual_images(reference, current, motion.T_current_reference, motion.affine, loss)


def _align_level(
    reference: View, current: View, motion: Motion, settings: TrackingSettings, rotation_only: bool, unit_mm: float
) -> tuple[Motion, int]:
    start = _residuals(reference, current, motion, settings)
    loss = _loss(np.array([robust_sigma(r[np.isfinite(r)], _LEAST_SIGMA) for r in start]), settings)
    if settings.depth_share > 0 and np.isfinite(current.depth_mm).any():
        gaps = depth_residuals(reference, current, motion.T_current_reference, unit_mm)
        gaps = gaps[np.isfinite(gaps)]
        if gaps.size:
            sigma = robust_sigma(gaps, settings.least_depth_sigma)
            loss = loss._replace(depth_sigma=sigma, depth_share=settings.depth_share)
    least_weight = 0.5 * float(reference.weight[np.isfinite(start[0])].sum())
    free = np.array(
        [0, 1, 2] + ([] if rotation_only else [3, 4, 5]) + ([6, 7] if settings.gain_bias and loss.share[0] > 0 else [])
    )

    def linearise(state: Motion) -> DenseModel:
        equations = normal_equations(reference, current, *state, loss, unit_mm)
        # A mean over few pixels can be small: a step that walks out of the overlap is no improvement.
        cost = equations.cost if equations.weight > least_weight else np.inf
        return DenseModel(cost, equations.gradient[free], equations.hessian[np.ix_(free, free)])

    def retract(state: Motion, step: np.ndarray) -> Motion:
        full = np.zeros(PARAMETERS)
        full[free] = step
        full[3:6] *= unit_mm
        return Motion(se3_exp(full[:6]) @ state.T_current_reference, state.affine + full[6:])

    options = Options(settings.radius, settings.max_iterations, gauss_newton=settings.solver == "gauss-newton")
    solution = minimise(Problem(linearise, retract), motion, options)
    return solution.state, solution.iterations
