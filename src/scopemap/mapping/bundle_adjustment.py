"""Bundle adjustment: keyframe poses, a depth scale of each, the depth of every point and, if unknown, the lens.

A point p is on the ray of a pixel of its host keyframe h at depth exp(u_p). With T_h, T_t from world to camera it is
observed in another keyframe t at project(T_t T_h^-1 exp(u_p) ray_p):

    sum of rho(|projected - observed| / s) + sum of rho((u_p - ln depth_p - a_h) / sigma_p) + sum of (a_k / sigma_a)^2
    +  sum of |log(T_j T_i^-1 (T_j T_i^-1)_tracked^-1)|^2, weighted  +  sum of ((lens - expected) / sigma_lens)^2

rho is Cauchy's kernel and s the robust standard deviation of the reprojection errors. The second sum holds points to
the estimated depth, up to the keyframe's own factor exp(a_h); the third holds these factors to 1; the fourth holds a
keyframe j to its tracked motion from keyframe i; the last is for an unknown lens: ln of the focal length f and the
distortion b, by which a straight lens sees x (1 + b |x|^2 / w^2) where this one sees x, w half the image width. Dog-leg
with Schur complement: Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000; Lourakis and Argyros, ICCV 2005.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import sparse

from scopemap.geometry import least_squares
from scopemap.geometry.least_squares import cauchy, minimise, robust_sigma_2d
from scopemap.geometry.schur import CameraBlock, PointBlock, SchurModel
from scopemap.geometry.se3 import hat, inverse, orthonormalised, se3_exp, se3_log

_OWN = 7  # unknowns of a keyframe: rotation, translation, ln of its depth scale
_CAUCHY = 2.0  # residuals of that many standard deviations get half the weight
_BEHIND = 100.0  # squared residual, in variances, of a point behind the camera
_LEAST_Z, _LEAST_SLOPE = 1e-3, 0.1
_UNDISTORTION_STEPS = 6
_FARTHEST = 10.0  # half widths, beyond which Newton's method would diverge
_INVERSE_DEPTH_STEP = (0.1, 10.0)  # factor of the inverse depth in one step


@dataclass(frozen=True)
class Points:
    """P points, sorted by host.

    Attributes
    ----------
    host : (P,) int, number of the keyframe whose pixel they are. pixel : (P, 2) from the principal point, px, y times
    fx / fy. log_depth : (P,) ln of the estimated depth, mm. sigma : (P,) its standard deviation, so the relative error
    of the depth.
    """

    host: np.ndarray
    pixel: np.ndarray
    log_depth: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Observations:
    """N observations, sorted by point: point (N,) int, keyframe (N,) int, pixel (N, 2) as in `Points`."""

    point: np.ndarray
    keyframe: np.ndarray
    pixel: np.ndarray


@dataclass(frozen=True)
class Priors:
    """Standard deviations of what is known beforehand.

    scale : of ln of a keyframe's depth scale, 0 holds it. rotation_rad, translation_share : of the tracked motion
    between neighbouring keyframes, rad and share of the typical depth.
    """

    scale: float = 0.1
    rotation_rad: float = 0.05
    translation_share: float = 0.1


@dataclass(frozen=True)
class UnknownLens:
    """Prior of a lens: half_width_px of the image, standard deviations (2,) of ln f and of b; b is expected to be 0."""

    half_width_px: float
    sigma: np.ndarray


@dataclass(frozen=True)
class Problem:
    """What is adjusted.

    Attributes
    ----------
    T_camera_world : (K, 4, 4) as tracked. points, observations, priors : as named. neighbours : (C, 2) int, pairs of
    keyframes between which the motion was tracked. focal_px : fx, as expected where the lens is unknown. start : where
    to begin, None: as tracked. lens : None: the focal length is known. least_sigma_px : of the reprojection errors.
    """

    T_camera_world: np.ndarray
    points: Points
    observations: Observations
    priors: Priors
    neighbours: np.ndarray
    focal_px: float
    start: State | None = None
    lens: UnknownLens | None = None
    least_sigma_px: float = 0.1

    @property
    def unit_mm(self) -> float:
        """Typical depth, the unit of translations."""
        return float(np.exp(np.median(self.points.log_depth)))

    @property
    def tracked(self) -> State:
        """The state as tracked."""
        count, lens = len(self.T_camera_world), np.array([np.log(self.focal_px), 0.0])
        return State(self.T_camera_world, np.zeros(count), self.points.log_depth, lens)


class State(NamedTuple):
    """T_camera_world (K, 4, 4), ln of the depth scales (K,), ln of the depths (P,), lens (2,): ln f and b."""

    T_camera_world: np.ndarray
    log_scale: np.ndarray
    log_depth: np.ndarray
    lens: np.ndarray
    sigma_px: float = float("nan")


@dataclass(frozen=True)
class Solution:
    """Where the adjustment ended.

    Attributes
    ----------
    state : the first keyframe's pose as it was; sigma_px : robust standard deviation of the reprojection errors.
    log_depth_sigma : (P,) standard deviation of ln depth by the observations alone, keyframes held; infinite where no
    other keyframe observes a point. iterations : accepted and rejected.
    """

    state: State
    log_depth_sigma: np.ndarray
    iterations: int

    @property
    def sigma_px(self) -> float:
        """Robust standard deviation of the reprojection errors, px; NaN without observations."""
        return self.state.sigma_px


def adjust(problem: Problem, *, max_iterations: int = 20, min_decrease: float = 1e-3) -> Solution:
    """Return the solution that the search finds from the start; without observations everything stays as tracked.

    The scale of the reprojection errors is estimated anew after every accepted step: which are outliers is judged as
    the fit gets better.
    """
    start = problem.tracked if problem.start is None else problem.start
    if not len(problem.observations.point) or len(problem.T_camera_world) < 2:
        return Solution(problem.tracked, np.full(len(start.log_depth), np.inf), 0)

    def rescaled(state: State) -> State:
        reprojection = _reproject(problem, state)
        lengths = np.linalg.norm(reprojection.error[reprojection.ahead], axis=1)
        return state._replace(sigma_px=robust_sigma_2d(lengths, problem.least_sigma_px))

    options = least_squares.Options(np.inf, max_iterations, min_step=0.0, min_decrease=min_decrease)
    search = least_squares.Problem(partial(linearised, problem), partial(_retract, problem), rescaled)
    found = minimise(search, rescaled(start), options)
    state = found.state._replace(T_camera_world=np.stack([orthonormalised(T) for T in found.state.T_camera_world]))
    return Solution(state, _log_depth_sigma(problem, state), found.iterations)


def errors_px(problem: Problem, found: Solution) -> np.ndarray:
    """Return the lengths of the reprojection errors (N,), px; infinite behind a camera."""
    if not len(problem.observations.point):
        return np.zeros(0)
    reprojection = _reproject(problem, found.state)
    return np.where(reprojection.ahead, np.linalg.norm(reprojection.error, axis=1), np.inf)


class _Reprojection(NamedTuple):
    error: np.ndarray  # (N, 2) px, 0 behind the camera
    ahead: np.ndarray  # (N,) bool
    point: np.ndarray  # (N, 3) in the observing camera
    in_host: np.ndarray  # (N, 3) in the host's
    R: np.ndarray  # (N, 3, 3) from the host to the observing camera
    straight: np.ndarray  # (N, 2) px, through a lens without distortion


def _reproject(problem: Problem, state: State) -> _Reprojection:
    points, observations, T = problem.points, problem.observations, state.T_camera_world
    focal, host = np.exp(state.lens[0]), points.host[observations.point]
    rays = np.column_stack([_undistorted(problem, points.pixel, state.lens[1]) / focal, np.ones(len(points.host))])
    in_host = (np.exp(state.log_depth)[:, None] * rays)[observations.point]
    pairs, which = np.unique(host * len(T) + observations.keyframe, return_inverse=True)
    between = np.stack([T[pair % len(T)] @ inverse(T[pair // len(T)]) for pair in pairs])
    R = between[which, :3, :3]
    seen = np.einsum("nij,nj->ni", R, in_host) + between[which, :3, 3]
    ahead = seen[:, 2] > _LEAST_Z * np.linalg.norm(seen, axis=1)
    straight = focal * seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None]
    pixel = _distorted(problem, straight, state.lens[1])
    error = np.where(ahead[:, None], pixel - observations.pixel, 0.0)
    return _Reprojection(error, ahead, seen, in_host, R, straight)


def _square(problem: Problem, pixel: np.ndarray) -> np.ndarray:
    """Squared distance (n, 1) from the principal point in half widths; 0 where the lens is known."""
    if problem.lens is None:
        return np.zeros((len(pixel), 1))
    square: np.ndarray = (pixel**2).sum(1, keepdims=True) / problem.lens.half_width_px**2
    return square


def _undistorted(problem: Problem, pixel: np.ndarray, b: float) -> np.ndarray:
    undistorted: np.ndarray = pixel * (1 + b * _square(problem, pixel))
    return undistorted


def _distorted(problem: Problem, straight: np.ndarray, b: float) -> np.ndarray:
    """Return the pixels (n, 2) that `_undistorted` takes to `straight`, by Newton's method on the radius."""
    if problem.lens is None or b == 0:
        return straight
    radius = wanted = np.minimum(np.sqrt(_square(problem, straight)), _FARTHEST)
    for _ in range(_UNDISTORTION_STEPS):
        slope = np.maximum(1 + 3 * b * radius**2, _LEAST_SLOPE)
        radius = np.clip(radius - (radius * (1 + b * radius**2) - wanted) / slope, 0, _FARTHEST)
    return np.where(wanted > 0, radius / np.maximum(wanted, 1e-12), 1.0) * straight


