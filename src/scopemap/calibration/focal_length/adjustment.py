"""Bundle adjustment of one window with an unknown focal length and an unknown bend of the lens.

A corner x of the host, px from the optical axis, is straightened to x (1 + b |x|^2 / h^2), h half the picture's width
and b the bend at that distance. It lies on the ray (x / f, 1) at inverse depth w, and a partner with rotation R and
translation t sees p = R (x / f, 1) + w t at y, which that bend straightens to f p_xy / p_z. What is minimised, over f,
b, all w, R and t, is

    sum of rho(|y - seen| / s)
    + sum of ((w - 1) / 2)^2 / 2 + (b / 0.3)^2 / 2 + (ln f / f_assumed)^2 / 2

with Cauchy's rho and s the robust deviation of the residuals; the second sum fixes the scale. It starts from no motion
at all and one depth for everything, which small motion forgives (Ha et al., "High-quality depth from uncalibrated small
motion clip", CVPR 2016), first with a straight lens and from two focal lengths. Levenberg-Marquardt; the inverse depths
are eliminated (Schur complement).

A rotation about the optical axis tells nothing of f, nor does a camera that only moves along: f shows in how far the
axis tilts. The deviation of ln f is a cluster-robust sandwich over blocks of the picture, since neighbouring corners
err alike (see `depth.exponent`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scopemap.calibration.focal_length.windows import Window
from scopemap.geometry.least_squares import robust_sigma_2d
from scopemap.geometry.se3 import so3_exp

_CAUCHY = 2.0
_NEARNESS_SIGMA, _BEND_SIGMA, _LOG_FOCAL_SIGMA = 2.0, 0.3, 1.0
_STRAIGHT_SIGMA = 1e-4  # of the bend, where the lens is held straight
_START_FOV_DEG = (60.0, 105.0)
_BLOCKS = 4  # columns and rows of the picture whose corners are taken to err alike
_LEAST_SIGMA_PX = 0.03
_LEAST_Z, _LEAST_SLOPE = 1e-2, 0.1
_UNBENDING_STEPS = 6
# In half widths: a trial step may put a point beside the camera, where Newton's method would run away.
_FARTHEST = 10.0
_NEARNESS_RANGE = (1e-3, 50.0)
_LARGEST_STEP = 0.3  # of a rotation, rad, and of ln f
_FIRST_ITERATIONS, _ITERATIONS = 25, 30
_POSE = 6


@dataclass(frozen=True)
class WindowFit:
    """What one window tells of the focal length.

    Attributes
    ----------
    log_focal : ln of fx, px. deviation : its standard deviation, all else marginalised. residual_px : robust standard
    deviation of the residuals. tilt_deg : how far the optical axis turns at most, seen from the host. bend : b.
    """

    log_focal: float
    deviation: float
    residual_px: float
    tilt_deg: float
    bend: float


class _State(NamedTuple):
    turns: np.ndarray  # (K, 3, 3)
    ways: np.ndarray  # (K, 3)
    nearness: np.ndarray  # (N,) inverse depth, its median about 1
    lens: np.ndarray  # (2,) ln f, b


class _Problem(NamedTuple):
    start: np.ndarray
    seen: np.ndarray
    found: np.ndarray
    half_width_px: float
    lens: np.ndarray  # (2,) expected
    lens_sigma: np.ndarray  # (2,)


class _Reduced(NamedTuple):
    matrix: np.ndarray  # (M, M), M = 6 K + 2
    scores: np.ndarray  # (N, M), each corner's part of the gradient
    coupling: np.ndarray  # (N, M)
    curvature: np.ndarray  # (N,)
    slope: np.ndarray  # (N,)


def adjusted(window: Window, assumed_focal_px: float) -> WindowFit | None:
    """Return the best fit to a window from all starts; None where the search found nothing that can be solved.

    assumed_focal_px : what is believed beforehand, to a factor of e either way.
    """
    squeeze = np.array([1.0, window.aspect])
    found = np.isfinite(window.seen).all(-1)
    seen = np.where(found[..., None], window.seen / squeeze, 0.0)
    expected = np.array([np.log(assumed_focal_px), 0.0])
    problem = _Problem(
        window.start / squeeze, seen, found, window.half_width_px, expected, np.array([_LOG_FOCAL_SIGMA, _BEND_SIGMA])
    )
    straight = problem._replace(lens_sigma=np.array([_LOG_FOCAL_SIGMA, _STRAIGHT_SIGMA]))
    fits = []
    for fov_deg in _START_FOV_DEG:
        log_focal = np.log(window.half_width_px / np.tan(np.radians(fov_deg) / 2))
        state = _search(straight, _at_rest(problem, log_focal), _FIRST_ITERATIONS)
        state = _search(problem, state, _ITERATIONS)
        fits.append((_sigma_px(problem, state), state))
    sigma_px, state = min(fits, key=lambda fit: fit[0])
    deviation = _log_focal_deviation(problem, state, sigma_px)
    if not np.isfinite(deviation):
        return None
    tilt_deg = float(np.degrees(np.arccos(np.clip(state.turns[:, 2, 2].min(), -1, 1))))
    return WindowFit(float(state.lens[0]), deviation, sigma_px, tilt_deg, float(state.lens[1]))


def _at_rest(problem: _Problem, log_focal: float) -> _State:
    corners, partners = problem.found.shape
    turns = np.tile(np.eye(3), (partners, 1, 1))
    return _State(turns, np.zeros((partners, 3)), np.ones(corners), np.array([log_focal, 0.0]))


def _search(problem: _Problem, state: _State, most_iterations: int, least_gain: float = 1e-5) -> _State:
    damping = 1e-3
    sigma_px = _sigma_px(problem, state)
    cost = _cost(problem, state, sigma_px)
    for _ in range(most_iterations):
        candidate = _moved(state, _reduced(problem, state, sigma_px, damping))
        ahead = np.inf if candidate is None else _cost(problem, candidate, sigma_px)
        if candidate is None or not ahead < cost:
            damping *= 10
            if damping > 1e8:
                break
            continue
        gain = 1 - ahead / cost
        state, damping = candidate, max(damping / 10, 1e-8)
        # What counts as an outlier is judged anew as the fit gets better.
        sigma_px = _sigma_px(problem, state)
        cost = _cost(problem, state, sigma_px)
        if gain < least_gain:
            break
    return state


class _Sight(NamedTuple):
    error: np.ndarray  # (N, K, 2) px, 0 where not found
    corner: np.ndarray  # (N, 2) straightened
    turned: np.ndarray  # (N, K, 3) rotated rays
    point: np.ndarray  # (N, K, 3)
    straight: np.ndarray  # (N, K, 2) px, as a lens that does not bend sees the points
    pixel: np.ndarray  # (N, K, 2) px, as this one does


def _sight(problem: _Problem, state: _State) -> _Sight:
    focal, bend = np.exp(state.lens[0]), state.lens[1]
    corner = problem.start * (1 + bend * _square(problem.start, problem.half_width_px))
    ray = np.concatenate([corner / focal, np.ones((len(corner), 1))], 1)
    turned = np.einsum("kij,nj->nki", state.turns, ray)
    point = turned + state.nearness[:, None, None] * state.ways
    straight = focal * point[..., :2] / np.maximum(point[..., 2:], _LEAST_Z)
    pixel = _bent(straight, bend, problem.half_width_px)
    error = np.where(problem.found[..., None], pixel - problem.seen, 0.0)
    return _Sight(error, corner, turned, point, straight, pixel)


def _square(pixel: np.ndarray, half_width_px: float) -> np.ndarray:
    square: np.ndarray = (pixel**2).sum(-1, keepdims=True) / half_width_px**2
    return square


def _bent(straight: np.ndarray, bend: float, half_width_px: float) -> np.ndarray:
    """Return where (..., 2) the lens sees what a straight one sees at `straight`; Newton's method on the radius."""
    radius = wanted = np.minimum(np.sqrt(_square(straight, half_width_px)), _FARTHEST)
    for _ in range(_UNBENDING_STEPS):
        slope = np.maximum(1 + 3 * bend * radius**2, _LEAST_SLOPE)
        radius = np.clip(radius - (radius * (1 + bend * radius**2) - wanted) / slope, 0, _FARTHEST)
    return np.where(wanted > 0, radius / np.maximum(wanted, 1e-12), 1.0) * straight


