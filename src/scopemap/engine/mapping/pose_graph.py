"""What loop closures do: they merge maps, and a pose graph over Sim(3) spreads them over all keyframes.

Bundle adjustment begins where the pose graph ends. There every keyframe has a pose and a depth scale exp(s). An edge
from keyframe i to j is the relative pose T_ij in the millimetres of i's depth and the ratio exp(r_ij) of their depth
scales:

    rotation      log(R_ij^T R_i^T R_j)                     over its standard deviation
    translation   R_i^T (p_j - p_i) / exp(s_i) - t_ij       over its standard deviation
    scale         s_j - s_i - r_ij                          over its standard deviation

Edges are the tracked motions (r = 0) and the loop closures. Cauchy's loss makes false loops and tracking failures
outliers. Strasdat, Montiel and Davison, "Scale drift-aware large scale monocular SLAM", RSS 2010.

Maps are merged before. Each has a world and a unit of length of its own. A loop closure between keyframe p of one map
and n of another gives T_n_p, in the millimetres of p's depth, and the ratio exp(r) of n's depth to p's. So Sim(3) from
the world of n's map to the world of p's has

    scale exp(-r),    rotation R_p R_n_p^T R_n^T,    and takes the position of n to the position of T_p T_n_p^-1

It is accepted only if loop closures of other keyframes agree with it, and maps stay merged only if they fit after an
adjustment (`MapErrors.fit`).

Where the camera was lost and aligned again to a keyframe from before, the alignment may be wrong. If keyframes from
before and after the loss observe no points in common, nothing supports it, and the map is split there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.least_squares import Options, Problem, cauchy, minimise
from scopemap.engine.geometry.se3 import hat, inverse, se3
from scopemap.engine.mapping.correction import TrackedPose
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
# Maps that are merged.
_MIN_SUPPORT = 2  # by hand: agreeing keyframes in either map
# Maps drift independently: two loops agree within these, rad, share of the scene's depth, ln.
_MAX_DIFFERENCE = (0.2, 0.3, 0.3)  # by hand
_MAX_LOG_SCALE = 1.0  # by hand: between maps of one video
# Observations of points in common that support a motion tracked across a loss: as many as relocalisation needs inliers.
_MIN_COMMON = 20

Part = tuple[int, int]
"""A part of a map between two losses: number of the map, and `TrackedPose.lost_before`."""


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


class _Candidate(NamedTuple):
    """Sim(3) of a map by one loop: to the common world, its keyframe's pose (4, 4) in the map, both keyframes."""

    S_common_map: Similarity
    T_map_camera: np.ndarray
    own: int
    other: int


def split_maps(
    tracked: Sequence[TrackedPose], pairs: np.ndarray, relocalised: Collection[tuple[Part, Part]]
) -> dict[Part, int]:
    """Return the map of each part of the maps that has a keyframe: parts stay together where something supports it.

    tracked : poses of the K keyframes. pairs : (N, 2) int, keyframes that observe the same point. relocalised : pairs
    of parts between which features found the camera again. The first part of a map keeps its number.
    """
    parts = list(dict.fromkeys((pose.map, pose.lost_before) for pose in tracked))
    part_of = np.array([parts.index((pose.map, pose.lost_before)) for pose in tracked], dtype=int)
    common = np.zeros((len(parts), len(parts)), int)
    np.add.at(common, tuple(part_of[pairs].T), 1)
    common += common.T
    for one, other in relocalised:
        if one in parts and other in parts:
            common[parts.index(one), parts.index(other)] = common[parts.index(other), parts.index(one)] = _MIN_COMMON
    groups: list[list[int]] = []
    for k, (number, _) in enumerate(parts):
        near = [group for group in groups if parts[group[0]][0] == number and common[k, group].sum() >= _MIN_COMMON]
        groups = [group for group in groups if group not in near] + [[*chain(*near), k]]
    found: dict[Part, int] = {}
    unused = max(number for number, _ in parts) + 1 if parts else 0
    for group in sorted(groups, key=min):
        number = parts[min(group)][0]
        if number in found.values():
            number, unused = unused, unused + 1
        found |= dict.fromkeys((parts[k] for k in group), number)
    return found