def _weights(state: State, seen: _Reprojection) -> np.ndarray:
    return np.where(seen.ahead, cauchy((seen.error**2).sum(1) / state.sigma_px**2, _CAUCHY)[1], 0) / state.sigma_px**2


def linearised(problem: Problem, state: State) -> SchurModel:
    """Return the model of the cost around a state: unknowns of the keyframes, of the lens if unknown, of the points."""
    count, lens = len(state.T_camera_world), 0 if problem.lens is None else 2
    seen = _reproject(problem, state)
    chain = _chain(problem, state)
    held = [6 + _OWN * np.arange(count)] if problem.priors.scale == 0 else []
    free = np.setdiff1d(np.arange(_OWN * count + lens), np.concatenate([np.arange(6), *held]))

    def build() -> tuple[list[PointBlock], list[CameraBlock]]:
        parts = _Rows(seen.error, _weights(state, seen), *_jacobians(problem, state, seen))
        hosts = [_host_block(problem, state, host, parts) for host in np.unique(problem.points.host)]
        return hosts, _camera_blocks(problem, state, chain)

    return SchurModel(_cost(problem, state, seen, chain), build, free, _OWN * count + lens, len(state.log_depth))


def _cost(problem: Problem, state: State, seen: _Reprojection, chain: list[_Link]) -> float:
    points, priors = problem.points, problem.priors
    square = np.where(seen.ahead, (seen.error**2).sum(1) / state.sigma_px**2, _BEHIND)
    depth = (state.log_depth - points.log_depth - state.log_scale[points.host]) / points.sigma
    cost = cauchy(square, _CAUCHY)[0].sum() + cauchy(depth**2, _CAUCHY)[0].sum()
    cost += 0.5 * sum(float(link.error @ (link.information * link.error)) for link in chain)
    if priors.scale > 0:
        cost += 0.5 * ((state.log_scale / priors.scale) ** 2).sum()
    if problem.lens is not None:
        cost += 0.5 * (((state.lens - problem.tracked.lens) / problem.lens.sigma) ** 2).sum()
    return float(cost)


