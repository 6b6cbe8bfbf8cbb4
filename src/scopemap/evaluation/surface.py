"""Surfaces against the true surface: accuracy, completeness, Chamfer distance, precision, recall and F-score.

Definitions: Knapitsch et al., "Tanks and Temples: benchmarking large-scale scene reconstruction", ACM TOG 36(4), 2017,
section 4.2. Of a mesh the surface counts, not its vertices. The thresholds of 1, 2 and 5 mm are our choice. Both
surfaces are in one world: the prediction is first moved by the alignment of the trajectories.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.errors import check_shape
from scopemap.evaluation.point_to_mesh import distance_to_mesh

Surface = np.ndarray | trimesh.Trimesh
"""A mesh, or points (N, 3), mm."""

THRESHOLDS_MM = (1.0, 2.0, 5.0)
"""Distances at which precision, recall and F-score are given."""

_SAMPLES_PER_MM2 = 4.0
_SAMPLES = (1_000, 200_000)
_COVERED_MM = 2.0


@dataclass(frozen=True)
class DistanceSummary:
    """Mean, median, root mean square and 90th percentile of distances, mm; NaN where there are none."""

    mean_mm: float
    median_mm: float
    rms_mm: float
    p90_mm: float

    @classmethod
    def of(cls, distances_mm: np.ndarray) -> DistanceSummary:
        """Summarise distances of shape (N,)."""
        if len(distances_mm) == 0:
            return cls(*[float("nan")] * 4)
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
    """Distances of the predicted surface to the truth (accuracy) and of the truth to it (completeness).

    Attributes
    ----------
    accuracy : of the predicted surface to the whole true surface.
    completeness : of the true surface to the predicted one: of its observed part where that is known, else of all.
    scores : precision and recall at each threshold; recall is measured where completeness is.
    observed_share : observed area over the whole true area, 0..1; NaN: not known, completeness is over all.
    coverage_2mm : share of the observed true surface nearer than 2 mm to the predicted one, 0..1; NaN: not known which
        part was observed.
    """

    accuracy: DistanceSummary
    completeness: DistanceSummary
    scores: tuple[FScore, ...]
    observed_share: float
    coverage_2mm: float

    @property
    def chamfer_mm(self) -> float:
        """Mean of mean accuracy and mean completeness (Chamfer-L1)."""
        return (self.accuracy.mean_mm + self.completeness.mean_mm) / 2

    @property
    def figures(self) -> dict[str, float]:
        """Every figure by its flat name; NaN means "not known".

        accuracy_mean_mm, _median_mm, _rms_mm, _p90_mm; completeness_... likewise; chamfer_mm; precision_1mm,
        recall_1mm, f_1mm and so on for each threshold; coverage_2mm; observed_share.
        """
        figures = self.accuracy.figures("accuracy") | self.completeness.figures("completeness")
        figures["chamfer_mm"] = self.chamfer_mm
        for score in self.scores:
            limit = f"{score.threshold_mm:g}mm"
            figures[f"precision_{limit}"] = score.precision
            figures[f"recall_{limit}"] = score.recall
            figures[f"f_{limit}"] = score.f_score
        return figures | {"coverage_2mm": self.coverage_2mm, "observed_share": self.observed_share}


def compare_surfaces(predicted: Surface, truth: Surface, *, observed: Surface | None = None) -> SurfaceReport:
    """Compare two surfaces of the same world, each a mesh or points (N, 3), mm.

    `observed` is the part of the truth that the camera saw, None: not known. Completeness, recall and coverage are
    measured on that part; accuracy on the whole truth, since a prediction beyond the observed part may be right. Meshes
    are sampled evenly, 4 points per mm^2 but at most 200 000, by a fixed seed. Distances to a mesh are to its triangles
    (`distance_to_mesh`), those to points are to the nearest point. Of an empty prediction recall and coverage are 0 and
    distances and precision NaN. Raises `ValueError` for an empty truth.
    """
    reached = truth if observed is None else observed
    if is_empty(predicted):
        from_predicted = from_truth = np.empty(0)
        recalls = [0.0] * len(THRESHOLDS_MM)
        precisions, covered = [float("nan")] * len(THRESHOLDS_MM), 0.0
    else:
        from_predicted = distances_mm(surface_points(predicted), truth)
        from_truth = distances_mm(surface_points(reached), predicted)
        precisions, recalls = (
            [float(np.mean(distances < limit)) for limit in THRESHOLDS_MM] for distances in (from_predicted, from_truth)
        )
        covered = float(np.mean(from_truth < _COVERED_MM))
    return SurfaceReport(
        accuracy=DistanceSummary.of(from_predicted),
        completeness=DistanceSummary.of(from_truth),
        scores=tuple(map(FScore, THRESHOLDS_MM, precisions, recalls)),
        observed_share=float("nan") if observed is None else _extent(observed) / _extent(truth),
        coverage_2mm=float("nan") if observed is None else covered,
    )


def normal_consistency(predicted: Surface, truth: Surface) -> float:
    """Return the mean |cosine| between the normals of nearest samples of two meshes, 1 = parallel, both ways.

    NaN unless both are meshes with triangles. Unsigned, since fused and true meshes need not agree on the outer side.
    Mescheder et al., "Occupancy networks", CVPR 2019, section 4 (metrics).
    """
    if not (isinstance(predicted, trimesh.Trimesh) and isinstance(truth, trimesh.Trimesh)) or is_empty(predicted):
        return float("nan")
    samples = [oriented_samples(predicted), oriented_samples(truth)]
    means = []
    for (points, normals), (others, other_normals) in (samples, samples[::-1]):
        nearest = cKDTree(others).query(points)[1]
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


def oriented_samples(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) float64, mm, spread evenly over a mesh and the unit normals (N, 3) of their triangles.

    4 points per mm^2, at least 1000 and at most 200 000, by a fixed seed. Raises `ValueError` for a mesh without area.
    """
    if len(mesh.faces) == 0 or mesh.area == 0:
        raise ValueError("surface: the mesh has no area")
    count = int(np.clip(np.ceil(_SAMPLES_PER_MM2 * mesh.area), *_SAMPLES))
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    return np.asarray(points), np.asarray(mesh.face_normals)[faces]


def distances_mm(points: np.ndarray, surface: Surface) -> np.ndarray:
    """Return the distance (N,) float64, mm, of points (N, 3), mm, to a mesh's triangles or to the nearest point."""
    if isinstance(surface, trimesh.Trimesh):
        return distance_to_mesh(points, surface)
    return cKDTree(surface).query(points)[0]


def _extent(surface: Surface) -> float:
    return float(surface.area) if isinstance(surface, trimesh.Trimesh) else float(len(surface))
