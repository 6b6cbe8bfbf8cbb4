"""Bundle adjustment of keyframes: poses, one depth scale each, and the depth of every point that others see again.

A point p lies on the ray of a pixel of its host keyframe h at depth exp(u_p). With T_h, T_t from world to camera it is
seen in another keyframe t at project(T_t T_h^-1 exp(u_p) ray_p), which is compared with where optical flow saw it:

    sum of rho(|seen - flow| / s)  +  sum of rho((u_p - ln depth_p - a_h) / sigma_p)  +  sum of (a_k / sigma_a)^2
    +  sum of |log(T_j T_i^-1 (T_j T_i^-1)_tracked^-1)|^2, weighted

The second sum holds points to the estimated depth, up to the keyframe's own factor exp(a_h); the third holds these
factors to 1; the last holds a keyframe j to what the tracker said of it, from keyframe i, where nothing else does. rho
is Cauchy's, so tissue that moves on its own fades out. Levenberg-Marquardt; points are eliminated one by one (Schur
complement), host by host, since all points of a host touch the same few keyframes. Triggs et al., "Bundle Adjustment -
A Modern Synthesis", 2000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from scopemap.geometry.least_squares import robust_sigma_2d
from scopemap.geometry.se3 import hat, inverse, orthonormalised, se3_exp, se3_log

_OWN = 7  # unknowns of a keyframe: rotation, translation, ln of its depth scale
_CAUCHY = 2.0  # residuals of that many standard deviations count half
_LEAST_SIGMA_PX = 0.1
_LEAST_Z = 1e-3


@dataclass(frozen=True)
class Points:
    """P points, sorted by host.

    Attributes
    ----------
    host : (P,) int, number of the keyframe whose pixel they are. rays : (P, 3), z = 1. log_depth : (P,) ln of the
    estimated depth, mm. sigma : (P,) its standard deviation, so the relative error of the depth.
    """

    host: np.ndarray
    rays: np.ndarray
    log_depth: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Sightings:
    """N places where points are seen again, sorted by point: point (N,) int, keyframe (N,) int, pixel (N, 2)."""

    point: np.ndarray
    keyframe: np.ndarray
    pixel: np.ndarray


@dataclass(frozen=True)
class Priors:
    """How much is believed beforehand, as standard deviations.

    scale : of ln of a keyframe's depth scale. turn_rad, way_share : of the tracked motion between neighbouring
    keyframes, rad and share of the mean depth.
    """

    scale: float = 0.1
    turn_rad: float = 0.05
    way_share: float = 0.1


@dataclass(frozen=True)
class Problem:
    """What is adjusted: intrinsics (4,) fx, fy, cx, cy, px; T_camera_world (K, 4, 4) as tracked; the rest as named.

    neighbours : (C, 2) int, pairs of keyframes whose motion from the first to the second was tracked. start : poses
    T_camera_world (K, 4, 4) and ln of the depth scales (K,) to begin from; None: from what was tracked.
    """

    intrinsics: np.ndarray
    T_camera_world: np.ndarray
    points: Points
    sightings: Sightings
    priors: Priors
    neighbours: np.ndarray
    start: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(frozen=True)
class Solution:
    """Where the adjustment ended.

    Attributes
    ----------
    T_camera_world : (K, 4, 4), the first as it was. log_scale : (K,) ln of each keyframe's depth scale.
    log_depth : (P,). log_depth_sigma : (P,) its standard deviation by the sightings alone, keyframes held; infinite
    where nothing sees a point again. sigma_px : robust standard deviation of the sightings, px. iterations : accepted
    and refused.
    """

    T_camera_world: np.ndarray
    log_scale: np.ndarray
    log_depth: np.ndarray
    log_depth_sigma: np.ndarray
    sigma_px: float
    iterations: int


class _State(NamedTuple):
    T: np.ndarray
    scale: np.ndarray
    u: np.ndarray


class _System(NamedTuple):
    """Reduced system of the keyframes, and what is needed to get back to the points."""

    matrix: sparse.csc_matrix
    rhs: np.ndarray
    couplings: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]  # points, columns, E / h, g / h


def adjust(problem: Problem, *, most_iterations: int = 20, least_gain: float = 1e-3) -> Solution:
    """Return the solution that the search finds from the start; without sightings everything stays as it was tracked.

    A step is taken where it lowers the cost at the scale of residuals before it; that scale is then estimated anew.
    """
    count = len(problem.T_camera_world)
    state = _State(problem.T_camera_world.copy(), np.zeros(count), problem.points.log_depth.copy())
    if not len(problem.sightings.point) or count < 2:
        return Solution(state.T, state.scale, state.u, np.full(len(state.u), np.inf), float("nan"), 0)
    if problem.start is not None:
        T, scale = problem.start
        state = _State(T.copy(), scale.copy(), state.u + scale[problem.points.host])
    damping, iterations = 1e-4, 0
    sigma = _sigma_px(problem, state)
    cost = _cost(problem, state, sigma)
    while iterations < most_iterations:
        iterations += 1
        candidate = _moved(problem, state, _linearised(problem, state, sigma, damping))
        ahead = _cost(problem, candidate, sigma)
        if not ahead < cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        gain = 1 - ahead / cost
        state, damping = candidate, max(damping / 10, 1e-9)
        # What counts as an outlier is judged anew as the fit gets better.
        sigma = _sigma_px(problem, state)
        cost = _cost(problem, state, sigma)
        if gain < least_gain:
            break
    T = np.stack([orthonormalised(pose) for pose in state.T])
    return Solution(T, state.scale, state.u, _log_depth_sigma(problem, state, sigma), sigma, iterations)


def errors_px(problem: Problem, found: Solution) -> np.ndarray:
    """Return how far points are seen from where the solution says (N,), px; infinite behind a camera."""
    if not len(problem.sightings.point):
        return np.zeros(0)
    error, ahead = _errors(problem, _seen(problem, _State(found.T_camera_world, found.log_scale, found.log_depth))[0])
    return np.where(ahead, np.linalg.norm(error, axis=1), np.inf)


def _seen(problem: Problem, state: _State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in the keyframes that see them and in their hosts, (N, 3) each, and the turn between, (N, 3, 3)."""
    points, sightings = problem.points, problem.sightings
    host = points.host[sightings.point]
    in_host = np.exp(state.u)[sightings.point, None] * points.rays[sightings.point]
    pairs, which = np.unique(host * len(state.T) + sightings.keyframe, return_inverse=True)
    between = np.stack([state.T[pair % len(state.T)] @ inverse(state.T[pair // len(state.T)]) for pair in pairs])
    turn = between[which, :3, :3]
    return np.einsum("nij,nj->ni", turn, in_host) + between[which, :3, 3], in_host, turn


def _errors(problem: Problem, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Difference (N, 2) px of where points are seen and where flow saw them, and whether (N,) they can be seen."""
    fx, fy, cx, cy = problem.intrinsics
    ahead = seen[:, 2] > _LEAST_Z * np.linalg.norm(seen, axis=1)
    z = np.where(ahead, seen[:, 2], 1.0)
    pixel = np.stack([fx * seen[:, 0] / z + cx, fy * seen[:, 1] / z + cy], 1)
    return np.where(ahead[:, None], pixel - problem.sightings.pixel, 0.0), ahead


def _sigma_px(problem: Problem, state: _State) -> float:
    error, ahead = _errors(problem, _seen(problem, state)[0])
    return robust_sigma_2d(np.linalg.norm(error[ahead], axis=1), _LEAST_SIGMA_PX)


def _cauchy(square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cost and weight of squared residuals in units of their variance."""
    ratio = square / _CAUCHY**2
    return 0.5 * _CAUCHY**2 * np.log1p(ratio), 1 / (1 + ratio)


def _cost(problem: Problem, state: _State, sigma: float) -> float:
    error, ahead = _errors(problem, _seen(problem, state)[0])
    points, priors = problem.points, problem.priors
    # A point behind a camera has no residual: it costs as much as one ten standard deviations off.
    square = np.where(ahead, (error**2).sum(1) / sigma**2, 100.0)
    depth = (state.u - points.log_depth - state.scale[points.host]) / points.sigma
    chain = sum(float(e @ (weight * e)) for *_, e, weight in _chain(problem, state))
    return float(_cauchy(square)[0].sum() + _cauchy(depth**2)[0].sum() + 0.5 * chain) + 0.5 * float(
        ((state.scale / priors.scale) ** 2).sum()
    )


def _chain(problem: Problem, state: _State) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
    """For each pair of neighbours: their numbers, how far the motion between is from the tracked one, weights."""
    priors, tracked = problem.priors, problem.T_camera_world
    depth_mm = float(np.exp(np.median(problem.points.log_depth)))
    weight = np.repeat([priors.turn_rad, priors.way_share * depth_mm], 3) ** -2.0
    return [
        (i, j, se3_log(state.T[j] @ inverse(state.T[i]) @ tracked[i] @ inverse(tracked[j])), weight)
        for i, j in problem.neighbours
    ]


def _linearised(problem: Problem, state: _State, sigma: float, damping: float) -> _System:
    """Return the reduced system around a state; `sigma` px scales the sightings' errors, `damping` is Marquardt's."""
    count = len(state.T)
    seen, in_host, turn = _seen(problem, state)
    error, ahead = _errors(problem, seen)
    weight = np.where(ahead, _cauchy((error**2).sum(1) / sigma**2)[1], 0.0) / sigma**2
    by_twists = _jacobians(problem.intrinsics, seen, in_host, turn, ahead)
    blocks: list[tuple[np.ndarray, np.ndarray]] = []
    rhs = np.zeros(_OWN * count)
    couplings = []
    for host in range(count):
        sums = _host_sums(problem, state, host, (error, weight, *by_twists))
        h = sums.h * (1 + damping)
        shrunk = sums.E / h[:, None]
        blocks.append((sums.own, sums.A - sums.E.T @ shrunk))
        rhs[sums.own] -= sums.b - shrunk.T @ sums.g
        couplings.append((sums.points, sums.own, shrunk, sums.g / h))
    for i, j, off, information in _chain(problem, state):
        own = np.append(_OWN * i + np.arange(6), _OWN * j + np.arange(6))
        J = np.hstack([-_adjoint(state.T[j] @ inverse(state.T[i])), np.eye(6)])
        blocks.append((own, J.T @ (information[:, None] * J)))
        rhs[own] -= J.T @ (information * off)
    scales, information = _OWN * np.arange(count) + 6, problem.priors.scale**-2.0
    blocks += [(scales[k : k + 1], np.full((1, 1), information)) for k in range(count)]
    rhs[scales] -= information * state.scale
    rows, columns = (np.concatenate([way(own, len(own)) for own, _ in blocks]) for way in (np.repeat, np.tile))
    values = np.concatenate([block.ravel() for _, block in blocks])
    matrix = sparse.coo_matrix((values, (rows, columns)), shape=(_OWN * count,) * 2).tocsc()
    return _System(matrix + sparse.diags(damping * matrix.diagonal()), rhs, couplings)


class _HostSums(NamedTuple):
    """The normal equations of one host's points before they are eliminated.

    own : (m,) numbers of the keyframes' unknowns that its points touch; A : (m, m) and b : (m,) theirs. points : (n,)
    numbers; h, g : (n,) their own second and first derivative. E : (n, m) both.
    """

    own: np.ndarray
    A: np.ndarray
    b: np.ndarray
    points: np.ndarray
    h: np.ndarray
    g: np.ndarray
    E: np.ndarray


def _host_sums(problem: Problem, state: _State, host: int, parts: tuple[np.ndarray, ...]) -> _HostSums:
    """Sum over the points of one host; `parts` are errors, weights and derivatives of all sightings."""
    points, sightings = problem.points, problem.sightings
    here = slice(*np.searchsorted(points.host, (host, host + 1)))
    some = slice(*np.searchsorted(sightings.point, (here.start, here.stop)))
    error, weight, by_seeing, by_host, by_depth = (part[some] for part in parts)
    keyframes = np.union1d(sightings.keyframe[some], host)
    size, count, at = len(error), here.stop - here.start, int(np.searchsorted(keyframes, host))
    J: np.ndarray = np.zeros((size, 2, len(keyframes), _OWN))
    J[np.arange(size), :, np.searchsorted(keyframes, sightings.keyframe[some]), :6] = by_seeing
    J[:, :, at, :6] += by_host
    J = J.reshape(size, 2, _OWN * len(keyframes))
    rows, information = J.reshape(2 * size, J.shape[-1]), np.repeat(weight, 2)
    A, b = rows.T @ (information[:, None] * rows), rows.T @ (information * error.ravel())
    number = sightings.point[some] - here.start
    h, g = (np.bincount(number, weight * (by_depth * by).sum(1), count) for by in (by_depth, error))
    E = np.zeros((count, len(rows.T)))
    np.add.at(E, number, weight[:, None] * np.einsum("nj,njk->nk", by_depth, J))
    # The points' hold on their estimated depth, up to the host's scale.
    off = state.u[here] - points.log_depth[here] - state.scale[host]
    hold = _cauchy((off / points.sigma[here]) ** 2)[1] / points.sigma[here] ** 2
    scale = _OWN * at + 6
    h, g = h + hold, g + hold * off
    E[:, scale] -= hold
    A[scale, scale] += hold.sum()
    b[scale] -= (hold * off).sum()
    own = (_OWN * keyframes[:, None] + np.arange(_OWN)).ravel()
    return _HostSums(own, A, b, np.arange(here.start, here.stop), h, g, E)


def _log_depth_sigma(problem: Problem, state: _State, sigma: float) -> np.ndarray:
    """Standard deviation of each point's ln depth (P,) by where it is seen again, all keyframes held."""
    seen, in_host, turn = _seen(problem, state)
    error, ahead = _errors(problem, seen)
    weight = np.where(ahead, _cauchy((error**2).sum(1) / sigma**2)[1], 0.0) / sigma**2
    by_depth = _jacobians(problem.intrinsics, seen, in_host, turn, ahead)[2]
    information = np.bincount(problem.sightings.point, weight * (by_depth**2).sum(1), len(state.u))
    with np.errstate(divide="ignore"):
        return 1 / np.sqrt(information)


def _jacobians(
    intrinsics: np.ndarray, seen: np.ndarray, in_host: np.ndarray, turn: np.ndarray, ahead: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of pixels by twists of the seeing keyframe and of the host, (N, 2, 6), and by ln depth, (N, 2)."""
    fx, fy = intrinsics[:2]
    z = np.where(ahead, seen[:, 2], 1.0)
    project = np.zeros((len(seen), 2, 3))
    project[:, 0, 0], project[:, 1, 1] = fx / z, fy / z
    project[:, 0, 2], project[:, 1, 2] = -fx * seen[:, 0] / z**2, -fy * seen[:, 1] / z**2
    by_host = project @ turn
    by_depth = np.einsum("nij,nj->ni", by_host, in_host)
    return _by_twist(project, seen), -_by_twist(by_host, in_host), by_depth


def _by_twist(by_point: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Derivative (N, 2, 6) by a twist (rotation, translation) of points (N, 3), from that by the points (N, 2, 3)."""
    # d(exp(w) X)/dw = -hat(X), and a row vector times -hat(X) is the cross product X x row.
    return np.concatenate([np.cross(points[:, None], by_point), by_point], -1)


def _adjoint(T: np.ndarray) -> np.ndarray:
    """Adjoint (6, 6) of a pose for twists of rotation first."""
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = T[:3, :3]
    adjoint[3:, :3] = hat(T[:3, 3]) @ T[:3, :3]
    return adjoint


def _moved(problem: Problem, state: _State, system: _System) -> _State:
    """Return the state after the step that the system asks for; the first keyframe stays."""
    free = np.setdiff1d(np.arange(len(system.rhs)), np.arange(6))
    step = np.zeros(len(system.rhs))
    step[free] = splu(system.matrix[free][:, free].tocsc()).solve(system.rhs[free])
    own = step.reshape(-1, _OWN)
    u = state.u.copy()
    for points, columns, shrunk, gradient in system.couplings:
        u[points] -= gradient + shrunk @ step[columns]
    T = np.stack([se3_exp(twist) @ pose for twist, pose in zip(own[:, :6], state.T, strict=True)])
    return _State(T, state.scale + own[:, 6], u)
