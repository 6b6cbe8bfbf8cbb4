"""Non-rigid adjustment: where tissue moves, one curve over time moves the nodes of a deformation graph.

Nodes that are free at every keyframe explain parallax by motion, and the shape falls back to the estimated depth. So
they are found in two steps: nodes that move step by step give the curve, their first singular vector; then nodes,
curve, keyframes and points are solved anew. Where most of the tissue is at rest, the nodes there are held, and the
search begins at the rigid solution; else at the poses as tracked.

The solution is accepted by tracks left out of it, a fifth of the picture's cells, where nodes move: tissue at rest
gains nothing there. Motion of all tissue against the camera is only determined where it repeats itself, and the camera
does not: see `camera_without_curve`; else the tracked motion decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.se3 import inverse, orthonormalised
from scopemap.engine.geometry.skinning import skin_of
from scopemap.engine.mapping.bundle_adjustment import BundleSolution, errors_px, log_depth_sigma, with_points
from scopemap.engine.mapping.bundle_problem import BundleProblem, Moved, State, reprojection_errors
from scopemap.engine.mapping.deformation_graph import (
    Deformation,
    MotionPrior,
    camera_without_curve,
    first_mode,
    hat_functions,
    periodic_rate,
    spread_nodes,
)
from scopemap.engine.mapping.left_out import part_of, placed
from scopemap.engine.mapping.nonrigid_problem import NonRigidProblem, NonRigidState, solve

LEAST_KEYFRAMES = 6  # by hand
MOST_KEYFRAMES = 300  # by hand
"""With fewer keyframes no curve is known; with more, time and memory of the adjustment would grow too much."""
RIGID_CORE_PX = 0.4  # by hand
"""Robust standard deviation of a rigid solution below which most of the tissue is at rest."""
_NODES = 60  # by hand
# Nodes that find the curves, of up to so many keyframes and of many, and the least hat functions of each.
_CURVE_NODES = 15  # by hand
_FEW_KEYFRAMES = 60  # by hand
_LEAST_CURVE_NODES = 10  # by hand
_LEAST_HATS = 30  # by hand
_THINNED = 3  # by hand: one of so many points finds the curve
# Nodes that move step by step, and those that follow a curve; priors of tracked motion are tighter by the last factor.
_FREE = MotionPrior(0.1, 0.03, 0.03)  # by hand
_ONE_CURVE = MotionPrior(0.2, 0.1, 0.03)  # by hand
_TRACKED_SHARE = 0.05  # by hand
_CELL_PX = 16  # by hand: cells of the picture, and which share of them is left out
_EVERY = 5  # by hand: every fifth cell
# Left-out errors: that count as wrong, and beyond which an error counts no more, px.
_WRONG_PX = 2.0  # by hand
_FALSE_PX = 10.0  # by hand
_LEAST_FACTOR = 1.5  # by hand: the rigid solution's errors over these, at least
_LEAST_FALL = 0.05  # by hand: of the share of wrong observations
_LEAST_LEFT_OUT = 100  # by hand: observations
# Beside a core at rest a node moves where the share of wrong observations exceeds that of most nodes by so much.
_MOVING_SHARE = 0.02  # by hand


@dataclass(frozen=True)
class LeftOutTracks:
    """Errors of tracks left out: root mean square, px, and share above 2 px; of the rigid solution, and of this one."""

    rigid_px: float
    px: float
    rigid_wrong: float
    wrong: float

    @property
    def accepts(self) -> bool:
        """Whether a non-rigid solution explains clearly more than the rigid one."""
        return self.rigid_px >= _LEAST_FACTOR * self.px and self.rigid_wrong - self.wrong >= _LEAST_FALL


class NonRigidSolution(NamedTuple):
    """Keyframes and points where their hosts see them, the motion of tissue, and the errors of tracks left out."""

    found: BundleSolution
    deformation: Deformation
    left_out: LeftOutTracks


class _Nodes(NamedTuple):
    """Nodes (N, 3) mm, and which of them move (N,) bool; the others are held."""

    place: np.ndarray
    moving: np.ndarray


def adjust_moving_tissue(problem: BundleProblem, rigid: State, time_s: np.ndarray) -> NonRigidSolution | None:
    """Return the solution with moving tissue; None where tracks left out do not confirm it, or it is not tried.

    rigid : the rigid solution. time_s : (K,) of the keyframes. It is tried with 6 to 300 keyframes, where the rigid
    solution leaves errors above 2 px.
    """
    observed = np.unique(problem.observations.point)
    few = len(observed) < _EVERY * _THINNED * _NODES
    if few or not LEAST_KEYFRAMES <= len(problem.T_camera_world) <= MOST_KEYFRAMES:
        return None
    wrong, core = errors_px(problem, rigid) > _WRONG_PX, rigid.sigma_px < RIGID_CORE_PX
    if not core and wrong.mean() < _LEAST_FALL:
        return None
    problem = replace(problem, start=rigid if core else None)
    column, row = np.floor(problem.points.pixel / _CELL_PX).astype(int).T
    outside = (column + 2 * row) % _EVERY == 0
    seen = np.zeros(len(outside), bool)
    seen[observed] = True
    inside = part_of(problem, ~outside & seen)
    place = spread_nodes(_in_world(inside), _NODES)
    nodes = _Nodes(place, _moving(problem, place, wrong) if core else np.ones(_NODES, bool))
    if not nodes.moving.any():
        return None
    start = _with_curve(inside, nodes, _curve(inside, nodes))
    left_out = _compared(part_of(problem, outside & seen), rigid, start, nodes)
    if left_out is None or not left_out.accepts:
        return None
    if not core and np.isfinite(periodic_rate(time_s, start.basis[:, 0])):
        problem, start = _camera_at_rest(problem, time_s, nodes, start)
    state = _with_curve(problem, nodes, start.basis, start.modes)
    modes = np.zeros((1, _NODES, 3))
    modes[:, nodes.moving] = state.modes
    moved = _problem(problem, nodes, state.basis, _ONE_CURVE).moved(state.modes, state.basis)
    T = orthonormalised(state.rigid.T_camera_world)
    final = with_points(problem, state.rigid._replace(T_camera_world=T), moved)
    motion = Deformation(_carried(place, problem, final), state.basis, modes)
    return NonRigidSolution(BundleSolution(final, log_depth_sigma(problem, final, moved), 0), motion, left_out)


def _carried(nodes: np.ndarray, problem: BundleProblem, final: State) -> np.ndarray:
    """Return the nodes (N, 3) where a solution has the points that move with them: by the weighted mean of shifts."""
    before = _in_world(problem)
    shift, skin = _in_world(replace(problem, start=final)) - before, skin_of(nodes, before)
    place, weight = skin.node.ravel(), skin.weight.ravel()
    total = np.zeros_like(nodes)
    np.add.at(total, place, weight[:, None] * np.repeat(shift, skin.node.shape[1], axis=0))
    return nodes + total / np.maximum(np.bincount(place, weight, len(nodes)), 1e-9)[:, None]


def _camera_at_rest(
    problem: BundleProblem, time_s: np.ndarray, nodes: _Nodes, state: NonRigidState
) -> tuple[BundleProblem, NonRigidState]:
    """Return problem and solution with a tracked motion that does not follow the curve."""
    size_mm, T_world_camera = _ONE_CURVE.size * problem.unit_mm, inverse(state.rigid.T_camera_world)
    curve, mode = state.basis[:, 0], state.modes[0]
    T_world_world, mode = camera_without_curve(T_world_camera, time_s, curve, nodes.place, mode, size_mm)
    T = problem.T_camera_world @ inverse(T_world_world)
    return replace(problem, T_camera_world=T), state._replace(modes=mode[None])


def _moving(problem: BundleProblem, nodes: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """Return near which nodes (N,) bool more observations are wrong, (M,) bool, than near most of them."""
    near = skin_of(nodes, _in_world(problem)).node[problem.observations.point, 0]
    share = np.bincount(near, wrong, len(nodes)) / np.maximum(np.bincount(near, minlength=len(nodes)), 1)
    moving: np.ndarray = share > np.median(share) + _MOVING_SHARE
    return moving


def _curve(problem: BundleProblem, nodes: _Nodes) -> np.ndarray:
    """Return the curve (K, 1) of nodes that move step by step: with more keyframes fewer nodes, not more unknowns."""
    thinned, keyframes = (
        part_of(problem, np.arange(len(problem.points.host)) % _THINNED == 0),
        len(problem.T_camera_world),
    )
    if nodes.moving.all():
        most = _CURVE_NODES * _FEW_KEYFRAMES // max(keyframes, _FEW_KEYFRAMES)
        nodes = _Nodes(*(each[: max(most, _LEAST_CURVE_NODES)] for each in nodes))
    basis = hat_functions(keyframes, max(_LEAST_HATS, _CURVE_NODES * _LEAST_HATS // len(nodes.place[nodes.moving])))
    state = _solved(_problem(thinned, nodes, basis, _FREE))
    # Nodes that are held do not move.
    return first_mode(Deformation(nodes.place[nodes.moving], basis, state.modes).displacement)


def _with_curve(
    problem: BundleProblem, nodes: _Nodes, curve: np.ndarray, modes: np.ndarray | None = None
) -> NonRigidState:
    """Return the solution with one curve; without a core at rest it is held more closely to the tracked motion.

    modes : where to begin, None: at rest.
    """
    if nodes.moving.all():
        priors = problem.priors
        rotation_rad, translation = priors.rotation_rad * _TRACKED_SHARE, priors.translation_share * _TRACKED_SHARE
        tight = priors._replace(rotation_rad=rotation_rad, translation_share=translation)
        problem = replace(problem, priors=tight)
    return _solved(_problem(problem, nodes, curve, _ONE_CURVE), modes)


def _problem(rigid: BundleProblem, nodes: _Nodes, basis: np.ndarray, prior: MotionPrior) -> NonRigidProblem:
    # Nodes and skin stay where the search begins: points of all hosts share the same errors.
    skin = skin_of(nodes.place, _in_world(rigid)).among(nodes.moving)
    free = np.tile(nodes.moving, basis.shape[1])
    matrix = prior.normal_matrix(nodes.place, basis, rigid.unit_mm)[free][:, free]
    return NonRigidProblem(rigid, nodes.place[nodes.moving], basis, skin, matrix, prior is _ONE_CURVE)


def _solved(problem: NonRigidProblem, modes: np.ndarray | None = None) -> NonRigidState:
    """Return the solution from where the search begins, and from these modes, or tissue at rest."""
    at_rest = np.zeros((problem.basis.shape[1], len(problem.nodes), 3))
    return solve(problem, NonRigidState(problem.rigid.begin, at_rest if modes is None else modes, problem.basis))


def _compared(part: BundleProblem, rigid: State, state: NonRigidState, nodes: _Nodes) -> LeftOutTracks | None:
    """Return the errors of points that were left out near moving nodes, in the keyframes of two solutions."""
    part = part_of(part, nodes.moving[skin_of(nodes.place, _in_world(part)).node[:, 0]])
    if len(part.observations.point) < _LEAST_LEFT_OUT:
        return None
    moving = _problem(part, nodes, state.basis, _ONE_CURVE).moved(state.modes, state.basis)
    (rigid_px, rigid_wrong), (px, wrong) = _errors(part, rigid, None), _errors(part, state.rigid, moving)
    return LeftOutTracks(rigid_px, px, rigid_wrong, wrong)


def _errors(part: BundleProblem, keyframes: State, moved: Moved | None) -> tuple[float, float]:
    """Return root mean square, px, and share above 2 px of the errors of points placed by their own observations."""
    seen = reprojection_errors(part, placed(part, keyframes, moved), moved)
    lengths_px = np.where(seen.ahead, np.minimum(np.linalg.norm(seen.error, axis=1), _FALSE_PX), _FALSE_PX)
    return float(np.sqrt((lengths_px**2).mean())), float((lengths_px > _WRONG_PX).mean())


def _in_world(problem: BundleProblem) -> np.ndarray:
    """Return the points (P, 3), mm, where their hosts see them when the search begins."""
    points, state = problem.points, problem.begin
    rays = np.column_stack([points.pixel / np.exp(state.log_focal), np.ones(len(points.host))])
    T = inverse(state.T_camera_world)[points.host]
    return np.einsum("nij,nj->ni", T[:, :3, :3], np.exp(state.log_depth)[:, None] * rays) + T[:, :3, 3]
