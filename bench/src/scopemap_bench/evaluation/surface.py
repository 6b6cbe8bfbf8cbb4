"""Surfaces against the true surface: accuracy, completeness, Chamfer distance, precision, recall, F-score, and ICP.

Knapitsch et al., "Tanks and Temples", ACM TOG 36(4), 2017, section 4.2; the thresholds are ours. ICP is point to plane
(Chen and Medioni, Image and Vision Computing 10(3), 1992) by small rotations (Low, UNC TR04-004, 2004) on the closest
share of the points (Chetverikov et al., ICPR 2002). `trimesh.registration.icp` allows reflections and keeps outliers.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.engine.errors import AlignmentError, check_shape
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import so3_exp

Surface = np.ndarray | trimesh.Trimesh
"""A mesh, or points (N, 3), mm."""

THRESHOLDS_MM = (1.0, 2.0, 5.0)
"""Distances at which precision, recall and F-score are given."""

_SAMPLES_PER_MM2 = 4.0
_SAMPLES = (1_000, 200_000)
_COVERED_MM = 2.0
_NEIGHBOURS = 10
_CUBE_MM = 0.2
_LARGEST_EDGE_MM = 2.0
_MOST_TRIANGLES = 1_000_000
_MOVED_POINTS = 20_000
_FEWEST_POINTS = 10
_KEPT_SHARE = 0.8
_MOST_ITERATIONS = 60
# Neighbours that swap places never let the last thousandths of a mm come to rest.
_STILL_MM = 5e-3
# Directions in which the surface slides along itself (a plane has three) are not moved in.
_FREE_RATIO = 1e-2


def distance_to_mesh(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the distance (N,) float64, mm, of points (N, 3), mm, to the nearest triangle of a mesh, by libigl."""
    import igl  # only here: 16 MB

    if not len(points):
        return np.empty(0)
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    squared, *_ = igl.point_mesh_squared_distance(np.array(points, np.float64), vertices, faces)
    return np.sqrt(squared)


