"""The truth for `scopemap coverage`: which faces of the tissue any frame shows, and errors of shares and blind spots.

C3VD states it face by face (`coverage_mesh.obj`). A phantom's frame shows a face that is turned to the camera and whose
middle is not behind the farthest of 3 x 3 pixels of the true depth around it. The tissue that there is are the faces in
the bins of the map that were examined, after the Sim(3) of the run's path to the truth.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.apps.coverage.coverage import Coverage, regions, smoothed
from scopemap.apps.coverage.layout import Lumen, binned, column_of
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.evaluation.poses import match
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.evaluation.true_surface import read_true_surface
from scopemap_bench.phantom.render import prepare
from scopemap_bench.phantom.spec import Event, PhantomSpec
from scopemap_bench.phantom.writer import CLIPPED, seen_surface

LEAST_SPOT_MM2 = 100.0
_TOLERANCE_MM = 0.3
_FARTHEST_RADII = 4.0  # from the centreline, or the centre; what is farther is another part of the organ
_MOST_UNSEEN = 0.5  # share of a true bin that is not seen from which it belongs to a true blind spot


@dataclass(frozen=True)
class CoverageErrors:
    """The truth beside what `scopemap coverage` found.

    share, segments : true shares not seen, of the whole and of each segment. found : for each true blind spot of 1 cm2
    and more whether listed spots of that size hold half of what was not seen of it. right : for each
    listed one of that size whether half of the tissue there was not seen.
    """

    share: float
    segments: list[float]
    found: list[bool]
    right: list[bool]


def read_spec(folder: Path) -> PhantomSpec:
    """Return the spec of a phantom's folder."""
    spec = json.loads((folder / "phantom.json").read_text(encoding="utf-8"))["spec"]
    spec["events"] = tuple(Event(**event) for event in spec["events"])
    files = {name: spec[name] and Path(spec[name]) for name in ("camera_file", "path_file")}
    return PhantomSpec(**(spec | files))


def shown_faces(folder: Path) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return the whole surface of a phantom at rest, mm, and which of its faces (F,) any frame shows."""
    phantom = prepare(read_spec(folder))
    camera, scale_mm = phantom.spec.camera, phantom.spec.depth_scale_mm
    mesh = seen_surface(phantom.volume, np.ones(phantom.volume.coefficients.shape, bool))
    centres, normals = mesh.triangles_center, mesh.face_normals
    shown = np.zeros(len(centres), bool)
    for index, T_world_camera in enumerate(phantom.poses):
        left = np.flatnonzero(~shown)
        points = transform(inverse(T_world_camera), centres[left])
        facing = ((T_world_camera[:3, 3] - centres[left]) * normals[left]).sum(1) > 0
        left, points = left[facing & (points[:, 2] > 0)], points[facing & (points[:, 2] > 0)]
        column, row = np.round(camera.project(points)).astype(int).T
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        coded = np.asarray(cv2.imread(str(folder / f"{index:04d}_depth.tiff"), cv2.IMREAD_UNCHANGED))
        farthest_mm = cv2.dilate(np.where(coded < CLIPPED, coded * scale_mm, np.inf), np.ones((3, 3), np.uint8))
        reached = points[inside, 2] <= farthest_mm[row[inside], column[inside]] + _TOLERANCE_MM
        shown[left[inside][reached]] = True
    return mesh, shown


def observed_faces(folder: Path) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return the whole surface of a C3VD video, mm, and which of its faces (F,) its coverage mesh calls observed.

    Raises `InputError` for a folder without a coverage mesh.
    """
    truth = read_true_surface(folder)
    if truth is None or truth.seen is None or not isinstance(truth.surface, trimesh.Trimesh):
        raise InputError(f"{folder} holds no coverage_mesh.obj that says which faces were observed")
    return truth.surface, truth.seen


def similarity_to_truth(run: Path, source: Path) -> Similarity:
    """Return what takes a run's world to that of its phantom or C3VD video."""
    return match(read_trajectory(run), read_trajectory(source), "sim3").similarity


def coverage_errors(found: Coverage, to_truth: Similarity, mesh: trimesh.Trimesh, shown: np.ndarray) -> CoverageErrors:
    """Return what was found of a run beside the truth of `shown_faces` or `observed_faces`."""
    back, chart, layout = to_truth.inverse(), found.map, found.layout
    points = back.transform_points(mesh.triangles_center)
    row, hours, _ = layout.place(points, mesh.face_normals @ back.R.T)
    row, column, rows = row - found.first, column_of(hours), len(chart.along)
    middle = layout.line.points_mm if isinstance(layout, Lumen) else layout.centre_mm[None]
    near = cKDTree(middle).query(points)[0] <= _FARTHEST_RADII * layout.radius_mm
    own = near & (row >= 0) & (row < rows)
    own[own] = np.isfinite(chart.unseen[row[own], column[own]])
    row, hours, area, shown = row[own], hours[own], mesh.area_faces[own], shown[own]
    hidden, seen = (binned(row, hours, area * chosen, rows) for chosen in (~shown, shown))
    parts = [(chart.along > part.start) & (chart.along < part.end) for part in found.segments]
    listed = [n + 1 for n, spot in enumerate(found.spots) if spot.area * to_truth.scale**2 >= LEAST_SPOT_MM2]
    hidden_around, seen_around = smoothed(hidden), smoothed(seen)
    share = hidden_around / np.maximum(hidden_around + seen_around, 1e-9)
    true = regions((share > _MOST_UNSEEN) & np.isfinite(chart.unseen))
    sizes = np.bincount(true.ravel(), hidden_around.ravel())
    spots = [n for n in range(1, len(sizes)) if sizes[n] >= LEAST_SPOT_MM2]
    held = np.isin(chart.spot, listed)
    return CoverageErrors(
        float(hidden.sum() / (hidden + seen).sum()),
        [float(hidden[part].sum() / max((hidden + seen)[part].sum(), 1e-9)) for part in parts],
        [bool(hidden_around[(true == n) & held].sum() >= 0.5 * sizes[n]) for n in spots],
        [bool(hidden[chart.spot == n].sum() >= 0.5 * (hidden + seen)[chart.spot == n].sum()) for n in listed],
    )
