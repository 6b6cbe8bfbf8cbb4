"""Surfaces against the true surface: accuracy, completeness, Chamfer distance, precision, recall and F-score.

Definitions: Knapitsch et al., "Tanks and Temples: benchmarking large-scale scene reconstruction", ACM TOG 36(4), 2017,
section 4.2. Where a mesh is given its surface counts, not its vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.errors import check_shape

Surface = np.ndarray | trimesh.Trimesh

_SAMPLES_PER_MM2 = 4.0
_SAMPLES = (1_000, 200_000)
_LARGEST_EDGE_MM = 2.0
_MOST_TRIANGLES = 1_000_000
_CANDIDATES = (8, 32, 128)
_CHUNK = 5_000


@dataclass(frozen=True)
class DistanceSummary:
    """Mean, median, root mean square and 90th percentile of distances, mm."""

    mean_mm: float
    median_mm: float
    rms_mm: float
    p90_mm: float

    @classmethod
    def of(cls, distances_mm: np.ndarray) -> DistanceSummary:
        """Summarise distances of shape (N,), N > 0."""
        rms = np.sqrt(np.mean(np.square(distances_mm)))
        mean, (median, p90) = np.mean(distances_mm), np.percentile(distances_mm, [50, 90])
        return cls(float(mean), float(median), float(rms), float(p90))


@dataclass(frozen=True)
class FScore:
    """Precision and recall, 0..1: shares of the predicted and of the true surface nearer than `threshold_mm`."""

    threshold_mm: float
    precision: float
    recall: float

    @property
    def f_score(self) -> float:
        """Harmonic mean of precision and recall, 0..1."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total > 0 else 0.0


@dataclass(frozen=True)
class SurfaceReport:
    """How far the predicted surface is from the truth (accuracy) and the truth from it (completeness)."""

    accuracy: DistanceSummary
    completeness: DistanceSummary
    scores: tuple[FScore, ...]

    @property
    def chamfer_mm(self) -> float:
        """Mean of mean accuracy and mean completeness (Chamfer-L1)."""
        return (self.accuracy.mean_mm + self.completeness.mean_mm) / 2


def compare_surfaces(
    predicted: Surface, truth: Surface, *, thresholds_mm: Sequence[float] = (1.0, 2.0, 5.0)
) -> SurfaceReport:
    """Compare two surfaces of the same world, each a mesh or points (N, 3), mm.

    Meshes are sampled evenly, 4 points per mm^2 but at most 200 000, by a fixed seed. Distances to a mesh are to its
    triangles (`distance_to_mesh`), those to points are to the nearest point. Raises `ValueError` for an empty surface.
    """
    from_predicted = _distances(surface_points(predicted), truth)
    from_truth = _distances(surface_points(truth), predicted)
    scores = tuple(
        FScore(float(limit), float(np.mean(from_predicted < limit)), float(np.mean(from_truth < limit)))
        for limit in thresholds_mm
    )
    return SurfaceReport(DistanceSummary.of(from_predicted), DistanceSummary.of(from_truth), scores)


def surface_points(surface: Surface, *, seed: int = 0) -> np.ndarray:
    """Return points (N, 3) float64 spread evenly over a mesh, or the points themselves; `ValueError` if empty."""
    if isinstance(surface, trimesh.Trimesh):
        if len(surface.faces) == 0 or surface.area == 0:
            raise ValueError("surface: the mesh has no area")
        count = int(np.clip(np.ceil(_SAMPLES_PER_MM2 * surface.area), *_SAMPLES))
        return np.asarray(trimesh.sample.sample_surface(surface, count, seed=seed)[0])
    check_shape("surface", surface, (None, 3))
    if len(surface) == 0:
        raise ValueError("surface: there are no points")
    return np.asarray(surface, dtype=np.float64)


def _distances(points: np.ndarray, surface: Surface) -> np.ndarray:
    if isinstance(surface, trimesh.Trimesh):
        return distance_to_mesh(points, surface)
    return cKDTree(surface).query(points)[0]


def distance_to_mesh(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the distance (N,) float64, mm, of points (N, 3), mm, to the nearest triangle of a mesh.

    Triangles with an edge over 2 mm are first cut up (which moves no surface), so that each lies within r <= 1.4 mm of
    its centroid (more only on meshes over 4 m^2). The triangles of the 8 nearest centroids are
    measured exactly; the result is exact once the last of these centroids is farther than the result + r, else 32 and
    at last 128 are taken. What is still open then (points far from a bent surface) is too large by at most r, and never
    too small.
    """
    check_shape("points", points, (None, 3))
    triangles = _small_triangles(mesh)
    centroids = triangles.mean(axis=1)
    radii = np.linalg.norm(triangles - centroids[:, None], axis=2).max(axis=1)
    tree = cKDTree(centroids)
    distances = np.full(len(points), np.inf)
    unsettled = np.arange(len(points))
    for candidates in _CANDIDATES:
        count = min(candidates, len(triangles))
        settled = []
        for start in range(0, len(unsettled), _CHUNK):
            rows = unsettled[start : start + _CHUNK]
            to_centroid, nearest = tree.query(points[rows], k=list(range(1, count + 1)))
            distances[rows] = _nearest_mm(points[rows], triangles, nearest, to_centroid - radii[nearest])
            settled.append((distances[rows] <= to_centroid[:, -1] - radii.max()) | (count == len(triangles)))
        unsettled = unsettled[~np.concatenate([*settled, np.empty(0, dtype=bool)])]
    return distances


def _nearest_mm(points: np.ndarray, triangles: np.ndarray, nearest: np.ndarray, at_least_mm: np.ndarray) -> np.ndarray:
    """Return the smallest distance of each point to its candidate triangles `nearest` (N, K).

    `at_least_mm` (N, K) bounds each distance from below and spares measuring the hopeless.
    """
    first = np.linalg.norm(trimesh.triangles.closest_point(triangles[nearest[:, 0]], points) - points, axis=1)
    rows, columns = np.nonzero(at_least_mm[:, 1:] < first[:, None])
    chosen = triangles[nearest[rows, columns + 1]]
    measured = np.linalg.norm(trimesh.triangles.closest_point(chosen, points[rows]) - points[rows], axis=1)
    np.minimum.at(first, rows, measured)
    return first


def _small_triangles(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the mesh as triangles (F, 3, 3) with no long edge, however coarse the mesh is."""
    longest = max(_LARGEST_EDGE_MM, float(np.sqrt(mesh.area / _MOST_TRIANGLES)))
    if mesh.edges_unique_length.max() <= longest:
        return np.asarray(mesh.triangles)
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=longest, max_iter=40)
    return vertices[faces]
