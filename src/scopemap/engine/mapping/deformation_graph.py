"""Deformation graph: nodes in space whose translations over time move the tissue around them.

A node n is displaced by d_n(t) = sum over l of basis_l(t) mode_l,n. A point p that keyframe h sees at X_p is at

    X_p + sum over its nodes of w_pn (d_n(t) - d_n(h))

at keyframe t, so that no second cloud of points is kept. Sumner, Schmid and Pauly, "Embedded deformation for shape
manipulation", SIGGRAPH 2007, with translations alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from scopemap.engine.geometry.se3 import hat, inverse, se3_exp, so3_log

_NEIGHBOURS = 6  # by hand: of a node
_FARTHEST_SHARE = 97  # by hand: percent of the points, nearest to their median, among which nodes are
# A curve repeats itself where a sinusoid of at least so many periods explains so much of its variance.
_LEAST_PERIODS = 1.5  # by hand
_PERIODIC_SHARE = 0.8  # by hand
_RATES = 200  # by hand: rates that are tried
_REWEIGHTINGS = 5  # by hand: of the robust fit
_LEAST_GAP_S = 1e-3  # guard: frames with one time stamp


@dataclass(frozen=True)
class Deformation:
    """Motion of tissue over the keyframes of a map.

    nodes : (N, 3) mm, in the world, where the nodes are before they move. basis : (K, L), curves over the keyframes.
    modes : (L, N, 3) mm, displacement of the nodes where a curve is 1.
    """

    nodes: np.ndarray
    basis: np.ndarray
    modes: np.ndarray

    @property
    def displacement(self) -> np.ndarray:
        """Displacement (K, N, 3) mm of the nodes at the keyframes."""
        return np.einsum("kl,lnc->knc", self.basis, self.modes)

    @property
    def has_core(self) -> bool:
        """Whether some nodes are held: most of the tissue is at rest."""
        return bool((self.modes == 0).all(axis=(0, 2)).any())

    def in_world(self, T_new_world: np.ndarray) -> Deformation:
        """Return the motion in another world; `T_new_world` (4, 4) takes points of this one to it."""
        nodes = self.nodes @ T_new_world[:3, :3].T + T_new_world[:3, 3]
        return Deformation(nodes, self.basis, self.modes @ T_new_world[:3, :3].T)

    def rate_per_min(self, time_s: np.ndarray) -> float:
        """Return how often the first curve repeats itself, times (K,) s of the keyframes; NaN where it does not."""
        return periodic_rate(time_s, self.basis[:, 0]) * 60


def spread_nodes(points: np.ndarray, count: int) -> np.ndarray:
    """Return nodes (count, 3), far from each other, of points (P, 3) without the outermost: farthest-point sampling."""
    outwards = np.linalg.norm(points - np.median(points, 0), axis=1)
    inner = points[outwards <= np.percentile(outwards, _FARTHEST_SHARE)]
    chosen = [int(outwards[outwards <= np.percentile(outwards, _FARTHEST_SHARE)].argmin())]
    far = np.linalg.norm(inner - inner[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(far.argmax()))
        far = np.minimum(far, np.linalg.norm(inner - inner[chosen[-1]], axis=1))
    return inner[chosen]


class MotionPrior(NamedTuple):
    """Standard deviations: of the strain between neighbouring nodes; of a displacement and of its change from one
    keyframe to the next, over the typical depth.
    """

    strain: float
    size: float
    step: float

    def normal_matrix(self, nodes: np.ndarray, basis: np.ndarray, unit_mm: float) -> sparse.csr_matrix:
        """Return the normal matrix (L N, L N) of one axis of modes, flattened; unit_mm : the typical depth."""
        count = len(nodes)
        far, node = KDTree(nodes).query(nodes, k=min(_NEIGHBOURS + 1, count))
        first, other = np.repeat(np.arange(count), node.shape[1] - 1), node[:, 1:].ravel()
        rows, ones = np.arange(len(first)), np.ones(len(first))
        between = sparse.csr_matrix(
            (np.append(ones, -ones), (np.append(rows, rows), np.append(first, other))), shape=(len(rows), count)
        )
        # Most pairs are there twice.
        strain = between.T @ sparse.diags(0.5 / (self.strain * far[:, 1:].ravel()) ** 2) @ between
        still = sparse.identity(count)
        steps = np.diff(basis, axis=0)
        return (
            sparse.kron(basis.T @ basis, strain + still / (self.size * unit_mm) ** 2)
            + sparse.kron(steps.T @ steps, still) / (self.step * unit_mm) ** 2
        ).tocsr()


def hat_functions(count: int, most: int) -> np.ndarray:
    """Return a basis (count, L) of piecewise linear curves over keyframes, at most so many; few: one a keyframe."""
    knots = np.linspace(0, count - 1, min(count, most))
    spacing = (count - 1) / max(len(knots) - 1, 1)
    return np.maximum(1 - np.abs(np.arange(count)[:, None] - knots) / spacing, 0.0)


def first_mode(displacement: np.ndarray) -> np.ndarray:
    """Return the curve (K, 1), at most 1, of the first singular vector of displacements (K, N, 3) less their mean."""
    flat = displacement.reshape(len(displacement), -1)
    curve = np.linalg.svd(flat - flat.mean(0), full_matrices=False)[0][:, :1]
    largest: np.ndarray = curve / np.abs(curve).max()
    return largest


def periodic_rate(time_s: np.ndarray, curve: np.ndarray) -> float:
    """Return the rate, 1/s, of the sinusoid that explains a curve (K,) best; NaN where it explains too little."""
    span, gap = float(np.ptp(time_s)), float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    off = curve - curve.mean()
    if not span > 0 or not gap > 0 or not off.any():
        return float("nan")
    best, explained = float("nan"), _PERIODIC_SHARE
    for rate in np.linspace(_LEAST_PERIODS / span, 1 / (4 * gap), _RATES):
        angle = 2 * np.pi * rate * time_s
        waves = np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))])
        left = curve - waves @ np.linalg.lstsq(waves, curve, rcond=None)[0]
        if 1 - (left @ left) / (off @ off) > explained:
            best, explained = float(rate), 1 - (left @ left) / (off @ off)
    return best


def camera_without_curve(
    T_world_camera: np.ndarray,
    time_s: np.ndarray,
    curve: np.ndarray,
    nodes: np.ndarray,
    mode: np.ndarray,
    size_mm: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion (K, 4, 4) of the world without which poses do not follow the curve (K,), and the mode with it.

    Where camera and tissue move together along the tissue's curve nothing in the picture changes: six numbers are not
    determined. A hand moves smoothly and does not breathe: of all motions along a curve that repeats itself, the
    tissue's is the one without which the camera's path has the least acceleration, beside the prior of displacements.

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
