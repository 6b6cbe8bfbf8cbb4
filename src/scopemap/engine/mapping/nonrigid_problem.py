"""Bundle adjustment with tissue that moves: the rigid problem, and modes and curves of a deformation graph.

To the cost of `bundle_adjustment` come the priors of the modes and of the curves. Unknowns of the reduced system are
those of the keyframes, the modes, axis by axis, and the curves unless they are given. Points are eliminated one by one,
since each touches few nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from scopemap.engine.geometry import least_squares
from scopemap.engine.geometry.least_squares import CameraBlock, cauchy, minimise, robust_sigma_2d
from scopemap.engine.geometry.skinning import Skin
from scopemap.engine.mapping.bundle_adjustment import (
    CAUCHY,
    PER_KEYFRAME,
    camera_blocks,
    cost,
    odometry_edges,
    retract,
    weights,
)
from scopemap.engine.mapping.bundle_problem import BundleProblem, Reprojection, State, jacobians, reproject

_RIDGE = 1e-9  # guard: of the diagonal
# Of nodes that move step by step only the curve is needed, which is found long before them.
_MAX_ITERATIONS = 20  # by hand
_FOR_CURVE = 6  # by hand
_MIN_DECREASE = 1e-3  # by hand: relative, of the cost, that ends the adjustment
_CURVE_SIGMA = 0.3  # by hand: prior standard deviation of a curve, whose largest value is 1


@dataclass(frozen=True)
class NonRigidProblem:
    """What is adjusted: `rigid`, and the modes of a deformation with these nodes (N, 3) and curves `basis` (K, L).

    skin : of the points of `rigid`. prior : (L N, L N), normal matrix of one axis of the modes. free : whether the
    curves are adjusted, near `basis`.
    """

    rigid: BundleProblem
    nodes: np.ndarray
    basis: np.ndarray
    skin: Skin
    prior: sparse.csr_matrix
    free: bool = False

    @property
    def curve_unknowns(self) -> int:
        """Number of unknowns of the curves, curve by curve."""
        return self.basis.size if self.free else 0

    def moved(self, modes: np.ndarray, basis: np.ndarray) -> np.ndarray:
        """Return by how much (N, 3) mm the point of each observation has moved since its host saw it."""
        seen, hosts = self.rigid.observations, self.rigid.points.host
        change = basis[seen.keyframe] - basis[hosts[seen.point]]
        return np.einsum("nl,nlc->nc", change, self.at_points(modes)[seen.point])

    def at_points(self, modes: np.ndarray) -> np.ndarray:
        """Return the displacement (P, L, 3) mm of the points where each curve is 1."""
        return self.skin.displaced(modes).transpose(1, 0, 2)


class NonRigidState(NamedTuple):
    """Keyframes and points, the modes (L, N, 3) mm of the nodes, and their curves (K, L)."""

    rigid: State
    modes: np.ndarray
    basis: np.ndarray


def solve(problem: NonRigidProblem, start: NonRigidState) -> NonRigidState:
    """Return the state that the search finds from a start; the first keyframe keeps its pose."""

    def rescaled(state: NonRigidState) -> NonRigidState:
        seen = reproject(problem.rigid, state.rigid, problem.moved(state.modes, state.basis))
        lengths_px = np.linalg.norm(seen.error[seen.ahead], axis=1)
        sigma_px = robust_sigma_2d(lengths_px, problem.rigid.least_sigma_px)
        return state._replace(rigid=state.rigid._replace(sigma_px=sigma_px))

    most = _MAX_ITERATIONS if problem.free else _FOR_CURVE
    options = least_squares.Options(np.inf, most, min_step=0.0, min_decrease=_MIN_DECREASE)
    search = least_squares.Problem(partial(NonRigidModel, problem), partial(retracted, problem), rescaled)
    return minimise(search, rescaled(start), options).state


def retracted(problem: NonRigidProblem, state: NonRigidState, step: np.ndarray) -> NonRigidState:
    """Return the state after a step of the unknowns (N,), in the order of `NonRigidModel.gradient`."""
    first = PER_KEYFRAME * len(state.rigid.T_camera_world)
    end = first + state.modes.size
    last = end + problem.curve_unknowns
    rigid = retract(problem.rigid, state.rigid, np.append(step[:first], step[last:]))
    basis = state.basis + step[end:last].reshape(state.basis.T.shape).T if problem.free else state.basis
    return NonRigidState(rigid, state.modes + _modes_of(step[first:end], state.modes.shape), basis)


def _modes_of(unknowns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return modes (L, N, 3) of their unknowns, which are in the order axis, mode, node."""
    return unknowns.reshape(3, *shape[:2]).transpose(1, 2, 0)


