"""RTDL: rotation first, then the whole motion, by dog-leg on a keyframe's photometric residuals, coarse to fine.

Equations 5 to 12 of arXiv 2508.11282, section "WEMA-RTDL module". `residuals.py` has the photometric error (5) and its
Jacobian, `geometry/least_squares.py` the dog-leg step (7 to 9). Steps are composed on the group, where the paper adds
(10, 12).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from scopemap.engine.config import TrackingSettings
from scopemap.engine.geometry.least_squares import DenseModel, Options, Problem, minimise, robust_sigma
from scopemap.engine.geometry.se3 import orthonormalised, se3_exp
from scopemap.engine.tracking.residuals import (
    PARAMETERS,
    Loss,
    PyramidLevel,
    compared_pixels,
    depth_residuals,
    normal_equations,
    residual_images,
)

_LIT = np.array([True, False])  # grey, normalised: the channels of a pyramid
_INLIER = 0.5  # by hand: residual of an inlier, in units of the normalised channel
_MIN_SIGMA = 1e-3  # guard: division by zero in flat images
_MIN_DEPTH_SIGMA = 1e-3  # guard: of the distance to measured depth, share of the keyframe's mean depth
_GREY_SHARE = 0.3  # by hand: weight of the grey channel against the normalised one
_MOST_STEPS = 30  # by hand: per pyramid level
_MOST_STEPS_FAST = 15  # by hand
# Measured: well tracked clips have 0.3 and more, tissue without structure 0.1 and less.
_MIN_CORRELATION = 0.15
_RADIUS = 0.1  # rho, first trust radius: rad, and translation over mean depth; the paper gives none, not searched


class Motion(NamedTuple):
    """Motion (4, 4) that takes points of the reference to the current camera, and (gain, bias) of its brightness."""

    T_current_reference: np.ndarray
    affine: np.ndarray


@dataclass(frozen=True)
class Alignment:
    """Relative pose of two frames, and how well it fits their images.

    residual : robust standard deviation of the normalised channel's residuals at the finest level, in local deviations.
    inlier_share : share of the used pixels whose residual is below half a local deviation. correlation : -1..1, of
    both frames' normalised channel over these pixels; near 0 for noise, however well that fits.
    texture : root mean square of that channel in the reference, 1 where tissue has texture everywhere.
    overlap : share of the reference's usable pixels that project into usable pixels. iterations : over all levels.
    is_supported : whether matched corners confirm the motion. coverage : share of the keyframe's corners that are
    matched, 1 where they are not used. matches : inliers of the features that it was found by. nonrigidity : as in
    `Track`.
    """

    motion: Motion
    residual: float
    inlier_share: float
    correlation: float
    texture: float
    overlap: float
    iterations: int
    is_supported: bool = False
    coverage: float = 1.0
    matches: int = 0
    nonrigidity: np.ndarray | None = None

    @property
    def agreement(self) -> float:
        """Share of the reference's usable pixels that are inliers, by which alignments are compared."""
        return self.inlier_share * self.overlap


def align(
    reference: list[PyramidLevel], current: list[PyramidLevel], T_start: np.ndarray, settings: TrackingSettings
) -> Alignment:
    """Return the alignment of two pyramids (finest level first), from the first guess `T_start` (4, 4).

    The coarsest level turns the camera (equation 10); the finer ones start from that rotation (6) and move it (12).
    """
    motion, iterations, coarse = Motion(T_start, np.array([1.0, 0.0])), 0, math.inf
    depth = reference[-1].depth_mm
    unit_mm = float(np.nanmean(depth)) if np.isfinite(depth).any() else 1.0
    for level in reversed(range(len(reference))):
        rotation_only = settings.rotation_first and level == len(reference) - 1 and len(reference) > 1
        motion, steps = _align_level(reference[level], current[level], motion, settings, rotation_only, unit_mm)
        iterations += steps
        coarse = math.inf if rotation_only else _correlation(reference[level:], current[level:], motion, settings)
        if coarse < least_correlation(settings):
            break
    # The inverse by transposition doubles the error of a rotation matrix at every frame.
    motion = motion._replace(T_current_reference=orthonormalised(motion.T_current_reference))
    found = judge(reference, current, motion, iterations)
    # What ended at a coarse level is not to be accepted, however well it happens to correlate at the finest.
    ended = coarse < least_correlation(settings)
    return replace(found, correlation=min(found.correlation, coarse)) if ended else found


