"""Bundle adjustment of one window with an unknown focal length and an unknown distortion of the lens.

It starts without motion and with one depth for all points, which converges for small motion (Ha et al., "High-quality
depth from uncalibrated small motion clip", CVPR 2016), first without distortion and from two focal lengths.

Neither a translation nor a rotation about the optical axis determines the focal length; a tilt of the axis does. The
standard deviation of ln f is a cluster-robust sandwich over blocks of the image, because the errors of neighbouring
corners are correlated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scopemap.calibration.focal_length.windows import Window
from scopemap.mapping.bundle_adjustment import adjust, linearised
from scopemap.mapping.bundle_problem import BundleProblem, Observations, Points, Priors, State, UnknownLens

_LOG_DEPTH_SIGMA, _DISTORTION_SIGMA, _LOG_FOCAL_SIGMA = 1.0, 0.3, 1.0
_NO_DISTORTION_SIGMA = 1e-4
_START_FOV_DEG = (60.0, 105.0)
_BLOCKS = 4  # columns and rows of the image within which errors are correlated
_MIN_SIGMA_PX = 0.03
# Iterations, and smallest relative decrease: first of all starts, then of the best one with distortion.
_FIRST, _THEN = (15, 1e-3), (30, 1e-4)


@dataclass(frozen=True)
class WindowFit:
    """Focal length from one window.

    Attributes
    ----------
    log_focal : ln of fx, px. deviation : its standard deviation, all else marginalised. residual_px : robust standard
    deviation of the reprojection errors. tilt_deg : largest tilt of the optical axis against the host's. distortion :
    b of `mapping.bundle_adjustment`.
    """

    log_focal: float
    deviation: float
    residual_px: float
    tilt_deg: float
    distortion: float


def adjust_window(window: Window, assumed_focal_px: float) -> WindowFit | None:
    """Return the fit to a window from the best start; None where the focal length is undetermined.

    assumed_focal_px : mean of its prior, whose standard deviation is a factor of e.
    """
    problem = _problem(window, assumed_focal_px)
    starts = [np.log(window.half_width_px / np.tan(np.radians(fov_deg) / 2)) for fov_deg in _START_FOV_DEG]
    states = [problem.tracked._replace(lens=np.array([log_focal, 0.0])) for log_focal in starts]
    states = [_adjusted(window, problem, state, _NO_DISTORTION_SIGMA, _FIRST)[1] for state in states]
    best = min(states, key=lambda state: state.sigma_px)
    problem, state = _adjusted(window, problem, best, _DISTORTION_SIGMA, _THEN)
    deviation = _log_focal_deviation(problem, state)
    if not np.isfinite(deviation):
        return None
    tilt_deg = float(np.degrees(np.arccos(np.clip(state.T_camera_world[:, 2, 2].min(), -1, 1))))
    return WindowFit(float(state.lens[0]), deviation, state.sigma_px, tilt_deg, float(state.lens[1]))


def _adjusted(
    window: Window, problem: BundleProblem, start: State, sigma: float, effort: tuple[int, float]
) -> tuple[BundleProblem, State]:
    """Return the problem with a prior of `sigma` for the distortion, and its solution; effort : as `_FIRST`."""
    lens = UnknownLens(window.half_width_px, np.array([_LOG_FOCAL_SIGMA, sigma]))
    problem = replace(problem, start=start, lens=lens)
    return problem, adjust(problem, max_iterations=effort[0], min_decrease=effort[1]).state


def _problem(window: Window, focal_px: float) -> BundleProblem:
    """Return the bundle adjustment of a window: the host is keyframe 0, its partners follow."""
    squeeze = np.array([1.0, window.aspect])
    corners, partners = window.seen.shape[:2]
    corner, partner = np.nonzero(np.isfinite(window.seen).all(-1))
    points = Points(
        np.zeros(corners, int), window.start / squeeze, np.zeros(corners), np.full(corners, _LOG_DEPTH_SIGMA)
    )
    observations = Observations(corner, partner + 1, window.seen[corner, partner] / squeeze)
    T_camera_world, neighbours = np.tile(np.eye(4), (partners + 1, 1, 1)), np.zeros((0, 2), int)
    priors = Priors(scale=0.0)
    return BundleProblem(
        T_camera_world, points, observations, priors, neighbours, focal_px, least_sigma_px=_MIN_SIGMA_PX
    )


def _log_focal_deviation(problem: BundleProblem, state: State) -> float:
    """Return the cluster-robust standard deviation of ln f, all else marginalised; NaN where it is undetermined."""
    model = linearised(problem, state)
    (block,), free = model.blocks[0], model.free
    matrix = model.reduced()[0]
    try:
        influence = np.zeros(model.cameras)
        influence[free] = np.linalg.pinv(matrix, hermitian=True)[-2]
    except np.linalg.LinAlgError:
        return float("nan")
    scores = block.scores - block.E * (block.g / block.h)[:, None]
    pixel = problem.points.pixel
    low, high = pixel.min(0), pixel.max(0)
    cell = np.clip((pixel - low) / np.maximum(high - low, 1e-9) * _BLOCKS, 0, _BLOCKS - 1).astype(int)
    number = cell[:, 0] * _BLOCKS + cell[:, 1]
    influences = np.bincount(number, weights=scores @ influence[block.columns], minlength=_BLOCKS**2)
    filled = len(np.unique(number))
    return float(np.sqrt((influences**2).sum() * filled / max(filled - 1, 1)))
