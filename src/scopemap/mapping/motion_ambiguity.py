"""Which motion along a curve is the camera's, and which is the tissue's.

Where camera and tissue move together along the tissue's curve nothing in the picture changes, so that six numbers are
not determined. A hand moves smoothly and does not breathe: of all motions along a curve that repeats itself, the
tissue's is the one without which the camera's path has the least acceleration, beside the prior of the displacements.
"""

from __future__ import annotations

import numpy as np

from scopemap.geometry.se3 import hat, inverse, se3_exp, so3_log

_REWEIGHTINGS = 5
_LEAST_GAP_S = 1e-3


def camera_without_curve(
    T_world_camera: np.ndarray,
    time_s: np.ndarray,
    curve: np.ndarray,
    nodes: np.ndarray,
    mode: np.ndarray,
    size_mm: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion (K, 4, 4) of the world without which poses do not follow the curve (K,), and the mode with it.

    nodes : (N, 3) mm. mode : (N, 3) mm. size_mm : prior standard deviation of a displacement. To first order poses and
    mode with the motion explain the same pictures; it is the identity at the first keyframe.
    """
    along, middle = curve - curve[0], nodes.mean(0)
    twist = _common_twist(T_world_camera, time_s, along, nodes, mode / size_mm, size_mm)
    about = np.eye(4)
    about[:3, 3] = middle
    T_world_world = np.stack([about @ se3_exp(share * twist) @ inverse(about) for share in along])
    return T_world_world, mode + np.cross(twist[:3], nodes - middle) + twist[3:]


def _common_twist(
    T: np.ndarray, time_s: np.ndarray, along: np.ndarray, nodes: np.ndarray, displaced: np.ndarray, size_mm: float
) -> np.ndarray:
    """Return the twist (6,), about the nodes' mean, of camera and tissue where the curve is 1: linear least squares."""
    gaps = np.maximum(np.diff(time_s), _LEAST_GAP_S)
    slope = np.diff(np.identity(len(T)), axis=0) / gaps[:, None]
    each = np.sqrt((gaps[1:] + gaps[:-1]) / 2)[:, None]
    change = np.diff(slope, axis=0) / each  # of velocity, (K - 2, K)
    turns = np.stack([so3_log(T[k + 1, :3, :3] @ T[k, :3, :3].T) for k in range(len(T) - 1)]) / gaps[:, None]
    from_middle = T[:, :3, 3] - nodes.mean(0)
    count, by = len(change), change @ along
    levers = np.einsum("jk,k,kab->jab", change, along, -np.stack([hat(x) for x in from_middle]))
    of_turn = np.concatenate([np.einsum("j,ab->jab", by, np.eye(3)), np.zeros((count, 3, 3))], axis=2)
    of_way = np.concatenate([levers, np.einsum("j,ab->jab", by, np.eye(3))], axis=2)
    of_nodes = np.stack([np.hstack([-hat(x), np.eye(3)]) for x in nodes - nodes.mean(0)]) / size_mm
    rows = [(of_turn.reshape(-1, 6), (np.diff(turns, axis=0) / each).ravel())]
    rows += [(of_way.reshape(-1, 6), (change @ T[:, :3, 3]).ravel()), (of_nodes.reshape(-1, 6), displaced.ravel())]
    twist = np.zeros(6)
    for _ in range(_REWEIGHTINGS):
        sigmas = [*(float(np.sqrt(np.mean((A @ twist + b) ** 2))) + 1e-12 for A, b in rows[:2]), 1.0]
        A, b = (np.concatenate([row[i] / sigma for row, sigma in zip(rows, sigmas, strict=True)]) for i in range(2))
        twist = -np.linalg.lstsq(A, b, rcond=None)[0]
    return twist
