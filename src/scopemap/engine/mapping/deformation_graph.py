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
    distance = np.linalg.norm(points - np.median(points, 0), axis=1)
    is_inner = distance <= np.percentile(distance, _FARTHEST_SHARE)
    inner = points[is_inner]
    chosen = [int(distance[is_inner].argmin())]
    to_nearest = np.linalg.norm(inner - inner[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(to_nearest.argmax()))
        to_nearest = np.minimum(to_nearest, np.linalg.norm(inner - inner[chosen[-1]], axis=1))
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
        distance_mm, neighbour = KDTree(nodes).query(nodes, k=min(_NEIGHBOURS + 1, count))  # itself is the first
        first, second = np.repeat(np.arange(count), neighbour.shape[1] - 1), neighbour[:, 1:].ravel()
        edge, ones = np.arange(len(first)), np.ones(len(first))
        difference = sparse.csr_matrix(
            (np.append(ones, -ones), (np.append(edge, edge), np.append(first, second))), shape=(len(edge), count)
        )
        # Most edges are there twice.
        weight = sparse.diags(0.5 / (self.strain * distance_mm[:, 1:].ravel()) ** 2)
        strain = difference.T @ weight @ difference
        identity = sparse.identity(count)
        steps = np.diff(basis, axis=0)
        return (
            sparse.kron(basis.T @ basis, strain + identity / (self.size * unit_mm) ** 2)
            + sparse.kron(steps.T @ steps, identity) / (self.step * unit_mm) ** 2
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
    centred = curve - curve.mean()
    if not span > 0 or not gap > 0 or not centred.any():
        return float("nan")
    best, most_explained = float("nan"), _PERIODIC_SHARE
    for rate in np.linspace(_LEAST_PERIODS / span, 1 / (4 * gap), _RATES):
        phase = 2 * np.pi * rate * time_s
        sinusoids = np.column_stack([np.cos(phase), np.sin(phase), np.ones(len(phase))])
        residual = curve - sinusoids @ np.linalg.lstsq(sinusoids, curve, rcond=None)[0]
        explained = 1 - (residual @ residual) / (centred @ centred)
        if explained > most_explained:
            best, most_explained = float(rate), explained
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
    curve_change, centre = curve - curve[0], nodes.mean(0)
    twist = _common_twist(T_world_camera, time_s, curve_change, nodes, mode / size_mm, size_mm)
    T_world_centre = np.eye(4)
    T_world_centre[:3, 3] = centre
    T_world_world = T_world_centre @ se3_exp(curve_change[:, None] * twist) @ inverse(T_world_centre)
    return T_world_world, mode + np.cross(twist[:3], nodes - centre) + twist[3:]


def _common_twist(
    T_world_camera: np.ndarray,
    time_s: np.ndarray,
    curve_change: np.ndarray,
    nodes: np.ndarray,
    displacement: np.ndarray,
    size_mm: float,
) -> np.ndarray:
    """Return the twist (6,), about the nodes' mean, of camera and tissue where the curve is 1: linear least squares.

    curve_change : (K,) of the curve since the first keyframe. displacement : (N, 3) of the nodes, over size_mm. The
    residuals J twist + r are, in three blocks,

        rotation       angular acceleration of the camera
        translation    acceleration of its position
        nodes          displacements that the twist leaves to the nodes

    of which the first two have the standard deviation that they turn out to have.
    """
    gaps_s = np.maximum(np.diff(time_s), _LEAST_GAP_S)
    velocity = np.diff(np.identity(len(time_s)), axis=0) / gaps_s[:, None]
    # Over the root of the time, so that the squares sum up to the integral of the squared acceleration.
    root_s = np.sqrt((gaps_s[1:] + gaps_s[:-1]) / 2)[:, None]
    acceleration = np.diff(velocity, axis=0) / root_s  # (K - 2, K), takes values at the keyframes to it
    R, position, centre = T_world_camera[:, :3, :3], T_world_camera[:, :3, 3], nodes.mean(0)
    angular_velocity = so3_log(R[1:] @ R[:-1].swapaxes(1, 2)) / gaps_s[:, None]
    r_rotation, r_translation = np.diff(angular_velocity, axis=0) / root_s, acceleration @ position
    # The twist moves a camera by its rotation x (position - centre) + its translation, times the curve.
    by_translation = np.einsum("j,ab->jab", acceleration @ curve_change, np.eye(3))
    by_rotation = np.einsum("jk,k,kab->jab", acceleration, curve_change, -hat(position - centre))
    J_rotation = np.concatenate([by_translation, np.zeros((len(acceleration), 3, 3))], axis=2)
    J_translation = np.concatenate([by_rotation, by_translation], axis=2)
    J_nodes = np.concatenate([-hat(nodes - centre), np.tile(np.eye(3), (len(nodes), 1, 1))], axis=2) / size_mm
    blocks = [(J_rotation, r_rotation), (J_translation, r_translation), (J_nodes, displacement)]
    stacked = [(J.reshape(-1, 6), r.ravel()) for J, r in blocks]
    twist = np.zeros(6)
    for _ in range(_REWEIGHTINGS):
        sigmas = [float(np.sqrt(np.mean((J @ twist + r) ** 2))) + 1e-12 for J, r in stacked[:2]] + [1.0]
        J = np.concatenate([J / sigma for (J, _), sigma in zip(stacked, sigmas, strict=True)])
        r = np.concatenate([r / sigma for (_, r), sigma in zip(stacked, sigmas, strict=True)])
        twist = -np.linalg.lstsq(J, r, rcond=None)[0]
    return twist
