"""Pose graph optimisation over Sim(3): loop closures spread over all keyframes, as the start of bundle adjustment.

Every keyframe has a pose and a depth scale exp(s). An edge from keyframe i to j is the relative pose T_ij in the
millimetres of i's depth and the ratio exp(r_ij) of their depth scales:

    rotation      log(R_ij^T R_i^T R_j)                     over its standard deviation
    translation   R_i^T (p_j - p_i) / exp(s_i) - t_ij       over its standard deviation
    scale         s_j - s_i - r_ij                          over its standard deviation

Edges are the tracked motions (r = 0) and the loop closures. Cauchy's loss makes false loops and tracking failures
outliers. Strasdat, Montiel and Davison, "Scale drift-aware large scale monocular SLAM", RSS 2010.

Loop closures show drift of the scale where the camera comes back, and the network's scale along new places: each
frame's depth takes its scale from the one before (`depth/mapis.py`), and errors add up; the network's scale is noisy
from frame to frame but does not drift. ln of the chained scale over the network's is drift plus noise. The drift is its
smooth part (Whittaker, "On a new method of graduation", 1923).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import splu, spsolve
from scipy.spatial.transform import Rotation

from scopemap.engine.geometry.least_squares import Options, Problem, cauchy, minimise
from scopemap.engine.geometry.se3 import hat, inverse, se3
from scopemap.engine.mapping.frame_correction import TrackedPose
from scopemap.engine.mapping.loop_closure import Loop

_UNKNOWNS = 7  # of a keyframe: rotation, position, ln scale
# Standard deviations of an edge: rad, share of the scene's depth, ln. Only their ratio matters.
_TRACKED_SIGMA = (0.01, 0.02, 0.03)  # by hand
_LOOP_SIGMA = (0.02, 0.03, 0.05)  # by hand
# Of Cauchy's loss, in standard deviations. Wide at first: after much drift a true loop has errors as large as a false.
_TOLERANCES = (100.0, 10.0, 1.0)  # by hand
# Factored, not by conjugate gradients: long chains are stiff, and their steps end far too early beside false loops.
_OPTIONS = Options(np.inf, min_step=0.0)
_RIDGE = 1e-9  # guard: of the unit matrix
# For symmetric matrices: the factors of 1700 keyframes with 3400 loops have 7 million numbers instead of 12.
_ORDER = "MMD_AT_PLUS_A"
_MAX_LOOP_ERROR = 3.0  # by hand: root mean square, in standard deviations, of an accepted loop
# A loop whose error as tracked exceeds this share of path length plus depth cannot be drift.
_MAX_DRIFT_SHARE = 0.5  # by hand
# Standard deviations, ln: of the network's scale at a keyframe, many of which err alike, of the drift from one keyframe
# to the next, and of the change of that drift.
_NETWORK_SIGMA = 0.2  # by hand
_DRIFT_SIGMA = 0.02  # by hand
_CHANGE_SIGMA = 0.002  # by hand


class PathWithoutDrift(NamedTuple):
    """Keyframes without the drift of their scale: ln of the drift (K,), and T_world_camera (K, 4, 4), by map."""

    drift: np.ndarray
    T_world_camera: np.ndarray


class PoseGraph(NamedTuple):
    """Poses T_world_camera (K, 4, 4), ln of the depth scales (K,), and the keyframes (A, 2) int of accepted loops."""

    T_world_camera: np.ndarray
    log_scale: np.ndarray
    accepted: np.ndarray


class _GraphModel(NamedTuple):
    """Model of the cost: many unknowns, of which few have edges in common."""

    cost: float
    gradient: np.ndarray
    hessian: csc_matrix

    def gauss_newton_step(self) -> np.ndarray:
        """Return the step (n,) to the minimum."""
        factors = splu(self.hessian, _ORDER, diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return np.asarray(factors.solve(-self.gradient))

    def curvature(self, step: np.ndarray) -> float:
        """Return step^T H step."""
        return float(step @ (self.hessian @ step))


class _Edges(NamedTuple):
    i: np.ndarray
    j: np.ndarray
    T: np.ndarray  # T_i_j
    log_ratio: np.ndarray
    sigma: np.ndarray  # (E, 7)


def path_without_drift(tracked: Sequence[TrackedPose], log_scale: np.ndarray) -> PathWithoutDrift:
    """Return the path without the drift of the scale along each map, whose first keyframe keeps pose and scale.

    log_scale : (K,) ln of the factor by which each keyframe's estimated depth was scaled, `Frame.depth_scale`. The
    translation from each keyframe to the next, and its depth, are divided by the drift there.
    """
    T, map_of = np.stack([pose.T_world_camera for pose in tracked]), np.array([pose.map for pose in tracked])
    drift = np.zeros(len(T))
    for number in set(map_of.tolist()):
        own = np.flatnonzero(map_of == number)
        drift[own] = _scale_drift(log_scale[own])
        factor = np.exp(-(drift[own[1:]] + drift[own[:-1]]) / 2)
        steps_mm = factor[:, None] * np.diff(T[own, :3, 3], axis=0)
        T[own[1:], :3, 3] = T[own[0], :3, 3] + np.cumsum(steps_mm, axis=0)
    return PathWithoutDrift(drift, T)


def _scale_drift(log_scale: np.ndarray) -> np.ndarray:
    """Return the most probable drift (K,), 0 at first: Whittaker's smoothing, by first and second differences."""
    count = len(log_scale)
    differences, normal = identity(count, format="csc"), identity(count, format="csc") / _NETWORK_SIGMA**2
    for sigma in (_DRIFT_SIGMA, _CHANGE_SIGMA):
        if differences.shape[0] > 1:
            differences = differences[1:] - differences[:-1]
            normal += differences.T @ differences / sigma**2
    drift: np.ndarray = spsolve(normal.tocsc(), log_scale / _NETWORK_SIGMA**2)
    return drift - drift[0]


