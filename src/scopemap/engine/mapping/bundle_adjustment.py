"""Bundle adjustment: keyframe poses, a depth scale of each, the depth of every point and, if unknown, the focal length.

With the notation of `bundle_problem`:

    sum of rho(|projected - observed| / s) / c  +  sum of rho((u_p - ln depth_p - a_h) / sigma_p)
    +  sum of (a_k / sigma_a)^2  +  sum of |log(T_j T_i^-1 (T_j T_i^-1)_tracked^-1)|^2, weighted
    +  ((ln f - expected) / sigma_f)^2

rho is Cauchy's kernel, s the robust standard deviation of the reprojection errors, c the number of observations that
count as one, because the errors of flow are alike at neighbouring corners. The second sum holds points to the estimated
depth, up to the keyframe's factor exp(a_h); the third holds these factors to 1; the fourth holds a keyframe j to its
tracked motion from keyframe i; the last is for an unknown focal length. Dog-leg with Schur complement: Triggs et al.,
"Bundle Adjustment - A Modern Synthesis", 2000; Lourakis and Argyros, ICCV 2005.

More than a few hundred keyframes are adjusted window by window, so that time grows with their number, not its cube.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry import least_squares
from scopemap.engine.geometry.least_squares import Linear, Prior, ReducedModel, cauchy, dots, minimise, robust_sigma_2d
from scopemap.engine.geometry.se3 import hat, inverse, orthonormalised, se3_exp, se3_log
from scopemap.engine.mapping.bundle_problem import (
    PER_KEYFRAME,
    BundleProblem,
    BundleState,
    Errors,
    Observations,
    Points,
    Reprojection,
    held_to_result,
    jacobians,
    reproject,
    reprojection_errors,
)

CAUCHY = 2.0  # by hand: residuals of that many standard deviations get half the weight
_BEHIND = 100.0  # guard: squared residual, in variances, of a point behind the camera
_INVERSE_DEPTH_STEP = (0.1, 10.0)  # by hand: factor of the inverse depth in one step
_POINT_STEPS = 5  # by hand: of the points alone, after the keyframes
_ADDED_WITH = 2  # by hand: keyframes before a new one that move with it, and steps of each search
_ADDED_ITERATIONS = 6  # by hand
MOST_AT_ONCE = 300  # by hand
"""Most keyframes that are adjusted at once."""


class BundleSolution(NamedTuple):
    """Where the adjustment ended.

    state : the first keyframe's pose as it was; sigma_px : robust standard deviation of the reprojection errors.
    log_depth_sigma : (P,) standard deviation of ln depth by the observations alone, keyframes held; infinite where no
    other keyframe observes a point. iterations : accepted and rejected.
    """

    state: BundleState
    log_depth_sigma: np.ndarray
    iterations: int

    @property
    def sigma_px(self) -> float:
        """Robust standard deviation of the reprojection errors, px; NaN without observations."""
        return self.state.sigma_px


def adjust_in_windows(problem: BundleProblem, window: int = MOST_AT_ONCE) -> BundleSolution:
    """Return the solution of windows of successive keyframes, one after the other; of one window that of `adjust`."""
    start, count = problem.begin, len(problem.T_camera_world)
    if count <= window:
        return adjust(problem)
    found = BundleSolution(start, np.full(len(start.log_depth), np.inf), 0)
    # Equally long windows: a last one of few keyframes would hardly be adjusted.
    edges = np.linspace(0, count, -(-count // window) + 1).astype(int)
    for first, end in itertools.pairwise(edges):
        if first:  # From where the window before has ended.
            state, at_start = found.state, problem.begin.T_camera_world
            T = state.T_camera_world.copy()
            T[first:] = at_start[first:] @ inverse(at_start[first - 1]) @ T[first - 1]
            found = found._replace(state=state._replace(T_camera_world=T))
        found = _with_window(problem, found, first, end)
    lengths_px = errors_px(problem, found.state)
    sigma_px = robust_sigma_2d(lengths_px[np.isfinite(lengths_px)], problem.least_sigma_px)
    return found._replace(state=found.state._replace(sigma_px=sigma_px))


def adjust_one_by_one(problem: BundleProblem) -> BundleSolution:
    """Return the solution of keyframes that are added one after the other, as incremental structure from motion does.

    Each begins at the pose of the one before and is adjusted with the two before it, those before these held; then all
    together.
    """
    found = BundleSolution(problem.begin, np.full(len(problem.points.host), np.inf), 0)
    for k in range(1, len(problem.T_camera_world)):
        T = found.state.T_camera_world.copy()
        T[k] = T[k - 1]
        found = found._replace(state=found.state._replace(T_camera_world=T))
        found = _with_window(problem, found, max(k - _ADDED_WITH, 0), k + 1, _ADDED_ITERATIONS)
    return adjust_in_windows(replace(problem, start=found.state))


def _with_window(
    problem: BundleProblem, found: BundleSolution, first: int, end: int, max_iterations: int = 20
) -> BundleSolution:
    """Return the solution with the keyframes from `first` to before `end` adjusted, those before `first` being so."""
    points, seen, state = problem.points, problem.observations, found.state
    moved = state.T_camera_world.copy()
    host, observer = points.host[seen.point], seen.keyframe
    some = (np.maximum(host, observer) >= first) & (np.maximum(host, observer) < end)
    if not some.any():
        return found
    keyframes = np.union1d(np.union1d(host[some], observer[some]), np.arange(max(first - 1, 0), end))
    own = np.union1d(seen.point[some], np.flatnonzero((points.host >= first) & (points.host < end)))
    place = np.full(len(state.T_camera_world), -1)
    place[keyframes] = np.arange(len(keyframes))
    host, known = points.host[own], points.host[own] < first
    points = Points(place[host], points.pixel[own], points.log_depth[own], points.sigma[own])
    points = held_to_result(points, known, state.log_depth[own], state.log_scale[host], found.log_depth_sigma[own])
    part = replace(
        problem,
        T_camera_world=problem.T_camera_world[keyframes],
        points=points,
        observations=Observations(np.searchsorted(own, seen.point[some]), place[observer[some]], seen.pixel[some]),
        neighbours=place[problem.neighbours[(place[problem.neighbours] >= 0).all(1)]],
        start=BundleState(moved[keyframes], state.log_scale[keyframes], state.log_depth[own], state.log_focal),
        held=int((keyframes < first).sum()),
    )
    solved, new = adjust(part, max_iterations=max_iterations), ~known
    log_depth, sigma, log_scale = state.log_depth.copy(), found.log_depth_sigma.copy(), state.log_scale.copy()
    log_depth[own[new]], sigma[own[new]] = solved.state.log_depth[new], solved.log_depth_sigma[new]
    moved[keyframes], log_scale[keyframes] = solved.state.T_camera_world, solved.state.log_scale
    return BundleSolution(
        BundleState(moved, log_scale, log_depth, state.log_focal), sigma, found.iterations + solved.iterations
    )


def adjust(problem: BundleProblem, *, max_iterations: int = 20, min_decrease: float = 1e-3) -> BundleSolution:
    """Return the solution that the search finds from the start; without observations everything stays as tracked."""
    start = problem.begin
    if not len(problem.observations.point) or len(problem.T_camera_world) < 2:
        return BundleSolution(problem.tracked, np.full(len(start.log_depth), np.inf), 0)

    # Where only the kernel's scale changes, the errors do not.
    found_at: tuple[np.ndarray, _Deviations] | None = None

    def deviations_at(state: BundleState) -> _Deviations:
        nonlocal found_at
        if found_at is None or found_at[0] is not state.log_depth:
            found_at = state.log_depth, _deviations(problem, state)
        return found_at[1]

    def rescaled(state: BundleState) -> BundleState:
        seen = deviations_at(state).seen
        lengths = np.sqrt(dots(seen.error, seen.error)[seen.ahead])
        return state._replace(sigma_px=robust_sigma_2d(lengths, problem.least_sigma_px))

    options = least_squares.Options(np.inf, max_iterations, min_step=0.0, min_decrease=min_decrease)
    search = least_squares.Problem(
        lambda state: _linearised(problem, state, deviations_at(state)), partial(_retract, problem), rescaled
    )
    found = minimise(search, rescaled(start), options)
    state = found.state._replace(T_camera_world=orthonormalised(found.state.T_camera_world))
    if problem.correlated > 1:
        state = with_points(problem, state)
    return BundleSolution(state, log_depth_sigma(problem, state), found.iterations)


def errors_px(problem: BundleProblem, state: BundleState) -> np.ndarray:
    """Return the lengths of the reprojection errors (N,) of a state, px; infinite behind a camera."""
    if not len(problem.observations.point):
        return np.zeros(0)
    reprojection = reprojection_errors(problem, state)
    return np.where(reprojection.ahead, np.sqrt(dots(reprojection.error, reprojection.error)), np.inf)


def weights(state: BundleState, seen: Errors | Reprojection) -> np.ndarray:
    """Return the robust weights (N,) of the observations, 1/px^2."""
    square = dots(seen.error, seen.error) / state.sigma_px**2
    return np.where(seen.ahead, cauchy(square, CAUCHY)[1], 0) / state.sigma_px**2


def linearised(problem: BundleProblem, state: BundleState) -> ReducedModel:
    """Return the model of the cost around a state: unknowns of the keyframes, ln f if unknown, then the points."""
    return _linearised(problem, state, _deviations(problem, state))


def _linearised(problem: BundleProblem, state: BundleState, at: _Deviations) -> ReducedModel:
    return ReducedModel(
        problem.first_seen,
        problem.parts,
        _cost(problem, state, at),
        partial(_derivatives, problem, state),
        partial(_camera_priors, problem, state, at.edges),
        *_held_depths(problem, state),
        scale=problem.touched[1],
        free=problem.free,
        unknowns=problem.unknowns,
    )


def _held_depths(problem: BundleProblem, state: BundleState) -> tuple[np.ndarray, np.ndarray]:
    """Return how far ln depth of the points (P,) is from the estimate, and its weight."""
    points = problem.points
    off = state.log_depth - points.log_depth - state.log_scale[points.host]
    return off, cauchy((off / points.sigma) ** 2, CAUCHY)[1] / points.sigma**2


def _derivatives(problem: BundleProblem, state: BundleState, points: slice) -> Linear:
    """Return the derivatives of the observations of some points by the keyframes and ln f."""
    seen = reproject(problem, state, points)
    by, by_depth = jacobians(problem, state, points, seen)
    columns = problem.touched[0][problem.seen(points)]
    return Linear(columns, by, by_depth, seen.error, weights(state, seen) / problem.correlated)


def _cost(problem: BundleProblem, state: BundleState, at: _Deviations) -> float:
    """Return what is minimised, at a state."""
    points, priors, (seen, edges) = problem.points, problem.priors, at
    square = np.where(seen.ahead, dots(seen.error, seen.error) / state.sigma_px**2, _BEHIND)
    depth = (state.log_depth - points.log_depth - state.log_scale[points.host]) / points.sigma
    cost = cauchy(square, CAUCHY)[0].sum() / problem.correlated + cauchy(depth**2, CAUCHY)[0].sum()
    cost += 0.5 * (edges.information * edges.error**2).sum()
    if priors.scale > 0:
        cost += 0.5 * ((state.log_scale / priors.scale) ** 2).sum()
    if problem.log_focal_sigma is not None:
        cost += 0.5 * ((state.log_focal - problem.tracked.log_focal) / problem.log_focal_sigma) ** 2
    return float(cost)


class _OdometryEdges(NamedTuple):
    """Deviations of C pairs of keyframes from the tracked motion between them.

    pairs : (C, 2). error : (C, 6) twists. information : (6,) of each.
    """

    pairs: np.ndarray
    error: np.ndarray
    information: np.ndarray


class _Deviations(NamedTuple):
    """How far a state is from the observations, and from the tracked motion."""

    seen: Errors
    edges: _OdometryEdges


def _deviations(problem: BundleProblem, state: BundleState) -> _Deviations:
    return _Deviations(reprojection_errors(problem, state), _odometry_edges(problem, state))


def _odometry_edges(problem: BundleProblem, state: BundleState) -> _OdometryEdges:
    """Deviations from the tracked motion between neighbours."""
    priors, tracked, T = problem.priors, problem.T_camera_world, state.T_camera_world
    information = np.repeat([priors.rotation_rad, priors.translation_share * problem.unit_mm], 3) ** -2.0
    pairs = problem.neighbours.reshape(-1, 2)
    i, j = pairs.T
    return _OdometryEdges(pairs, se3_log(T[j] @ inverse(T[i]) @ tracked[i] @ inverse(tracked[j])), information)


def _camera_priors(problem: BundleProblem, state: BundleState, edges: _OdometryEdges) -> list[Prior]:
    """Return the normal equations of the priors of pairs of keyframes, of all scales, and of ln f."""
    T, unit, (i, j) = state.T_camera_world, np.repeat([1.0, problem.unit_mm], 3), edges.pairs.T
    own = PER_KEYFRAME * np.repeat(edges.pairs, 6, axis=1) + np.tile(np.arange(6), 2)
    by_i = -_adjoint(T[j] @ inverse(T[i]))
    J = np.concatenate([by_i, np.broadcast_to(np.eye(6), by_i.shape)], -1) * np.tile(unit, 2)
    weighted = J.swapaxes(1, 2) * edges.information
    priors = [Prior(own, weighted @ J, (weighted @ edges.error[..., None])[..., 0])]
    if problem.priors.scale > 0:
        information, own = np.full(len(T), problem.priors.scale**-2.0), 6 + PER_KEYFRAME * np.arange(len(T))
        priors.append(Prior(own[None], np.diag(information)[None], (information * state.log_scale)[None]))
    if problem.log_focal_sigma is not None:
        information, own = np.array([problem.log_focal_sigma**-2.0]), np.array([PER_KEYFRAME * len(T)])
        change = np.array([state.log_focal - problem.tracked.log_focal])
        priors.append(Prior(own[None], np.diag(information)[None], (information * change)[None]))
    return priors


def with_points(problem: BundleProblem, state: BundleState) -> BundleState:
    """Return the state with the points where all observations place them, keyframes held."""
    for _ in range(_POINT_STEPS):
        h, g = _by_points(problem, state)
        off, held = _held_depths(problem, state)
        step = -(g + held * off) / (h + held)
        state = state._replace(log_depth=state.log_depth - np.log(np.clip(1 - step, *_INVERSE_DEPTH_STEP)))
    return state


def log_depth_sigma(problem: BundleProblem, state: BundleState) -> np.ndarray:
    """Return the standard deviation of ln depth (P,) by the observations alone; infinite without any."""
    with np.errstate(divide="ignore"):
        return 1 / np.sqrt(_by_points(problem, state)[0])


def _by_points(problem: BundleProblem, state: BundleState) -> np.ndarray:
    """Return the second and the first derivatives (2, P) of the observations by ln depth of the points."""
    found, number = np.zeros((2, len(problem.points.host))), problem.observations.point
    for points in problem.parts:
        seen = reproject(problem, state, points)
        by_depth = jacobians(problem, state, points, seen, of_depth_alone=True)[1]
        weight = weights(state, seen)
        own, count = number[problem.seen(points)] - points.start, points.stop - points.start
        for row, by in zip(found, (by_depth, seen.error), strict=True):
            row[points] = np.bincount(own, weight * dots(by_depth, by), count)
    return found


def _adjoint(T: np.ndarray) -> np.ndarray:
    """Adjoints (..., 6, 6) of poses for twists of rotation first."""
    adjoint = np.zeros((*T.shape[:-2], 6, 6))
    adjoint[..., :3, :3] = adjoint[..., 3:, 3:] = T[..., :3, :3]
    adjoint[..., 3:, :3] = hat(T[..., :3, 3]) @ T[..., :3, :3]
    return adjoint


def _retract(problem: BundleProblem, state: BundleState, step: np.ndarray) -> BundleState:
    """Return the state after a step; points move along their rays in inverse depth, which parallax is linear in."""
    count = PER_KEYFRAME * len(state.T_camera_world)
    own = step[:count].reshape(-1, PER_KEYFRAME)
    twists = own[:, :6] * np.repeat([1.0, problem.unit_mm], 3)
    T = se3_exp(twists) @ state.T_camera_world
    log_focal = state.log_focal + (0.0 if problem.log_focal_sigma is None else float(step[count]))
    by_points = step[len(step) - len(state.log_depth) :]
    log_depth = state.log_depth - np.log(np.clip(1 - by_points, *_INVERSE_DEPTH_STEP))
    return BundleState(T, state.log_scale + own[:, 6], log_depth, log_focal, state.sigma_px)