def _sigma_px(problem: _Problem, state: _State) -> float:
    error = _sight(problem, state).error[problem.found]
    return robust_sigma_2d(np.linalg.norm(error, axis=1), _LEAST_SIGMA_PX)


def _cost(problem: _Problem, state: _State, sigma_px: float) -> float:
    square = (_sight(problem, state).error[problem.found] ** 2).sum(-1) / (sigma_px * _CAUCHY) ** 2
    priors = (((state.nearness - 1) / _NEARNESS_SIGMA) ** 2).sum()
    priors += (((state.lens - problem.lens) / problem.lens_sigma) ** 2).sum()
    return float(0.5 * _CAUCHY**2 * np.log1p(square).sum() + 0.5 * priors)


def _jacobians(problem: _Problem, state: _State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (N, K, 2), their derivatives by poses and lens (N, K, 2, 8), and by the inverse depth (N, K, 2)."""
    error, corner, turned, point, straight, pixel = _sight(problem, state)
    focal, bend = np.exp(state.lens[0]), state.lens[1]
    z = np.maximum(point[..., 2], _LEAST_Z)
    by_point = np.zeros((*z.shape, 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = focal / z
    by_point[..., 2] = -straight / z[..., None]
    by_straight = _by_straight(pixel, bend, problem.half_width_px)
    by_point = by_straight @ by_point
    # A small turn w takes p to p + w x p, so row r of the derivative becomes p x r.
    by_turn = np.cross(turned[..., None, :], by_point)
    by_way = by_point * state.nearness[:, None, None, None]
    by_nearness = np.einsum("nkij,kj->nki", by_point, state.ways)
    by_corner = np.einsum("nkij,kjl->nkil", by_point, state.turns[:, :, :2]) / focal
    by_focal = np.einsum("nkij,nkj->nki", by_straight, straight) - np.einsum("nkij,nj->nki", by_corner, corner)
    by_bend = np.einsum("nkij,nj->nki", by_corner, problem.start * _square(problem.start, problem.half_width_px))
    by_bend -= np.einsum("nkij,nkj->nki", by_straight, pixel * _square(pixel, problem.half_width_px))
    lens = np.stack([by_focal, by_bend], -1)
    return error, np.concatenate([by_turn, by_way, lens], -1), by_nearness


def _by_straight(pixel: np.ndarray, bend: float, half_width_px: float) -> np.ndarray:
    """Derivative (N, K, 2, 2) of `_bent` where it leads to `pixel`: the inverse of that of x (1 + b |x|^2 / h^2)."""
    square = _square(pixel, half_width_px)[..., None]
    factor = np.maximum(1 + bend * square, _LEAST_SLOPE)
    outer = 2 * bend * pixel[..., :, None] * pixel[..., None, :] / half_width_px**2
    inverse: np.ndarray = (np.eye(2) - outer / np.maximum(factor + 2 * bend * square, _LEAST_SLOPE)) / factor
    return inverse


def _reduced(problem: _Problem, state: _State, sigma_px: float, damping: float) -> _Reduced:
    """Linearise, weight, and eliminate the inverse depths."""
    error, by_rest, by_nearness = _jacobians(problem, state)
    corners, partners = problem.found.shape
    poses, unknowns = _POSE * partners, _POSE * partners + 2
    weight = problem.found / (1 + (error**2).sum(-1) / (sigma_px * _CAUCHY) ** 2) / sigma_px**2
    weighted = by_rest * weight[..., None, None]
    blocks = np.einsum("nkia,nkib->kab", weighted, by_rest)
    matrix = np.zeros((unknowns, unknowns))
    for k, block in enumerate(blocks):
        own = slice(_POSE * k, _POSE * k + _POSE)
        matrix[own, own] = block[:_POSE, :_POSE]
        matrix[own, poses:] = block[:_POSE, _POSE:]
        matrix[poses:, own] = block[_POSE:, :_POSE]
    matrix[poses:, poses:] = blocks[:, _POSE:, _POSE:].sum(0) + np.diag(problem.lens_sigma**-2.0)

    def per_corner(residual: np.ndarray) -> np.ndarray:
        parts = np.einsum("nkia,nki->nka", weighted, residual)
        return np.concatenate([parts[..., :_POSE].reshape(corners, poses), parts[..., _POSE:].sum(1)], 1)

    pull = (state.nearness - 1) / _NEARNESS_SIGMA**2
    curvature = np.einsum("nki,nki,nk->n", by_nearness, by_nearness, weight) + _NEARNESS_SIGMA**-2.0
    curvature *= 1 + damping
    slope = np.einsum("nki,nki,nk->n", by_nearness, error, weight) + pull
    coupling = per_corner(by_nearness)
    scores = per_corner(error) - coupling * (slope / curvature)[:, None]
    scores[:, poses:] += (state.lens - problem.lens) / problem.lens_sigma**2 / corners
    matrix += np.diag(np.diag(matrix) * damping + 1e-9)
    matrix -= coupling.T @ (coupling / curvature[:, None])
    return _Reduced(matrix, scores, coupling, curvature, slope)


def _moved(state: _State, system: _Reduced) -> _State | None:
    try:
        step = np.linalg.solve(system.matrix, -system.scores.sum(0))
    except np.linalg.LinAlgError:
        return None
    nearness = state.nearness - (system.slope + system.coupling @ step) / system.curvature
    turns, ways = np.split(step[:-2].reshape(-1, _POSE), 2, axis=1)
    turns = np.clip(turns, -_LARGEST_STEP, _LARGEST_STEP)
    return _State(
        np.stack([so3_exp(turn) @ R for turn, R in zip(turns, state.turns, strict=True)]),
        state.ways + ways,
        np.clip(nearness, *_NEARNESS_RANGE),
        state.lens + np.clip(step[-2:], -_LARGEST_STEP, _LARGEST_STEP),
    )


def _log_focal_deviation(problem: _Problem, state: _State, sigma_px: float) -> float:
    system = _reduced(problem, state, sigma_px, 0.0)
    scaled = np.diag(1e-9 * np.diag(system.matrix))
    try:
        influence = np.linalg.pinv(system.matrix + scaled, hermitian=True)[-2]
    except np.linalg.LinAlgError:
        return float("nan")
    low, high = problem.start.min(0), problem.start.max(0)
    cell = np.clip((problem.start - low) / np.maximum(high - low, 1e-9) * _BLOCKS, 0, _BLOCKS - 1).astype(int)
    block = cell[:, 0] * _BLOCKS + cell[:, 1]
    pulls = np.bincount(block, weights=system.scores @ influence, minlength=_BLOCKS**2)
    filled = len(np.unique(block))
    return float(np.sqrt((pulls**2).sum() * filled / max(filled - 1, 1)))