def scale_by_network(log_scale: np.ndarray, map_of: np.ndarray, number: int, anchored: bool) -> float:
    """Return the factor of a map's millimetres that makes them those of the depth network, by most of its keyframes.

    A map begins with the scale with which the one before has ended, so that drift adds up over maps, and the error of
    the very first frame would scale them all. log_scale : (K,) as `path_without_drift` takes it, without its drift.
    map_of : (K,) numbers of the maps. anchored : whether depth was fitted to something else on the first frame: its map
    keeps its millimetres, and others get them by the network.
    """
    off = np.median(log_scale[map_of == number])
    return float(np.exp((np.median(log_scale[map_of == map_of[0]]) if anchored else 0.0) - off))


def tracked_pairs(frames: Sequence[int], tracked: Sequence[TrackedPose]) -> np.ndarray:
    """Return pairs (C, 2) int of keyframes between which the motion was tracked.

    The first of a pair is the keyframe that the second was aligned to, or, where that is no keyframe of these, the one
    before it in its map. frames : numbers of the keyframes' frames, increasing.
    """
    place = {frame: k for k, frame in enumerate(frames)}
    pairs: list[tuple[int, int]] = []
    latest: dict[int, int] = {}
    for k, pose in enumerate(tracked):
        first = place.get(pose.keyframe, k)
        first = latest.get(pose.map, k) if first >= k else first
        if first < k:
            pairs.append((first, k))
        latest[pose.map] = k
    return np.array(pairs, dtype=int).reshape(-1, 2)


def optimise_pose_graph(
    T_world_camera: np.ndarray, neighbours: np.ndarray, loops: list[Loop], depth_mm: float
) -> PoseGraph:
    """Return the poses and scales that fit the tracked motions and the loops best; the first keyframe is held.

    T_world_camera : (K, 4, 4) as tracked. neighbours : (C, 2) int, pairs between which the motion was tracked.
    depth_mm : typical depth, the unit of translations.
    """
    count = len(T_world_camera)
    loops = [loop for loop in loops if _explained_by_drift(T_world_camera, loop, depth_mm)]
    edges = _edges(T_world_camera, neighbours, loops, depth_mm)
    rotations, positions = Rotation.from_matrix(T_world_camera[:, :3, :3]), T_world_camera[:, :3, 3] / depth_mm

    def state(x: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray]:
        own = np.vstack([np.zeros(_UNKNOWNS), x.reshape(-1, _UNKNOWNS)])
        return rotations * Rotation.from_rotvec(own[:, :3]), positions + own[:, 3:6], own[:, 6]

    def errors(x: np.ndarray) -> np.ndarray:
        R, p, s = state(x)
        R_i_world = R[edges.i].inv()
        rotation = (Rotation.from_matrix(edges.T[:, :3, :3]).inv() * R_i_world * R[edges.j]).as_rotvec()
        translation = R_i_world.apply(p[edges.j] - p[edges.i]) * np.exp(-s[edges.i])[:, None] - edges.T[:, :3, 3]
        scale = s[edges.j] - s[edges.i] - edges.log_ratio
        return (np.column_stack([rotation, translation, scale]) / edges.sigma).ravel()

    def linearise(tolerance: float, x: np.ndarray) -> _GraphModel:
        J = _jacobian(edges, *state(x), np.vstack([np.zeros(_UNKNOWNS), x.reshape(-1, _UNKNOWNS)])[:, :3])
        error = errors(x)
        cost, weight = cauchy(error**2, tolerance)
        hessian = J.T @ diags(weight) @ J + _RIDGE * identity(len(x))
        return _GraphModel(float(cost.sum()), J.T @ (weight * error), hessian.tocsc())

    x = np.zeros(_UNKNOWNS * (count - 1))
    for tolerance in _TOLERANCES:
        x = minimise(Problem(partial(linearise, tolerance), np.add), x, _OPTIONS).state
    R, p, s = state(x)
    poses = se3(R.as_matrix(), depth_mm * p)
    loop_error = np.linalg.norm(errors(x).reshape(-1, _UNKNOWNS)[len(neighbours) :], axis=1) / np.sqrt(_UNKNOWNS)
    ends = np.array([(loop.past, loop.new) for loop in loops], dtype=int).reshape(-1, 2)
    return PoseGraph(poses, s, ends[loop_error < _MAX_LOOP_ERROR])


