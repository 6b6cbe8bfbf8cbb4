"""ICP: how well the predicted surface fits the true one when it may be moved once more, as a rigid body.

Point to plane (Chen and Medioni, "Object modelling by registration of multiple range images", Image and Vision
Computing 10(3), 1992) by small rotations (Low, "Linear least-squares optimization for point-to-plane ICP", UNC
TR04-004, 2004), on the closest share of the points (Chetverikov et al., "The trimmed iterative closest point
algorithm", ICPR 2002).

It starts from the alignment by the camera path and is never instead of it: an own fit of the surfaces hides what the
trajectory got wrong. `trimesh.registration.icp` does not serve: it allows reflections and keeps every outlier, and
against a mesh it needs an index that is not among the dependencies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
# Neighbours that swap places keep the last thousandths of a mm moving for ever.
_STILL_MM = 5e-3
# Directions in which the surface slides along itself (a plane has three) are left alone.
_FREE_RATIO = 1e-4


@dataclass(frozen=True)
class Registration:
    """The motion that ICP found, on top of whatever aligned the surfaces before.

    Attributes
    ----------
    similarity : takes points of the predicted surface closer to the true one; the identity where nothing was gained.
    rms_before_mm, rms_after_mm : root mean square distance to the true surface of the closest share of the samples.
    iterations : how many were taken.
    converged : whether the last one moved the samples by less than 0.005 mm (RMS).
    """

    similarity: Similarity
    rms_before_mm: float
    rms_after_mm: float
    iterations: int
    converged: bool


def refine(
    predicted: Surface, truth: Surface, *, with_scale: bool = False, keep: float = 0.8, max_iterations: int = 60
) -> Registration:
    """Return the rigid motion that lays the predicted surface onto the true one, each a mesh or points (N, 3), mm.

    20 000 samples of the prediction, drawn by a fixed seed, are moved; `keep` is the share of them, the closest ones,
    that counts in each iteration. Directions that the surface leaves free, as along a plane, are not moved in. The
    result is never farther off than the start. With scale a fit may shrink onto the truth: read its scale first.
    Restrict the prediction to what a single view sees before fitting it to that view (`true_surface.visible_from`).
    Raises `AlignmentError` for fewer than 10 points on a side, `ValueError` for an empty surface or an impossible
    `keep`.
    """
    if not 0 < keep <= 1:
        raise ValueError(f"keep: expected a share in (0, 1], got {keep}")
    points = surface_points(predicted)
    points = points[np.random.default_rng(0).permutation(len(points))[:_MOVED_POINTS]]
    targets, normals = _oriented(truth)
    if min(len(points), len(targets)) < _FEWEST_POINTS:
        raise AlignmentError(
            f"cannot fit one surface to the other: {len(points)} and {len(targets)} points, at least {_FEWEST_POINTS} "
            "are needed on each side"
        )
    found, iterations, converged = _iterate(points, targets, normals, (keep, with_scale, max_iterations))
    before, after = (_trimmed_rms(moved, truth, keep) for moved in (points, found.transform_points(points)))
    if after >= before:
        return Registration(Similarity.identity(), before, before, iterations, converged)
    return Registration(found, before, after, iterations, converged)


def _iterate(
    points: np.ndarray, targets: np.ndarray, normals: np.ndarray, options: tuple[float, bool, int]
) -> tuple[Similarity, int, bool]:
    keep, with_scale, max_iterations = options
    tree = cKDTree(targets)
    found = Similarity.identity()
    kept = max(_FEWEST_POINTS, round(keep * len(points)))
    for iteration in range(1, max_iterations + 1):
        moved = found.transform_points(points)
        distances, nearest = tree.query(moved)
        closest = np.argpartition(distances, kept - 1)[:kept]
        step = _step(moved[closest], targets[nearest[closest]], normals[nearest[closest]], with_scale)
        found = _after(step, found)
        shift = step.transform_points(moved) - moved
        if np.sqrt(np.mean(np.sum(shift**2, axis=1))) < _STILL_MM:
            return found, iteration, True
    return found, max_iterations, False


def _step(points: np.ndarray, onto: np.ndarray, normals: np.ndarray, with_scale: bool) -> Similarity:
    """Return the small similarity that minimises the distances along the normals, all (N, 3).

    Rotation and scale act about the centroid and are measured by the way of the points, so that all unknowns are mm.
    """
    centre = points.mean(axis=0)
    arms = points - centre
    radius = max(float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))), 1e-12)
    columns = [np.cross(arms, normals) / radius, normals]
    if with_scale:
        columns.append(np.sum(arms * normals, axis=1, keepdims=True) / radius)
    jacobian = np.hstack(columns)
    gaps = np.sum((onto - points) * normals, axis=1)
    values, axes = np.linalg.eigh(jacobian.T @ jacobian)
    held = values > _FREE_RATIO * values[-1]
    unknowns = axes[:, held] @ ((axes[:, held].T @ (jacobian.T @ gaps)) / values[held])
    R = so3_exp(unknowns[:3] / radius)
    scale = float(np.exp(unknowns[6] / radius)) if with_scale else 1.0
    return Similarity(scale, R, centre + unknowns[3:6] - scale * R @ centre)


def _after(second: Similarity, first: Similarity) -> Similarity:
    return replace(first, scale=second.scale * first.scale, R=second.R @ first.R, t=second.transform_points(first.t))


def _oriented(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return points and unit normals (N, 3) of a surface; those of bare points from their 10 nearest neighbours."""
    if isinstance(surface, trimesh.Trimesh):
        return oriented_samples(surface)
    points = surface_points(surface)
    neighbours = points[cKDTree(points).query(points, k=range(1, min(_NEIGHBOURS, len(points)) + 1))[1]]
    spread = neighbours - neighbours.mean(axis=1, keepdims=True)
    return points, np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]


def _trimmed_rms(points: np.ndarray, truth: Surface, keep: float) -> float:
    distances = np.sort(distances_mm(points, truth))[: max(_FEWEST_POINTS, round(keep * len(points)))]
    return float(np.sqrt(np.mean(distances**2)))
