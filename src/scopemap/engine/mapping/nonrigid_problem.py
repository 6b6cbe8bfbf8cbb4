"""Bundle adjustment with tissue that moves: the rigid problem, and modes and curves of a deformation graph.

To the cost of `bundle_adjustment` come the priors of the modes and of the curves. Unknowns of the reduced system are
those of the keyframes, the modes, axis by axis, and the curves unless they are given. Points are eliminated one by one,
since each touches few nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import sparse

from scopemap.engine.geometry import least_squares
from scopemap.engine.geometry.least_squares import Linear, Prior, ReducedModel, minimise, robust_sigma_2d
from scopemap.engine.geometry.skinning import Skin
from scopemap.engine.mapping.bundle_adjustment import (
    PER_KEYFRAME,
    camera_priors,
    cost,
    derivatives,
    held_depths,
    odometry_edges,
    retract,
)
from scopemap.engine.mapping.bundle_problem import BundleProblem, Moved, State, reprojection_errors

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

    def moved(self, modes: np.ndarray, basis: np.ndarray) -> Moved:
        """Return what gives by how much (n, 3) mm the points of observations have moved since their hosts saw them."""

        def of(some: slice) -> np.ndarray:
            points, observer, _ = (part[some] for part in self.rigid.observations.columns)
            if not len(points):
                return np.zeros((0, 3))
            own = slice(points[0], points[-1] + 1)
            change = basis[observer] - basis[self.rigid.points.host[points]]
            return np.einsum("nl,nlc->nc", change, self.at_points(modes, own)[points - own.start])

        return of

    def at_points(self, modes: np.ndarray, some: slice) -> np.ndarray:
        """Return the displacement (p, L, 3) mm of some points where each curve is 1."""
        return Skin(*(part[some] for part in self.skin)).displaced(modes).transpose(1, 0, 2)


class NonRigidState(NamedTuple):
    """Keyframes and points, the modes (L, N, 3) mm of the nodes, and their curves (K, L)."""

    rigid: State
    modes: np.ndarray
    basis: np.ndarray


def solve(problem: NonRigidProblem, start: NonRigidState) -> NonRigidState:
    """Return the state that the search finds from a start; the first keyframe keeps its pose."""

    def rescaled(state: NonRigidState) -> NonRigidState:
        seen = reprojection_errors(problem.rigid, state.rigid, problem.moved(state.modes, state.basis))
        lengths_px = np.linalg.norm(seen.error[seen.ahead], axis=1)
        sigma_px = robust_sigma_2d(lengths_px, problem.rigid.least_sigma_px)
        return state._replace(rigid=state.rigid._replace(sigma_px=sigma_px))

    most = _MAX_ITERATIONS if problem.free else _FOR_CURVE
    options = least_squares.Options(np.inf, most, min_step=0.0, min_decrease=_MIN_DECREASE)
    search = least_squares.Problem(partial(linearised, problem), partial(retracted, problem), rescaled)
    return minimise(search, rescaled(start), options).state


def retracted(problem: NonRigidProblem, state: NonRigidState, step: np.ndarray) -> NonRigidState:
    """Return the state after a step of the unknowns (N,), in the order of `ReducedModel.gradient`."""
    first = PER_KEYFRAME * len(state.rigid.T_camera_world)
    end = first + state.modes.size
    last = end + problem.curve_unknowns
    rigid = retract(problem.rigid, state.rigid, np.append(step[:first], step[last:]))
    basis = state.basis + step[end:last].reshape(state.basis.T.shape).T if problem.free else state.basis
    return NonRigidState(rigid, state.modes + _modes_of(step[first:end], state.modes.shape), basis)


def _modes_of(unknowns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return modes (L, N, 3) of their unknowns, which are in the order axis, mode, node."""
    return unknowns.reshape(3, *shape[:2]).transpose(1, 2, 0)


def linearised(problem: NonRigidProblem, state: NonRigidState) -> ReducedModel:
    """Return the model of the cost around a state: unknowns are keyframes, modes axis by axis, curves, points."""
    rigid, count = problem.rigid, len(state.rigid.T_camera_world)
    first, seen = PER_KEYFRAME * count, reprojection_errors(rigid, state.rigid, problem.moved(state.modes, state.basis))
    end, edges = first + state.modes.size, odometry_edges(rigid, state.rigid)
    unknowns, total = end + problem.curve_unknowns, cost(rigid, state.rigid, seen, edges)
    priors, stiffness = camera_priors(rigid, state.rigid, edges), problem.prior.toarray()
    for own, mode in zip(
        np.split(np.arange(first, end), 3), state.modes.transpose(2, 0, 1).reshape(3, -1), strict=True
    ):
        priors.append(Prior(own, stiffness, problem.prior @ mode))
        total += 0.5 * float(mode @ priors[-1].b)
    if problem.free:
        off = (state.basis - problem.basis).T.ravel() / _CURVE_SIGMA**2
        priors.append(Prior(np.arange(end, unknowns), np.identity(len(off)) / _CURVE_SIGMA**2, off))
        total += 0.5 * float(off @ off) * _CURVE_SIGMA**2
    held = held_depths(rigid, state.rigid)
    linear, free = partial(_derivatives, problem, state), np.arange(6, unknowns)
    return ReducedModel(rigid.first_seen, rigid.parts, total, linear, priors, *held, free=free, unknowns=unknowns)


def _derivatives(problem: NonRigidProblem, state: NonRigidState, some: slice) -> Linear:
    """Return the derivatives of the observations of some points by keyframes, modes and curves."""
    rigid, keyframes, basis = problem.rigid, state.rigid, state.basis
    linear = derivatives(rigid, keyframes, some, problem.moved(state.modes, basis))
    points, observer, _ = (part[rigid.seen(some)] for part in rigid.observations.columns)
    host, first = rigid.points.host[points], PER_KEYFRAME * len(keyframes.T_camera_world)
    # Px / mm of the point's motion in the world.
    by_world = linear.by[:, :, 3:6] / rigid.unit_mm @ keyframes.T_camera_world[observer, :3, :3]
    # Of many curves an observation touches those that differ between its keyframe and the host.
    change = basis[observer] - basis[host]
    most = max(int((change != 0).sum(1).max(initial=0)), 1)
    curve = np.argsort(change == 0, axis=1, kind="stable")[:, :most]
    share = np.take_along_axis(change, curve, 1)[:, None, :, None] * problem.skin.weight[points][:, None, None]
    axis = np.arange(3)[:, None, None] * basis.shape[1]
    place = (axis + curve[:, None, :, None]) * len(problem.nodes) + problem.skin.node[points][:, None, None]
    columns = [linear.columns, first + place.reshape(len(points), -1)]
    by = [linear.by, (by_world[..., None, None] * share[:, None]).reshape(len(points), 2, -1)]
    if problem.free:
        start = first + state.modes.size + np.arange(basis.shape[1]) * len(basis)
        by_curve = by_world @ problem.at_points(state.modes, some)[points - some.start].transpose(0, 2, 1)
        columns += [start + observer[:, None], start + host[:, None]]
        by += [by_curve, -by_curve]
    return linear._replace(columns=np.hstack(columns), by=np.dstack(by))