def small_triangles(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the mesh as triangles (F, 3, 3) with no edge over 2 mm (more only on meshes over 4 m^2)."""
    longest = max(_LARGEST_EDGE_MM, float(np.sqrt(mesh.area / _MOST_TRIANGLES)))
    if mesh.edges_unique_length.max() <= longest:
        return np.asarray(mesh.triangles)
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=longest, max_iter=40)
    return vertices[faces]


def distance_figures(name: str, distances_mm: np.ndarray) -> dict[str, float]:
    """Return NAME_mean_mm, _median_mm, _rms_mm and _p90_mm of distances (N,); NaN where there are none."""
    values = [float("nan")] * 4
    if len(distances_mm):
        median, p90 = np.percentile(distances_mm, [50, 90])
        values = [np.mean(distances_mm), median, np.sqrt(np.mean(np.square(distances_mm))), p90]
    keys = ("mean", "median", "rms", "p90")
    return {f"{name}_{key}_mm": float(value) for key, value in zip(keys, values, strict=True)}


def compare_surfaces(predicted: Surface, truth: Surface, *, observed: Surface | None = None) -> dict[str, float]:
    """Return the figures of two surfaces of the same world, each a mesh or points (N, 3), mm.

    accuracy_mean_mm, _median_mm, _rms_mm, _p90_mm : distance of the predicted surface to the whole truth.
    completeness_... : of the truth to the predicted surface, over the part `observed` by the camera where it is known.
    chamfer_mm : mean of mean accuracy and mean completeness (Chamfer-L1). precision_1mm, recall_1mm, f_1mm, ... :
    shares nearer than each threshold, 0..1, and their harmonic mean.
    coverage_2mm, observed_share : share of the observed truth nearer than 2 mm, and of the true area observed; NaN:
    unknown.

    Of an empty prediction recall and coverage are 0 and distances and precision NaN. `ValueError` for an empty truth.
    """
    empty = is_empty(predicted)
    from_predicted = from_truth = np.empty(0)
    if not empty:
        from_predicted = distances_mm(surface_points(predicted), truth)
        from_truth = distances_mm(surface_points(truth if observed is None else observed), predicted)
    figures = distance_figures("accuracy", from_predicted) | distance_figures("completeness", from_truth)
    figures["chamfer_mm"] = (figures["accuracy_mean_mm"] + figures["completeness_mean_mm"]) / 2
    for limit in THRESHOLDS_MM:
        precision = float("nan") if empty else float(np.mean(from_predicted < limit))
        recall = 0.0 if empty else float(np.mean(from_truth < limit))
        total = precision + recall
        figures[f"precision_{limit:g}mm"], figures[f"recall_{limit:g}mm"] = precision, recall
        figures[f"f_{limit:g}mm"] = 2 * precision * recall / total if total > 0 else 0.0
    coverage = observed_share = float("nan")
    if observed is not None:
        coverage = 0.0 if empty else float(np.mean(from_truth < _COVERED_MM))
        observed_share = _extent(observed) / _extent(truth)
    return figures | {"coverage_2mm": coverage, "observed_share": observed_share}


def normal_consistency(predicted: Surface, truth: Surface) -> float:
    """Return the mean |cosine| of normals of nearest samples of two meshes (Mescheder et al., CVPR 2019); else NaN."""
    if not (isinstance(predicted, trimesh.Trimesh) and isinstance(truth, trimesh.Trimesh)) or is_empty(predicted):
        return float("nan")
    samples = [oriented_samples(predicted), oriented_samples(truth)]
    means = []
    for (points, normals), (others, other_normals) in (samples, samples[::-1]):
        nearest = cKDTree(others).query(points, workers=-1)[1]
        means.append(float(np.mean(np.abs(np.sum(normals * other_normals[nearest], axis=1)))))
    return sum(means) / 2


def is_empty(surface: Surface) -> bool:
    """Return whether a surface has no triangles, or no points."""
    return len(surface.faces if isinstance(surface, trimesh.Trimesh) else surface) == 0


def surface_points(surface: Surface) -> np.ndarray:
    """Return points (N, 3) float64 spread evenly over a mesh, or the points themselves; `ValueError` if empty."""
    if isinstance(surface, trimesh.Trimesh):
        return oriented_samples(surface)[0]
    check_shape("surface", surface, (None, 3))
    if len(surface) == 0:
        raise ValueError("surface: there are no points")
    return np.asarray(surface, dtype=np.float64)


def oriented_samples(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) float64, mm, spread evenly over a surface by a fixed seed, and unit normals (N, 3).

    Bare points get normals from their 10 nearest neighbours. `ValueError` for a mesh without area, and for no points.
    """
    if not isinstance(surface, trimesh.Trimesh):
        points = surface_points(surface)
        neighbours = points[cKDTree(points).query(points, k=range(1, min(_NEIGHBOURS, len(points)) + 1), workers=-1)[1]]
        spread = neighbours - neighbours.mean(axis=1, keepdims=True)
        return points, np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    if len(surface.faces) == 0 or surface.area == 0:
        raise ValueError("surface: the mesh has no area")
    count = int(np.clip(np.ceil(_SAMPLES_PER_MM2 * surface.area), *_SAMPLES))
    points, faces = trimesh.sample.sample_surface(surface, count, seed=0)
    return np.asarray(points), np.asarray(surface.face_normals)[faces]


def distances_mm(points: np.ndarray, surface: Surface) -> np.ndarray:
    """Return the distance (N,) float64, mm, of points (N, 3), mm, to a mesh's triangles or to the nearest point."""
    if isinstance(surface, trimesh.Trimesh):
        return distance_to_mesh(points, surface)
    return cKDTree(surface).query(points, workers=-1)[0]


def thinned(surface: Surface) -> Surface:
    """Return points (N, 3) with one of each cube of 0.2 mm; a mesh as it is.

    A SCARED keyframe has 1.3 million, twenty to a triangle of a reconstruction: measuring took minutes. Distances of
    0.2 mm and more grow by less than 0.02 mm, smaller ones by up to 0.05 mm.
    """
    if isinstance(surface, trimesh.Trimesh):
        return surface
    cube = np.floor((surface - surface.min(0)) / _CUBE_MM).astype(np.int64)
    sizes = cube.max(0) + 1
    return surface[np.unique((cube[:, 0] * sizes[1] + cube[:, 1]) * sizes[2] + cube[:, 2], return_index=True)[1]]


def _extent(surface: Surface) -> float:
    return float(surface.area) if isinstance(surface, trimesh.Trimesh) else float(len(surface))


def refine(predicted: Surface, truth: Surface) -> tuple[Similarity, float, float]:
    """Return the rigid motion that fits the predicted surface to the true one, each a mesh or points (N, 3), mm.

    Beside it the root mean square distance, mm, of the closest 80 % of 20 000 samples before and after. Directions that
    the surface leaves free, as along a plane, are not moved in; without a gain it is the identity. Raises
    `AlignmentError` for fewer than 10 points on a side, `ValueError` for an empty surface.
    """
    points = surface_points(predicted)
    points = points[np.random.default_rng(0).permutation(len(points))[:_MOVED_POINTS]]
    targets, normals = oriented_samples(truth)
    if min(len(points), len(targets)) < _FEWEST_POINTS:
        raise AlignmentError(
            f"cannot fit one surface to the other: {len(points)} and {len(targets)} points, at least {_FEWEST_POINTS} "
            "are needed on each side"
        )
    tree, found = cKDTree(targets), Similarity.identity()
    kept = max(_FEWEST_POINTS, round(_KEPT_SHARE * len(points)))
    for _ in range(_MOST_ITERATIONS):
        moved = found.transform_points(points)
        distances, nearest = tree.query(moved, workers=-1)
        closest = np.argpartition(distances, kept - 1)[:kept]
        step = _step(moved[closest], targets[nearest[closest]], normals[nearest[closest]])
        found = step.after(found)
        shift = step.transform_points(moved) - moved
        if np.sqrt(np.mean(np.sum(shift**2, axis=1))) < _STILL_MM:
            break
    before, after = (_rms_mm(moved, truth, kept) for moved in (points, found.transform_points(points)))
    return (found, before, after) if after < before else (Similarity.identity(), before, before)


def _step(points: np.ndarray, onto: np.ndarray, normals: np.ndarray) -> Similarity:
    """Return the small rigid motion that minimises the distances along the normals, all (N, 3), mm."""
    centre = points.mean(axis=0)
    arms = points - centre
    radius = max(float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))), 1e-12)
    jacobian = np.hstack([np.cross(arms, normals) / radius, normals])
    gaps = np.sum((onto - points) * normals, axis=1)
    unknowns = np.linalg.lstsq(jacobian, gaps, rcond=_FREE_RATIO)[0]
    R = so3_exp(unknowns[:3] / radius)
    return Similarity(1.0, R, centre + unknowns[3:6] - R @ centre)


def _rms_mm(points: np.ndarray, truth: Surface, kept: int) -> float:
    return float(np.sqrt(np.mean(np.sort(distances_mm(points, truth))[:kept] ** 2)))