def merge_maps(
    T_world_camera: np.ndarray, map_of: Sequence[int], loops: Sequence[Loop], main: int, depth_mm: float
) -> dict[int, Similarity]:
    """Return Sim(3) from the world of each map to the common world, for the main map and all that loops connect to it.

    T_world_camera : (K, 4, 4) of all keyframes, each in the world of its map. map_of : (K,) numbers of these maps.
    depth_mm : typical depth in the main map. The common world has the main map's millimetres, and its first keyframe
    has the pose that it had in its own map. Maps are in the order in which they were merged.
    """
    S_common_map = {main: Similarity.identity()}
    candidates: defaultdict[int, list[_Candidate]] = defaultdict(list)
    latest: int | None = main
    while latest is not None:
        for loop in loops:
            maps = {map_of[loop.past], map_of[loop.new]}
            if latest in maps and (number := next(iter(maps - set(S_common_map)), None)) is not None:
                candidates[number].append(_candidate(T_world_camera, map_of, loop, S_common_map, number))
        latest, most = None, 0
        for number in sorted(set(candidates) - set(S_common_map)):
            support, found = _best(candidates[number], depth_mm)
            if support > most:
                latest, most, best = number, support, found
        if latest is not None:
            S_common_map[latest] = best
    first = next(k for k, number in enumerate(map_of) if number in S_common_map)
    motion = T_world_camera[first] @ inverse(S_common_map[map_of[first]].transform_poses(T_world_camera[first]))
    moved = Similarity(1.0, motion[:3, :3], motion[:3, 3])
    return {number: moved.after(S) for number, S in S_common_map.items()}


def _candidate(
    T_world_camera: np.ndarray, map_of: Sequence[int], loop: Loop, S_common_map: dict[int, Similarity], number: int
) -> _Candidate:
    """Return Sim(3) of map `number` by a loop to a map whose Sim(3) is known."""
    T_new = T_world_camera[loop.past] @ inverse(loop.T_new_past)
    scale = float(np.exp(-loop.log_ratio))
    R = T_new[:3, :3] @ T_world_camera[loop.new, :3, :3].T
    S_past_new = Similarity(scale, R, T_new[:3, 3] - scale * R @ T_world_camera[loop.new, :3, 3])
    past, new = map_of[loop.past], map_of[loop.new]
    if new == number:
        return _Candidate(S_common_map[past].after(S_past_new), T_world_camera[loop.new], loop.new, loop.past)
    return _Candidate(S_common_map[new].after(S_past_new.inverse()), T_world_camera[loop.past], loop.past, loop.new)


def _best(candidates: Sequence[_Candidate], depth_mm: float) -> tuple[int, Similarity]:
    """Return the largest number of agreeing keyframes, on the side with fewer, and Sim(3); 0: none is accepted."""
    S, T_map_camera, own, other = zip(*candidates, strict=True)
    scale, R, t = (np.array([getattr(each, name) for each in S]) for name in ("scale", "R", "t"))
    own, other, centre = np.array(own), np.array(other), np.stack(T_map_camera)[:, :3, 3]
    position = scale[:, None] * np.einsum("nij,nj->ni", R, centre) + t
    best = (0, Similarity.identity())
    for k, (S_common_map, *_) in enumerate(candidates):
        if not abs(np.log(S_common_map.scale)) < _MAX_LOG_SCALE:
            continue
        # The trace of a relative rotation is 1 + 2 cos of its angle.
        angle_rad = np.arccos(np.clip((np.einsum("ij,nij->n", R[k], R) - 1) / 2, -1, 1))
        distance = np.linalg.norm(S_common_map.transform_points(centre) - position, axis=1) / depth_mm
        log_ratio = np.abs(np.log(scale / scale[k]))
        agree = (np.column_stack([angle_rad, distance, log_ratio]) < _MAX_DIFFERENCE).all(1)
        support = min(len(np.unique(own[agree])), len(np.unique(other[agree])))
        if support >= _MIN_SUPPORT and support > best[0]:
            best = (support, S_common_map)
    return best