class _Link(NamedTuple):
    i: int
    j: int
    error: np.ndarray  # (6,) twist
    information: np.ndarray  # (6,)


def _chain(problem: Problem, state: State) -> list[_Link]:
    """Deviations from the tracked motion between neighbours."""
    priors, tracked, T = problem.priors, problem.T_camera_world, state.T_camera_world
    information = np.repeat([priors.rotation_rad, priors.translation_share * problem.unit_mm], 3) ** -2.0
    return [
        _Link(i, j, se3_log(T[j] @ inverse(T[i]) @ tracked[i] @ inverse(tracked[j])), information)
        for i, j in problem.neighbours
    ]


def _camera_blocks(problem: Problem, state: State, chain: list[_Link]) -> list[CameraBlock]:
    T, unit, blocks = state.T_camera_world, np.repeat([1.0, problem.unit_mm], 3), []
    for i, j, error, information in chain:
        own = np.append(_OWN * i + np.arange(6), _OWN * j + np.arange(6))
        J = np.hstack([-_adjoint(T[j] @ inverse(T[i])), np.eye(6)]) * np.tile(unit, 2)
        blocks.append(CameraBlock(own, J.T @ (information[:, None] * J), J.T @ (information * error)))
    if problem.priors.scale > 0:
        information = np.full(len(T), problem.priors.scale**-2.0)
        blocks.append(CameraBlock(6 + _OWN * np.arange(len(T)), np.diag(information), information * state.log_scale))
    if problem.lens is not None:
        information, own = problem.lens.sigma**-2.0, _OWN * len(T) + np.arange(2)
        blocks.append(CameraBlock(own, np.diag(information), information * (state.lens - problem.tracked.lens)))
    return blocks