def least_correlation(settings: TrackingSettings) -> float:
    """Return the correlation with the keyframe below which a frame is lost; -1: none is."""
    return _MIN_CORRELATION if settings.picture_checks else -1.0


def _correlation(
    reference: list[PyramidLevel], current: list[PyramidLevel], motion: Motion, settings: TrackingSettings
) -> float:
    """Return the correlation at the finest of these levels; infinite where measured depth takes part."""
    by_shape = settings.photometry.depth_weight > 0 and np.isfinite(current[0].depth_mm).any()
    return math.inf if by_shape else judge(reference, current, motion).correlation


def judge(reference: list[PyramidLevel], current: list[PyramidLevel], motion: Motion, iterations: int = 0) -> Alignment:
    """Return how well a motion aligns two pyramids at their finest level; the other levels are not read."""
    expected, used, usable = compared_pixels(reference[0], current[0], motion.T_current_reference)
    sigma = robust_sigma(used, _MIN_SIGMA)
    if not used.size:
        return Alignment(motion, sigma, 0.0, 0.0, 0.0, 0.0, iterations)
    inliers, observed = float(np.mean(np.abs(used) < _INLIER)), expected + used
    power = float(np.sqrt(np.mean(expected**2) * np.mean(observed**2)))
    correlation = float(np.mean(expected * observed)) / max(power, 1e-9)
    texture = float(np.sqrt(np.mean(expected**2)))
    return Alignment(motion, sigma, inliers, correlation, texture, used.size / max(usable, 1), iterations)


def _loss(sigma: np.ndarray, settings: TrackingSettings) -> Loss:
    share = (_GREY_SHARE, 1.0) if settings.photometry.normalised else (1.0, 0.0)
    return Loss(sigma, settings.huber, np.array(share), _LIT, settings.photometry.lamp_gamma)


def _align_level(
    reference: PyramidLevel,
    current: PyramidLevel,
    motion: Motion,
    settings: TrackingSettings,
    rotation_only: bool,
    unit_mm: float,
) -> tuple[Motion, int]:
    loss = _loss(np.ones(len(reference.channels)), settings)
    start = residual_images(reference, current, motion.T_current_reference, motion.affine, loss)
    loss = _loss(np.array([robust_sigma(r[np.isfinite(r)], _MIN_SIGMA) for r in start]), settings)
    photometry = settings.photometry
    if photometry.depth_weight > 0 and np.isfinite(current.depth_mm).any():
        gaps = depth_residuals(reference, current, motion.T_current_reference, unit_mm)
        gaps = gaps[np.isfinite(gaps)]
        if gaps.size:
            sigma = robust_sigma(gaps, _MIN_DEPTH_SIGMA)
            loss = loss._replace(depth_sigma=sigma, depth_share=photometry.depth_weight)
    min_weight = 0.5 * float(reference.weight[np.isfinite(start[0])].sum())
    with_gain = photometry.gain_bias and loss.share[0] > 0
    free = np.array([0, 1, 2] + ([] if rotation_only else [3, 4, 5]) + ([6, 7] if with_gain else []))

    def linearise(state: Motion) -> DenseModel:
        equations = normal_equations(reference, current, *state, loss, unit_mm)
        # A mean over few pixels can be small: a step out of the overlap is no improvement.
        cost = equations.cost if equations.weight > min_weight else np.inf
        return DenseModel(cost, equations.gradient[free], equations.hessian[np.ix_(free, free)])

    def retract(state: Motion, step: np.ndarray) -> Motion:
        full = np.zeros(PARAMETERS)
        full[free] = step
        full[3:6] *= unit_mm
        return Motion(se3_exp(full[:6]) @ state.T_current_reference, state.affine + full[6:])

    takes_full_steps = settings.solver == "gauss-newton"
    options = Options(_RADIUS, _MOST_STEPS_FAST if settings.fast else _MOST_STEPS, gauss_newton=takes_full_steps)
    solution = minimise(Problem(linearise, retract), motion, options)
    return solution.state, solution.iterations