class _Linear(NamedTuple):
    """Derivatives and weights of all observations; of points, ln depth's error and weight of the estimate.

    columns : unknowns (N, U) that an observation touches beside its point. by : (N, 2, U) px.
    """

    columns: np.ndarray
    by: np.ndarray
    by_depth: np.ndarray  # (N, 2)
    error: np.ndarray  # (N, 2) px
    weight: np.ndarray  # (N,)
    off: np.ndarray  # (P,)
    held: np.ndarray  # (P,)


class NonRigidModel:
    """Model of the cost around a state; steps are keyframes, modes, curve, points."""

    def __init__(self, problem: NonRigidProblem, state: NonRigidState) -> None:
        self._problem, self._state, rigid = problem, state, problem.rigid
        self._first = PER_KEYFRAME * len(state.rigid.T_camera_world)
        self._end = self._first + state.modes.size
        self._unknowns = self._end + problem.curve_unknowns
        self._modes = state.modes.transpose(2, 0, 1).reshape(3, -1)
        self._seen: Reprojection = reproject(rigid, state.rigid, problem.moved(state.modes, state.basis))
        self._edges = odometry_edges(rigid, state.rigid)
        self._off = state.rigid.log_depth - rigid.points.log_depth - state.rigid.log_scale[rigid.points.host]
        self.cost = cost(rigid, state.rigid, self._seen, self._edges) + 0.5 * self._stiffness(self._modes)
        if problem.free:
            self.cost += 0.5 * float((((state.basis - problem.basis) / _CURVE_SIGMA) ** 2).sum())

    def _stiffness(self, modes: np.ndarray) -> float:
        return float((modes.T * (self._problem.prior @ modes.T)).sum())

    @cached_property
    def _linear(self) -> _Linear:
        problem, rigid, state = self._problem, self._problem.rigid, self._state.rigid
        observer, points = rigid.observations.keyframe, rigid.observations.point
        host, basis = rigid.points.host[points], self._state.basis
        by_camera, by_host, by_depth, _ = jacobians(rigid, state, self._seen)
        # Px / mm of the point's motion in the world.
        by_world = by_camera[:, :, 3:] / rigid.unit_mm @ state.T_camera_world[observer, :3, :3]
        own, first = np.arange(6), PER_KEYFRAME * np.column_stack([observer, host])
        columns, by = [first[:, :1] + own, first[:, 1:] + own], [by_camera, by_host]
        # Of many curves an observation touches those that differ between its keyframe and the host.
        change = basis[observer] - basis[host]
        most = max(int((change != 0).sum(1).max(initial=0)), 1)
        curve = np.argsort(change == 0, axis=1, kind="stable")[:, :most]
        share = np.take_along_axis(change, curve, 1)[:, None, :, None] * problem.skin.weight[points][:, None, None]
        axis = np.arange(3)[:, None, None] * basis.shape[1]
        place = (axis + curve[:, None, :, None]) * len(problem.nodes) + problem.skin.node[points][:, None, None]
        columns.append(self._first + place.reshape(len(points), -1))
        by.append((by_world[..., None, None] * share[:, None]).reshape(len(points), 2, -1))
        if problem.free:
            start = self._end + np.arange(basis.shape[1]) * len(basis)
            by_curve = by_world @ problem.at_points(self._state.modes)[points].transpose(0, 2, 1)
            columns += [start + observer[:, None], start + host[:, None]]
            by += [by_curve, -by_curve]
        weight = weights(state, self._seen) / rigid.correlated
        held = cauchy((self._off / rigid.points.sigma) ** 2, CAUCHY)[1] / rigid.points.sigma**2
        return _Linear(np.hstack(columns), np.dstack(by), by_depth, self._seen.error, weight, self._off, held)

    @cached_property
    def _priors(self) -> list[CameraBlock]:
        blocks = camera_blocks(self._problem.rigid, self._state.rigid, self._edges)
        if self._problem.free:
            off = (self._state.basis - self._problem.basis).T.ravel() / _CURVE_SIGMA**2
            own = np.arange(self._end, self._unknowns)
            blocks.append(CameraBlock(own, np.identity(len(own)) / _CURVE_SIGMA**2, off))
        return blocks

    def _change(self, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what a step without its points changes: all observations (N, 2), and ln scale at points (P,)."""
        scale = step[PER_KEYFRAME * self._problem.rigid.points.host + 6]
        return np.einsum("nau,nu->na", self._linear.by, step[self._linear.columns]), scale

    @cached_property
    def _normal(self) -> _Normal:
        """Normal equations with the points eliminated; the first keyframe's pose is held."""
        problem, points, seen = self._problem, self._problem.rigid.points, self._problem.rigid.observations
        normal = _Normal(
            np.zeros((self._unknowns, self._unknowns)), *np.zeros((2, self._unknowns)), *np.zeros((2, len(points.host)))
        )
        start = np.searchsorted(seen.point, np.arange(len(points.host) + 1))
        _add_points(normal, start, PER_KEYFRAME * points.host + 6, self._linear)
        for prior in self._priors:
            normal.matrix[np.ix_(prior.columns, prior.columns)] += prior.A
            normal.gradient[prior.columns] += prior.b
        size = self._modes.shape[1]
        for first, modes in zip(range(self._first, self._end, size), self._modes, strict=True):
            own = slice(first, first + size)
            normal.matrix[own, own] += problem.prior.toarray()
            normal.gradient[own] += problem.prior @ modes
        normal.matrix[np.diag_indices(self._unknowns)] *= 1 + _RIDGE
        normal.matrix[:, :6], normal.matrix[range(6), range(6)], normal.gradient[:6], normal.by_points[:6] = 0, 1, 0, 0
        return normal

    @cached_property
    def gradient(self) -> np.ndarray:
        """First derivative; 0 for the first keyframe's pose."""
        return np.append(self._normal.gradient, self._normal.g)

    def gauss_newton_step(self) -> np.ndarray:
        """Return the step to the minimum."""
        linear, points, normal = self._linear, self._problem.rigid.observations.point, self._normal
        step = np.zeros(self._unknowns + len(normal.g))
        # LAPACK reads by columns: the lower half is the upper one there, and nothing is copied.
        factor = cho_factor(normal.matrix.T, overwrite_a=True, check_finite=False)
        step[: self._unknowns] = cho_solve(factor, normal.by_points - normal.gradient, check_finite=False)
        change, log_scale = self._change(step)
        slope = linear.weight * (linear.by_depth * change).sum(1)
        shift = np.bincount(points, slope, len(normal.g)) - linear.held * log_scale
        step[self._unknowns :] = -(normal.g + shift) / normal.h
        return step

    def curvature(self, step: np.ndarray) -> float:
        """Return step^T H step."""
        linear, points = self._linear, step[self._unknowns :]
        change, log_scale = self._change(step)
        change = change + linear.by_depth * points[self._problem.rigid.observations.point][:, None]
        total = float(linear.weight @ (change**2).sum(1) + linear.held @ (points - log_scale) ** 2)
        total += sum(float(step[prior.columns] @ prior.A @ step[prior.columns]) for prior in self._priors)
        return total + self._stiffness(step[self._first : self._end].reshape(3, -1))


class _Normal(NamedTuple):
    """Normal equations.

    matrix : lower half of the second derivative (U, U) by all but the points, these eliminated. gradient : first
    derivative (U,). by_points : what eliminating the points adds to its negative (U,). h, g : second and first
    derivatives (P,) by the points.
    """

    matrix: np.ndarray
    gradient: np.ndarray
    by_points: np.ndarray
    h: np.ndarray
    g: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def _add_points(normal: _Normal, start: np.ndarray, scale: np.ndarray, linear: _Linear) -> None:
    """Add the normal equations of keyframes, modes and curves, without the points.

    start : first observation of each point and their number (P + 1,). scale : (P,) unknown of its host's ln scale.
    """
    size = len(normal.gradient)
    # A point touches few unknowns: its sums are made among these, and added to the matrix once.
    columns, place = np.empty(size, np.int64), np.full(size, -1)
    most = 0
    for p in range(len(scale)):
        most = max(most, start[p + 1] - start[p])
    rows = np.zeros((2 * most, size))
    by, off, b, E = np.empty(len(rows)), np.empty(len(rows)), np.zeros(size), np.zeros(size)
    for p in range(len(scale)):
        held, used, count = linear.held[p], 0, 1
        h, g = held, held * linear.off[p]
        columns[0], place[scale[p]] = scale[p], 0
        for k in range(start[p], start[p + 1]):
            root = np.sqrt(linear.weight[k])
            for axis in range(2):
                by[used], off[used] = root * linear.by_depth[k, axis], root * linear.error[k, axis]
                h += by[used] ** 2
                g += by[used] * off[used]
                for i in range(linear.columns.shape[1]):
                    value, column = root * linear.by[k, axis, i], linear.columns[k, i]
                    if value == 0:
                        continue
                    if place[column] < 0:
                        place[column], columns[count] = count, column
                        count += 1
                    rows[used, place[column]] += value
                used += 1
        A = np.zeros((count, count))
        A[0, 0], b[0], E[0] = held, -held * linear.off[p], -held
        for row in range(used):
            for i in range(count):
                value = rows[row, i]
                if value == 0:
                    continue
                b[i] += off[row] * value
                E[i] += by[row] * value
                for j in range(i + 1):
                    A[i, j] += value * rows[row, j]
        normal.h[p], normal.g[p] = h, g
        for i in range(count):
            normal.gradient[columns[i]] += b[i]
            normal.by_points[columns[i]] += E[i] / h * g
            for j in range(i + 1):
                row, column = max(columns[i], columns[j]), min(columns[i], columns[j])
                normal.matrix[row, column] += A[i, j] - E[i] / h * E[j]
            for row in range(used):
                rows[row, i] = 0.0
        for i in range(count):
            place[columns[i]], b[i], E[i] = -1, 0.0, 0.0
