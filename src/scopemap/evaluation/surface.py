"""Surfaces against the true surface: accuracy, completeness, Chamfer distance, precision, recall and F-score.

Definitions: Knapitsch et al., "Tanks and Temples: benchmarking large-scale scene reconstruction", ACM TOG 36(4), 2017,
section 4.2. Where a mesh is given its surface counts, not its vertices. The thresholds of 1, 2 and 5 mm are our choice.

Both surfaces lie in one world already: the prediction is moved by the fit of the camera paths first. What a further fit
of the surfaces themselves gains is a separate number (`registration`). What is known to be true: `true_surface`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.errors import check_shape

Surface = np.ndarray | trimesh.Trimesh

THRESHOLDS_MM = (1.0, 2.0, 5.0)
"""Distances at which precision, recall and F-score are given."""

_SAMPLES_PER_MM2 = 4.0
_SAMPLES = (1_000, 200_000)
_LARGEST_EDGE_MM = 2.0
_MOST_TRIANGLES = 1_000_000
_CANDIDATES = (8, 32, 128)
_CHUNK = 5_000
_COVERED_MM = 2.0


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

    def figures(self, name: str) -> dict[str, float]:
        """Return the figures as `NAME_mean_mm` and so on."""
        return {f"{name}_{key}": value for key, value in asdict(self).items()}


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
    """How far the predicted surface is from the truth (accuracy) and the truth from it (completeness).

    Attributes
    ----------
    accuracy : of the predicted surface to the whole true surface.
    completeness : of the true surface to the predicted one: of its observed part where that is known, else of all.
    scores : precision and recall at each threshold; recall is measured where completeness is.
    observed_share : area that was observed over the whole true area, 0..1; NaN: not known, nothing was left out.
    coverage_2mm : share of the observed true surface nearer than 2 mm to the predicted one, 0..1; NaN: not known which
        part was observed.
    """

    accuracy: DistanceSummary
    completeness: DistanceSummary
    scores: tuple[FScore, ...]
    observed_share: float = float("nan")
    coverage_2mm: float = float("nan")

    @property
    def observed_only(self) -> bool:
        """Whether completeness and recall speak of the observed part of the truth only."""
        return not np.isnan(self.observed_share)

    @property
    def chamfer_mm(self) -> float:
        """Mean of mean accuracy and mean completeness (Chamfer-L1)."""
        return (self.accuracy.mean_mm + self.completeness.mean_mm) / 2


def compare_surfaces(
    predicted: Surface,
    truth: Surface,
    *,
    observed: Surface | None = None,
    thresholds_mm: Sequence[float] = THRESHOLDS_MM,
) -> SurfaceReport:
    """Compare two surfaces of the same world, each a mesh or points (N, 3), mm.

    `observed` is the part of the truth that the camera saw, None: not known. What nobody saw cannot be asked for, so
    completeness, recall and coverage are then measured on that part; accuracy still on the whole truth, since a guess
    beyond the seen part may be right. Meshes are sampled evenly, 4 points per mm^2 but at most 200 000, by a fixed
    seed. Distances to a mesh are to its triangles (`distance_to_mesh`), those to points are to the nearest point.
    Raises `ValueError` for an empty surface.
    """
    from_predicted = distances_mm(surface_points(predicted), truth)
    from_truth = distances_mm(surface_points(truth if observed is None else observed), predicted)
    scores = tuple(
        FScore(float(limit), float(np.mean(from_predicted < limit)), float(np.mean(from_truth < limit)))
        for limit in thresholds_mm
    )
    report = SurfaceReport(DistanceSummary.of(from_predicted), DistanceSummary.of(from_truth), scores)
    if observed is None:
        return report
    covered = float(np.mean(from_truth < _COVERED_MM))
    return replace(report, observed_share=_extent(observed) / _extent(truth), coverage_2mm=covered)


def report_of_nothing(
    truth: Surface, *, observed: Surface | None = None, thresholds_mm: Sequence[float] = THRESHOLDS_MM
) -> SurfaceReport:
    """Return the report where nothing was predicted: recall and coverage are 0, distances and precision NaN."""
    missing = float("nan")
    scores = tuple(FScore(float(limit), missing, 0.0) for limit in thresholds_mm)
    report = SurfaceReport(DistanceSummary(*[missing] * 4), DistanceSummary(*[missing] * 4), scores)
    if observed is None:
        return report
    return replace(report, observed_share=_extent(observed) / _extent(truth), coverage_2mm=0.0)


def surface_figures(report: SurfaceReport) -> dict[str, float]:
    """Return every figure of a report by its flat name, fit for JSON but for NaN, which means "not known".

    accuracy_mean_mm, _median_mm, _rms_mm, _p90_mm; completeness_... likewise; chamfer_mm; precision_1mm, recall_1mm,
    f_1mm and so on for each threshold; coverage_2mm; observed_share, which tells what completeness and recall were
    measured on: on this share of the true surface, or on all of it where it is NaN.
    """
    figures = report.accuracy.figures("accuracy") | report.completeness.figures("completeness")
    figures["chamfer_mm"] = report.chamfer_mm
    for score in report.scores:
        limit = f"{score.threshold_mm:g}mm"
        figures |= {f"precision_{limit}": score.precision, f"recall_{limit}": score.recall, f"f_{limit}": score.f_score}
    return figures | {"coverage_2mm": report.coverage_2mm, "observed_share": report.observed_share}


def normal_consistency(predicted: trimesh.Trimesh, truth: trimesh.Trimesh) -> float:
    """Return the mean |cosine| between the normals of nearest samples of two meshes, 1 = parallel, both ways averaged.

    Unsigned, since fused and true meshes need not agree on which side is out. Mescheder et al., "Occupancy networks",
    CVPR 2019, section 4 (metrics).
    """
    sides = [oriented_samples(predicted), oriented_samples(truth)]
    means = []
    for (points, normals), (others, other_normals) in (sides, sides[::-1]):
        nearest = cKDTree(others).query(points)[1]
        means.append(float(np.mean(np.abs(np.sum(normals * other_normals[nearest], axis=1)))))
    return sum(means) / 2


def surface_points(surface: Surface, *, seed: int = 0) -> np.ndarray:
    """Return points (N, 3) float64 spread evenly over a mesh, or the points themselves; `ValueError` if empty."""
    if isinstance(surface, trimesh.Trimesh):
        return oriented_samples(surface, seed=seed)[0]
    check_shape("surface", surface, (None, 3))
    if len(surface) == 0:
        raise ValueError("surface: there are no points")
    return np.asarray(surface, dtype=np.float64)


def oriented_samples(mesh: trimesh.Trimesh, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) float64, mm, spread evenly over a mesh and the unit normals (N, 3) of their triangles.

    4 points per mm^2, at least 1000 and at most 200 000, in no order. Raises `ValueError` for a mesh without area.
    """
    if len(mesh.faces) == 0 or mesh.area == 0:
        raise ValueError("surface: the mesh has no area")
    count = int(np.clip(np.ceil(_SAMPLES_PER_MM2 * mesh.area), *_SAMPLES))
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points), np.asarray(mesh.face_normals)[faces]


