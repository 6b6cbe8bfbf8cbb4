"""Pose graph: what loops say is spread over all keyframes, so that the adjustment can begin from close by.

Every keyframe has a pose and a scale of its depth, so a similarity. An edge from keyframe i to j says where j was as
seen from i, in the millimetres of i's depth, and how j's depth compares:

    rotation   log(R_ij^T R_i^T R_j)                     over its standard deviation
    position   R_i^T (p_j - p_i) / exp(s_i) - t_ij       over its standard deviation
    scale      s_j - s_i - r_ij                          over its standard deviation

Neighbours are joined by what was tracked (r = 0), the ends of loops by what their landmarks say. Cauchy's loss lets a
false loop, or a slip of the tracker, give way. Strasdat, Montiel and Davison, "Scale drift-aware large scale monocular
SLAM", RSS 2010.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from scopemap.geometry.se3 import inverse, se3
from scopemap.mapping.loop_closure import Loop

_OWN = 7
# Standard deviations of an edge: rad, share of the scene's depth, ln. Their ratio is what counts.
_TRACKED = (0.01, 0.02, 0.03)
_LOOP = (0.02, 0.03, 0.05)
# Of Cauchy's loss, in standard deviations. Wide at first: after much drift a true loop looks as false as a false one.
_TOLERANCES = (100.0, 10.0, 1.0)
_MOST_CALLS = 20
_BELIEVED = 3.0  # root mean square error, in standard deviations, up to which a loop has been closed


# A loop that says more than that share of the way between its ends (and of the depth) was never walked is not believed.
_MOST_OF_THE_WAY = 0.5


class Graph(NamedTuple):
    """Poses T_world_camera (K, 4, 4) and ln of the depth scales (K,) of all keyframes; how many loops were believed."""

    T_world_camera: np.ndarray
    log_scale: np.ndarray
    believed: int


class _Edges(NamedTuple):
    i: np.ndarray
    j: np.ndarray
    T: np.ndarray  # T_i_j
    log_ratio: np.ndarray
    sigma: np.ndarray  # (E, 7)


def spread_loops(T_world_camera: np.ndarray, neighbours: np.ndarray, loops: list[Loop], depth_mm: float) -> Graph:
    """Return poses and scales that agree best with the tracked motions and the loops; the first keyframe stays.

    T_world_camera : (K, 4, 4) as tracked. neighbours : (C, 2) int, pairs between which the motion was tracked.
    depth_mm : typical depth, the unit of ways.
    """
    count = len(T_world_camera)
    loops = [loop for loop in loops if _plausible(T_world_camera, loop, depth_mm)]
    edges = _edges(T_world_camera, neighbours, loops, depth_mm)
    turns, places = Rotation.from_matrix(T_world_camera[:, :3, :3]), T_world_camera[:, :3, 3] / depth_mm

    def state(x: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray]:
        own = np.vstack([np.zeros(_OWN), x.reshape(-1, _OWN)])
        return turns * Rotation.from_rotvec(own[:, :3]), places + own[:, 3:6], own[:, 6]

    def errors(x: np.ndarray) -> np.ndarray:
        R, p, s = state(x)
        back = R[edges.i].inv()
        turn = (Rotation.from_matrix(edges.T[:, :3, :3]).inv() * back * R[edges.j]).as_rotvec()
        way = back.apply(p[edges.j] - p[edges.i]) * np.exp(-s[edges.i])[:, None] - edges.T[:, :3, 3]
        scale = s[edges.j] - s[edges.i] - edges.log_ratio
        return (np.column_stack([turn, way, scale]) / edges.sigma).ravel()

    x, pattern = np.zeros(_OWN * (count - 1)), _pattern(edges, count)
    for tolerance in _TOLERANCES:
        x = least_squares(
            errors,
            x,
            jac_sparsity=pattern,
            loss="cauchy",
            f_scale=tolerance,
            ftol=1e-4,
            max_nfev=_MOST_CALLS,
            tr_solver="lsmr",
            # Long chains are stiff: with lsmr's own tolerances steps end far too early.
            tr_options={"atol": 1e-12, "btol": 1e-12, "maxiter": 1000},
        ).x
    R, p, s = state(x)
    poses = [se3(turn, depth_mm * place) for turn, place in zip(R.as_matrix(), p, strict=True)]
    left = np.linalg.norm(errors(x).reshape(-1, _OWN)[len(neighbours) :], axis=1) / np.sqrt(_OWN)
    return Graph(np.stack(poses), s, int((left < _BELIEVED).sum()))


def _plausible(T_world_camera: np.ndarray, loop: Loop, depth_mm: float) -> bool:
    """Whether drift can be all that keeps the ends of a loop from where it says they are."""
    here = T_world_camera[loop.past : loop.new + 1, :3, 3]
    way_mm = float(np.linalg.norm(np.diff(here, axis=0), axis=1).sum())
    T = T_world_camera[loop.new] @ loop.T_new_past
    off_mm = float(np.linalg.norm(T[:3, 3] - T_world_camera[loop.past][:3, 3]))
    return off_mm <= _MOST_OF_THE_WAY * (way_mm + depth_mm)


def _edges(T_world_camera: np.ndarray, neighbours: np.ndarray, loops: list[Loop], depth_mm: float) -> _Edges:
    """Edges between neighbours and of loops, ways in units of `depth_mm`."""
    steps = inverse(T_world_camera[neighbours[:, 0]]) @ T_world_camera[neighbours[:, 1]]
    i = np.append(neighbours[:, 0], [loop.past for loop in loops]).astype(int)
    j = np.append(neighbours[:, 1], [loop.new for loop in loops]).astype(int)
    T = np.concatenate([steps, *(inverse(loop.T_new_past)[None] for loop in loops)])
    T[:, :3, 3] /= depth_mm
    # The new one's depth is too large by its ratio: its scale has to be smaller.
    ratio = np.append(np.zeros(len(steps)), [-loop.log_ratio for loop in loops])
    sigma = np.array([_TRACKED] * len(steps) + [_LOOP] * len(loops))
    return _Edges(i, j, T, ratio, np.repeat(sigma, (3, 3, 1), axis=1))


def _pattern(edges: _Edges, count: int) -> lil_matrix:
    """Which error depends on which unknown; the first keyframe has none."""
    pattern = lil_matrix((_OWN * len(edges.i), _OWN * (count - 1)), dtype=np.int8)
    for row, ends in enumerate(zip(edges.i, edges.j, strict=True)):
        for k in ends:
            if k > 0:
                pattern[_OWN * row : _OWN * (row + 1), _OWN * (k - 1) : _OWN * k] = 1
    return pattern