class _Rows(NamedTuple):
    """What is summed over observations: derivatives by the observing camera, the host, ln depth and the lens."""

    error: np.ndarray  # (N, 2)
    weight: np.ndarray  # (N,)
    by_camera: np.ndarray  # (N, 2, 6)
    by_host: np.ndarray  # (N, 2, 6)
    by_depth: np.ndarray  # (N, 2)
    by_lens: np.ndarray  # (N, 2, 2), or (N, 2, 0)


def _host_block(problem: Problem, state: State, host: int, parts: _Rows) -> PointBlock:
    """Return the normal equations of the points of one host."""
    points, observations = problem.points, problem.observations
    here = slice(*np.searchsorted(points.host, (host, host + 1)))
    some = slice(*np.searchsorted(observations.point, (here.start, here.stop)))
    error, weight, by_camera, by_host, by_depth, by_lens = (part[some] for part in parts)
    keyframes = np.union1d(observations.keyframe[some], host)
    size, count, at = len(error), here.stop - here.start, int(np.searchsorted(keyframes, host))
    J: np.ndarray = np.zeros((size, 2, len(keyframes), _OWN))
    J[np.arange(size), :, np.searchsorted(keyframes, observations.keyframe[some]), :6] = by_camera
    J[:, :, at, :6] += by_host
    J = np.concatenate([J.reshape(size, 2, _OWN * len(keyframes)), by_lens], -1)
    rows = J.reshape(2 * size, J.shape[-1])
    A = rows.T @ (np.repeat(weight, 2)[:, None] * rows)
    number = observations.point[some] - here.start
    h, g = (np.bincount(number, weight * (by_depth * by).sum(1), count) for by in (by_depth, error))
    place = (np.repeat(number, 2), np.arange(2 * size))
    E, scores = (
        sparse.csr_matrix(((weight[:, None] * by).ravel(), place), shape=(count, 2 * size)) @ rows
        for by in (by_depth, error)
    )
    # The prior of the estimated depth, up to the host's scale.
    off, column = state.log_depth[here] - points.log_depth[here] - state.log_scale[host], _OWN * at + 6
    held = cauchy((off / points.sigma[here]) ** 2, _CAUCHY)[1] / points.sigma[here] ** 2
    E[:, column] -= held
    A[column, column] += held.sum()
    scores[:, column] -= held * off
    columns = (_OWN * keyframes[:, None] + np.arange(_OWN)).ravel()
    columns = np.append(columns, _OWN * len(state.T_camera_world) + np.arange(by_lens.shape[2]))
    return PointBlock(columns, A, scores, here, h + held, g + held * off, E)