def distances_mm(points: np.ndarray, surface: Surface) -> np.ndarray:
    """Return the distance (N,) float64, mm, of points (N, 3), mm, to a mesh's triangles or to the nearest point."""
    if isinstance(surface, trimesh.Trimesh):
        return distance_to_mesh(points, surface)
    return cKDTree(surface).query(points)[0]


def _extent(surface: Surface) -> float:
    return float(surface.area) if isinstance(surface, trimesh.Trimesh) else float(len(surface))


def distance_to_mesh(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the distance (N,) float64, mm, of points (N, 3), mm, to the nearest triangle of a mesh.

    Triangles with an edge over 2 mm are first cut up (which moves no surface), so that each lies within r <= 1.4 mm of
    its centroid (more only on meshes over 4 m^2). The triangles of the 8 nearest centroids are
    measured exactly; the result is exact once the last of these centroids is farther than the result + r, else 32 and
    at last 128 are taken. What is still open then (points far from a bent surface) is too large by at most r, and never
    too small.
    """
    check_shape("points", points, (None, 3))
    triangles = small_triangles(mesh)
    centroids = triangles.mean(axis=1)
    radii = np.linalg.norm(triangles - centroids[:, None], axis=2).max(axis=1)
    normals = trimesh.util.unitize(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    tree = cKDTree(centroids)
    distances = np.full(len(points), np.inf)
    unsettled = np.arange(len(points))
    for candidates in _CANDIDATES:
        count = min(candidates, len(triangles))
        settled = []
        for start in range(0, len(unsettled), _CHUNK):
            rows = unsettled[start : start + _CHUNK]
            to_centroid, nearest = tree.query(points[rows], k=list(range(1, count + 1)))
            at_least = _at_least_mm(points[rows, None] - centroids[nearest], normals[nearest], radii[nearest])
            distances[rows] = _nearest_mm(points[rows], triangles, nearest, at_least)
            settled.append((distances[rows] <= to_centroid[:, -1] - radii.max()) | (count == len(triangles)))
        unsettled = unsettled[~np.concatenate([*settled, np.empty(0, dtype=bool)])]
    return distances


def _at_least_mm(offsets: np.ndarray, normals: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return a lower bound (N, K) of the distance to triangles: to the disc of `radii` about each in its plane.

    `offsets` (N, K, 3) lead from the centroids to the points. A triangle without area has normal 0 and a ball's bound.
    """
    height = np.einsum("nki,nki->nk", offsets, normals)
    aside = np.sqrt(np.maximum(np.einsum("nki,nki->nk", offsets, offsets) - height**2, 0.0))
    return np.hypot(height, np.maximum(aside - radii, 0.0))


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


def small_triangles(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the mesh as triangles (F, 3, 3) with no edge over 2 mm (more only on meshes over 4 m^2)."""
    longest = max(_LARGEST_EDGE_MM, float(np.sqrt(mesh.area / _MOST_TRIANGLES)))
    if mesh.edges_unique_length.max() <= longest:
        return np.asarray(mesh.triangles)
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=longest, max_iter=40)
    return vertices[faces]
