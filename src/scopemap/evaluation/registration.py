"""ICP: the rigid motion that fits the predicted surface to the true one, on top of the trajectory's alignment.

Point to plane (Chen and Medioni, "Object modelling by registration of multiple range images", Image and Vision
Computing 10(3), 1992) by small rotations (Low, "Linear least-squares optimization for point-to-plane ICP", UNC
TR04-004, 2004), on the closest share of the points (Chetverikov et al., "The trimmed iterative closest point
algorithm", ICPR 2002).

A fit of the surfaces hides errors of the trajectory, so its figures are reported beside the others and never instead.
`trimesh.registration.icp` allows reflections, keeps every outlier, and against a mesh needs an index that is not among
the dependencies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.errors import AlignmentError
from scopemap.evaluation.surface import Surface, distances_mm, oriented_samples, surface_points
from scopemap.geometry.align import Similarity
from scopemap.geometry.se3 import so3_exp

_MOVED_POINTS = 20_000
_FEWEST_POINTS = 10
_NEIGHBOURS = 10
_KEPT_SHARE = 0.8
_MOST_ITERATIONS = 60
# Neighbours that swap places never let the last thousandths of a mm come to rest.
_STILL_MM = 5e-3
# Directions in which the surface slides along itself (a plane has three) are not moved in.
_FREE_RATIO = 1e-4


@dataclass(frozen=True)
class Registration:
    """The motion that ICP found, on top of the alignment before it.

    Attributes
    ----------
    similarity : rigid, takes points of the predicted surface closer to the true one; the identity without a gain.
    rms_before_mm, rms_after_mm : root mean square distance to the true surface of the closest 80 % of the samples.
    """

    similarity: Similarity
    rms_before_mm: float
    rms_after_mm: float


def refine(predicted: Surface, truth: Surface) -> Registration:
    """Return the rigid motion that fits the predicted surface to the true one, each a mesh or points (N, 3), mm.

    20 000 samples of the prediction, drawn by a fixed seed, are moved; the closest 80 % count in each iteration, of
    which there are at most 60. Directions that the surface leaves free, as along a plane, are not moved in. The result
    is never farther from the truth than the start. Restrict the prediction to the view that the truth was taken from
    first (`visibility.visible_from`). Raises `AlignmentError` for fewer than 10 points on a side, `ValueError` for an
    empty surface.
    """
    points = surface_points(predicted)
    points = points[np.random.default_rng(0).permutation(len(points))[:_MOVED_POINTS]]
    targets, normals = _oriented(truth)
    if min(len(points), len(targets)) < _FEWEST_POINTS:
        raise AlignmentError(
            f"cannot fit one surface to the other: {len(points)} and {len(targets)} points, at least {_FEWEST_POINTS} "
            "are needed on each side"
        )
    tree, found = cKDTree(targets), Similarity.identity()
    kept = max(_FEWEST_POINTS, round(_KEPT_SHARE * len(points)))
    for _ in range(_MOST_ITERATIONS):
        moved = found.transform_points(points)
        distances, nearest = tree.query(moved)
        closest = np.argpartition(distances, kept - 1)[:kept]
        step = _step(moved[closest], targets[nearest[closest]], normals[nearest[closest]])
        found = step.after(found)
        shift = step.transform_points(moved) - moved
        if np.sqrt(np.mean(np.sum(shift**2, axis=1))) < _STILL_MM:
            break
    before, after = (_rms_mm(moved, truth, kept) for moved in (points, found.transform_points(points)))
    return Registration(found, before, after) if after < before else Registration(Similarity.identity(), before, before)


def _step(points: np.ndarray, onto: np.ndarray, normals: np.ndarray) -> Similarity:
    """Return the small rigid motion that minimises the distances along the normals, all (N, 3).

    The rotation is about the centroid and in mm at the points' mean radius, so that all unknowns are mm.
    """
    centre = points.mean(axis=0)
    arms = points - centre
    radius = max(float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))), 1e-12)
    jacobian = np.hstack([np.cross(arms, normals) / radius, normals])
    gaps = np.sum((onto - points) * normals, axis=1)
    values, axes = np.linalg.eigh(jacobian.T @ jacobian)
    held = values > _FREE_RATIO * values[-1]
    unknowns = axes[:, held] @ ((axes[:, held].T @ (jacobian.T @ gaps)) / values[held])
    R = so3_exp(unknowns[:3] / radius)
    return Similarity(1.0, R, centre + unknowns[3:6] - R @ centre)


def _oriented(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return points and unit normals (N, 3) of a surface; those of bare points from their 10 nearest neighbours."""
    if isinstance(surface, trimesh.Trimesh):
        return oriented_samples(surface)
    points = surface_points(surface)
    neighbours = points[cKDTree(points).query(points, k=range(1, min(_NEIGHBOURS, len(points)) + 1))[1]]
    spread = neighbours - neighbours.mean(axis=1, keepdims=True)
    return points, np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]


def _rms_mm(points: np.ndarray, truth: Surface, kept: int) -> float:
    return float(np.sqrt(np.mean(np.sort(distances_mm(points, truth))[:kept] ** 2)))