def _log_depth_sigma(problem: Problem, state: State) -> np.ndarray:
    seen = _reproject(problem, state)
    by_depth = _jacobians(problem, state, seen)[2]
    information = _weights(state, seen) * (by_depth**2).sum(1)
    with np.errstate(divide="ignore"):
        return 1 / np.sqrt(np.bincount(problem.observations.point, information, len(state.log_depth)))


def _jacobians(
    problem: Problem, state: State, seen: _Reprojection
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of pixels as in `_Rows`; translations are in units of the typical depth."""
    focal, b = np.exp(state.lens[0]), state.lens[1]
    z = np.where(seen.ahead, seen.point[:, 2], 1.0)
    by_point = np.zeros((len(z), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = focal / z
    by_point[:, :, 2] = -seen.straight / z[:, None]
    by_lens = np.zeros((len(z), 2, 0))
    if problem.lens is not None:
        pixel = seen.error + problem.observations.pixel
        by_straight = _by_straight(problem, pixel, b)
        by_point = by_straight @ by_point
        in_host = problem.points.pixel[problem.observations.point]
        by_corner = (by_point @ seen.R)[..., :2] * (seen.in_host[:, 2] / focal)[:, None, None]
        by_focal = by_straight @ seen.straight[..., None]
        by_focal -= by_corner @ _undistorted(problem, in_host, b)[..., None]
        by_b = by_corner @ (in_host * _square(problem, in_host))[..., None]
        by_b -= by_straight @ (pixel * _square(problem, pixel))[..., None]
        by_lens = np.concatenate([by_focal, by_b], -1)
    by_host = by_point @ seen.R
    by_depth = np.einsum("nij,nj->ni", by_host, seen.in_host)
    unit_mm = problem.unit_mm
    return _by_twist(by_point, seen.point, unit_mm), -_by_twist(by_host, seen.in_host, unit_mm), by_depth, by_lens


def _by_straight(problem: Problem, pixel: np.ndarray, b: float) -> np.ndarray:
    """Derivative (n, 2, 2) of `_distorted` where it leads to `pixel`: the inverse of that of `_undistorted`."""
    assert problem.lens is not None
    square = _square(problem, pixel)[..., None]
    factor = np.maximum(1 + b * square, _LEAST_SLOPE)
    outer = 2 * b * pixel[:, :, None] * pixel[:, None, :] / problem.lens.half_width_px**2
    by_straight: np.ndarray = (np.eye(2) - outer / np.maximum(factor + 2 * b * square, _LEAST_SLOPE)) / factor
    return by_straight


def _by_twist(by_point: np.ndarray, points: np.ndarray, unit_mm: float) -> np.ndarray:
    """Derivative (N, 2, 6) by a twist (rotation, translation) of points (N, 3), from that by the points (N, 2, 3)."""
    # d(exp(w) X)/dw = -hat(X), and a row vector times -hat(X) is the cross product X x row.
    return np.concatenate([np.cross(points[:, None], by_point), unit_mm * by_point], -1)


def _adjoint(T: np.ndarray) -> np.ndarray:
    """Adjoint (6, 6) of a pose for twists of rotation first."""
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = T[:3, :3]
    adjoint[3:, :3] = hat(T[:3, 3]) @ T[:3, :3]
    return adjoint


def _retract(problem: Problem, state: State, step: np.ndarray) -> State:
    """Return the state after a step; points move along their rays in inverse depth, which parallax is linear in."""
    count = _OWN * len(state.T_camera_world)
    own = step[:count].reshape(-1, _OWN)
    twists = own[:, :6] * np.repeat([1.0, problem.unit_mm], 3)
    T = np.stack([se3_exp(twist) @ pose for twist, pose in zip(twists, state.T_camera_world, strict=True)])
    lens = state.lens if problem.lens is None else state.lens + step[count : count + 2]
    by_points = step[len(step) - len(state.log_depth) :]
    log_depth = state.log_depth - np.log(np.clip(1 - by_points, *_INVERSE_DEPTH_STEP))
    return State(T, state.log_scale + own[:, 6], log_depth, lens, state.sigma_px)