def _explained_by_drift(T_world_camera: np.ndarray, loop: Loop, depth_mm: float) -> bool:
    """Whether drift along the path can explain the difference between a loop and the tracked poses."""
    positions = T_world_camera[loop.past : loop.new + 1, :3, 3]
    path_mm = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    T = T_world_camera[loop.new] @ loop.T_new_past
    error_mm = float(np.linalg.norm(T[:3, 3] - T_world_camera[loop.past][:3, 3]))
    return error_mm <= _MAX_DRIFT_SHARE * (path_mm + depth_mm)


def _edges(T_world_camera: np.ndarray, neighbours: np.ndarray, loops: list[Loop], depth_mm: float) -> _Edges:
    """Edges of tracked motions, then of loops, translations in units of `depth_mm`."""
    steps = inverse(T_world_camera[neighbours[:, 0]]) @ T_world_camera[neighbours[:, 1]]
    i = np.append(neighbours[:, 0], [loop.past for loop in loops]).astype(int)
    j = np.append(neighbours[:, 1], [loop.new for loop in loops]).astype(int)
    T = np.concatenate([steps, *(inverse(loop.T_new_past)[None] for loop in loops)])
    T[:, :3, 3] /= depth_mm
    # The new keyframe's depth is too large by its ratio: its scale has to be smaller.
    ratio = np.append(np.zeros(len(steps)), [-loop.log_ratio for loop in loops])
    sigma = np.array([_TRACKED_SIGMA] * len(steps) + [_LOOP_SIGMA] * len(loops))
    return _Edges(i, j, T, ratio, np.repeat(sigma, (3, 3, 1), axis=1))


def _jacobian(edges: _Edges, R: Rotation, p: np.ndarray, s: np.ndarray, turns: np.ndarray) -> csr_matrix:
    """Return the derivatives (7 E, 7 (K - 1)) of the edges' errors; turns : (K, 3), rotations from the start to R."""
    R_i_world, turned = R[edges.i].inv(), _right_jacobian(turns)
    to_i, shrink = R_i_world.as_matrix(), np.exp(-s[edges.i])[:, None]
    seen = R_i_world.apply(p[edges.j] - p[edges.i]) * shrink
    error = Rotation.from_matrix(edges.T[:, :3, :3]).inv() * R_i_world * R[edges.j]
    by_turn = np.linalg.inv(_right_jacobian(error.as_rotvec()))
    by_i, by_j = np.zeros((2, len(edges.i), _UNKNOWNS, _UNKNOWNS))
    by_i[:, :3, :3] = -by_turn @ (R[edges.j].inv() * R[edges.i]).as_matrix() @ turned[edges.i]
    by_i[:, 3:6, :3] = hat(seen) @ turned[edges.i]
    by_i[:, 3:6, 3:6] = -shrink[:, None] * to_i
    by_i[:, 3:6, 6] = -seen
    by_i[:, 6, 6] = -1
    by_j[:, :3, :3] = by_turn @ turned[edges.j]
    by_j[:, 3:6, 3:6] = shrink[:, None] * to_i
    by_j[:, 6, 6] = 1
    size = (_UNKNOWNS * len(edges.i), _UNKNOWNS * len(p))
    start = np.arange(len(edges.i) + 1)  # one block a row
    i, j = (
        bsr_matrix((by / edges.sigma[:, :, None], ends, start), size) for by, ends in ((by_i, edges.i), (by_j, edges.j))
    )
    return (i + j).tocsr()[:, _UNKNOWNS:]  # the first keyframe is held


def _right_jacobian(turns: np.ndarray) -> np.ndarray:
    """Return (N, 3, 3): exp(turn + d) is exp(turn) exp(jacobian d) to first order (Sola et al., eq. 143)."""
    angle, K = np.maximum(np.linalg.norm(turns, axis=1), 1e-5)[:, None, None], hat(turns)
    jacobian: np.ndarray = np.eye(3) - (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K
    return jacobian
