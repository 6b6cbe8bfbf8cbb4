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

from scopemap.geometry import least_squares
from scopemap.geometry.least_squares import CameraBlock, cauchy, minimise, robust_sigma_2d
from scopemap.geometry.skinning import Skin
from scopemap.mapping.bundle_adjustment import (
    CAUCHY,
    PER_KEYFRAME,
    camera_blocks,
    cost,
    odometry_edges,
    retract,
    weights,
)
from scopemap.mapping.bundle_problem import BundleProblem, Reprojection, State, jacobians, reproject
from scopemap.mapping.deformation_graph import Deformation

_RIDGE = 1e-9  # of the diagonal
_MAX_ITERATIONS, _MIN_DECREASE = 20, 1e-3
_CURVE_SIGMA = 0.3  # prior standard deviation of a curve, whose largest value is 1


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
        displacement = Deformation(self.nodes, basis, modes).displacement
        return self.skin.moved(displacement, seen.point, hosts[seen.point], seen.keyframe)


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

    options = least_squares.Options(np.inf, _MAX_ITERATIONS, min_step=0.0, min_decrease=_MIN_DECREASE)
    search = least_squares.Problem(partial(NonRigidModel, problem), partial(_retract, problem), rescaled)
    return minimise(search, rescaled(start), options).state


def _retract(problem: NonRigidProblem, state: NonRigidState, step: np.ndarray) -> NonRigidState:
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
    """Errors, derivatives and weights of all observations; of points, ln depth's error and weight of the estimate."""

    error: np.ndarray  # (N, 2) px
    by_camera: np.ndarray  # (N, 2, 6)
    by_host: np.ndarray  # (N, 2, 6)
    by_depth: np.ndarray  # (N, 2)
    by_world: np.ndarray  # (N, 2, 3), px / mm of the point's motion in the world
    by_curve: np.ndarray  # (N, 2, L), px, by the observing keyframe's values of the curves
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
        rigid, state = self._problem.rigid, self._state.rigid
        by_camera, by_host, by_depth, _ = jacobians(rigid, state, self._seen)
        R = state.T_camera_world[rigid.observations.keyframe, :3, :3]
        by_world = by_camera[:, :, 3:] / rigid.unit_mm @ R
        held = cauchy((self._off / rigid.points.sigma) ** 2, CAUCHY)[1] / rigid.points.sigma**2
        weight = weights(state, self._seen) / rigid.correlated
        node, share = self._problem.skin.node, self._problem.skin.weight
        # Of a basis that is given there are many curves, whose derivatives nobody needs.
        modes = self._state.modes if self._problem.free else self._state.modes[:1]
        at_points = np.einsum("pj,lpjc->pcl", share, modes[:, node])
        by_curve = np.einsum("nij,njl->nil", by_world, at_points[rigid.observations.point])
        return _Linear(self._seen.error, by_camera, by_host, by_depth, by_world, by_curve, weight, self._off, held)

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
        rigid, linear = self._problem.rigid, self._linear
        own = step[: self._first].reshape(-1, PER_KEYFRAME)
        host = rigid.points.host[rigid.observations.point]
        modes = _modes_of(step[self._first : self._end], self._state.modes.shape)
        moved = self._problem.moved(modes, self._state.basis)
        if self._problem.free:
            basis = step[self._end : self._unknowns].reshape(self._state.basis.T.shape).T
            moved += self._problem.moved(self._state.modes, basis)
        change = np.einsum("nij,nj->ni", linear.by_camera, own[rigid.observations.keyframe, :6])
        change += np.einsum("nij,nj->ni", linear.by_host, own[host, :6])
        return change + np.einsum("nij,nj->ni", linear.by_world, moved), own[rigid.points.host, 6]

    @cached_property
    def gradient(self) -> np.ndarray:
        """First derivative; 0 for the first keyframe's pose."""
        rigid, linear = self._problem.rigid, self._linear
        seen, count = rigid.observations, len(self._state.rigid.T_camera_world)
        error, host = linear.weight[:, None] * self._seen.error, rigid.points.host[seen.point]
        own = np.zeros((count, PER_KEYFRAME))
        for keyframe, by in ((seen.keyframe, linear.by_camera), (host, linear.by_host)):
            np.add.at(own[:, :6], keyframe, np.einsum("nij,ni->nj", by, error))
        held = linear.held * self._off
        own[:, 6] = -np.bincount(rigid.points.host, held, count)
        force, nodes = np.einsum("nij,ni->nj", linear.by_world, error), np.zeros((count, len(self._problem.nodes), 3))
        skin = self._problem.skin
        for node, weight in zip(skin.node[seen.point].T, skin.weight[seen.point].T, strict=True):
            np.add.at(nodes, (seen.keyframe, node), weight[:, None] * force)
            np.add.at(nodes, (host, node), -weight[:, None] * force)
        modes = np.einsum("kl,knc->cln", self._state.basis, nodes).reshape(3, -1)
        modes += (self._problem.prior @ self._modes.T).T
        depth = np.bincount(seen.point, (linear.by_depth * error).sum(1), len(held)) + held
        basis = np.einsum("knc,lnc->lk", nodes, self._state.modes) if self._problem.free else np.zeros(0)
        gradient = np.concatenate([own.ravel(), modes.ravel(), basis.ravel(), depth])
        for prior in self._priors:
            gradient[prior.columns] += prior.b
        gradient[:6] = 0
        return gradient

    def gauss_newton_step(self) -> np.ndarray:
        """Return the step to the minimum."""
        problem, linear = self._problem, self._linear
        points, seen = problem.rigid.points, problem.rigid.observations
        matrix, rhs = np.zeros((self._unknowns, self._unknowns)), np.zeros(self._unknowns)
        start = np.searchsorted(seen.point, np.arange(len(points.host) + 1))
        ends = _Ends(start, points.host, seen.keyframe)
        _add_points(matrix, rhs, ends, linear, problem.skin, self._state.basis, len(problem.nodes))
        for prior in self._priors:
            matrix[np.ix_(prior.columns, prior.columns)] += prior.A
            rhs[prior.columns] -= prior.b
        size = self._modes.shape[1]
        for first, modes in zip(range(self._first, self._end, size), self._modes, strict=True):
            own = slice(first, first + size)
            matrix[own, own] += problem.prior.toarray()
            rhs[own] -= problem.prior @ modes
        matrix[np.diag_indices_from(matrix)] *= 1 + _RIDGE
        step = np.zeros(self._unknowns + len(points.host))
        factor = cho_factor(matrix[6:, 6:], overwrite_a=True, check_finite=False)
        step[6 : self._unknowns] = cho_solve(factor, rhs[6:], check_finite=False)
        change, log_scale = self._change(step)
        slope = linear.weight[:, None] * linear.by_depth
        h, g = (
            np.bincount(seen.point, (slope * by).sum(1), len(points.host))
            for by in (linear.by_depth, linear.error + change)
        )
        step[self._unknowns :] = -(g + linear.held * (self._off - log_scale)) / (h + linear.held)
        return step

    def curvature(self, step: np.ndarray) -> float:
        """Return step^T H step."""
        linear, points = self._linear, step[self._unknowns :]
        change, log_scale = self._change(step)
        change = change + linear.by_depth * points[self._problem.rigid.observations.point][:, None]
        total = float(linear.weight @ (change**2).sum(1) + linear.held @ (points - log_scale) ** 2)
        total += sum(float(step[prior.columns] @ prior.A @ step[prior.columns]) for prior in self._priors)
        return total + self._stiffness(step[self._first : self._end].reshape(3, -1))


class _Ends(NamedTuple):
    """First observation of each point and their number (P + 1,), its host (P,), keyframe of each observation (N,)."""

    start: np.ndarray
    host: np.ndarray
    keyframe: np.ndarray


@njit(cache=True, nogil=True)
def _add_points(
    matrix: np.ndarray, rhs: np.ndarray, ends: _Ends, linear: _Linear, skin: Skin, basis: np.ndarray, nodes: int
) -> None:
    """Add the normal equations of keyframes, modes and curves, without the points, to matrix and right-hand side."""
    curves, size = basis.shape[1], len(rhs)
    first = PER_KEYFRAME * len(basis)
    end = first + 3 * curves * nodes
    free = curves if size > end else 0
    most = 12 + 3 * curves * skin.node.shape[1] + 2 * free
    columns, row = np.empty(most, np.int64), np.empty((2, most))
    E, touched, known = np.zeros(size), np.empty(size, np.int64), np.zeros(size, np.bool_)
    for p in range(len(ends.host)):
        host, held = ends.host[p], linear.held[p]
        h, g, count = held, held * linear.off[p], 1
        touched[0] = scale = PER_KEYFRAME * host + 6
        known[scale], E[scale] = True, -held
        matrix[scale, scale] += held
        rhs[scale] += held * linear.off[p]
        for k in range(ends.start[p], ends.start[p + 1]):
            used = 12
            columns[:6] = PER_KEYFRAME * ends.keyframe[k] + np.arange(6)
            columns[6:12] = PER_KEYFRAME * host + np.arange(6)
            row[:, :6], row[:, 6:12] = linear.by_camera[k], linear.by_host[k]
            for curve in range(curves):
                change = basis[ends.keyframe[k], curve] - basis[host, curve]
                if change == 0:
                    continue
                for j in range(skin.node.shape[1]):
                    if skin.weight[p, j] == 0:
                        continue
                    for axis in range(3):
                        columns[used] = first + (axis * curves + curve) * nodes + skin.node[p, j]
                        row[:, used] = change * skin.weight[p, j] * linear.by_world[k, :, axis]
                        used += 1
            for curve in range(free):
                column = end + curve * len(basis)
                columns[used], columns[used + 1] = column + ends.keyframe[k], column + host
                row[:, used], row[:, used + 1] = linear.by_curve[k, :, curve], -linear.by_curve[k, :, curve]
                used += 2
            for side in range(2):
                depth = linear.weight[k] * linear.by_depth[k, side]
                h += depth * linear.by_depth[k, side]
                g += depth * linear.error[k, side]
                for i in range(used):
                    column, by = columns[i], row[side, i]
                    if not known[column]:
                        known[column], touched[count] = True, column
                        count += 1
                    E[column] += depth * by
                    rhs[column] -= linear.weight[k] * by * linear.error[k, side]
                    for j in range(used):
                        matrix[column, columns[j]] += linear.weight[k] * by * row[side, j]
        for i in range(count):
            share = E[touched[i]] / h
            rhs[touched[i]] += share * g
            for j in range(count):
                matrix[touched[i], touched[j]] -= share * E[touched[j]]
        for i in range(count):
            E[touched[i]], known[touched[i]] = 0.0, False
