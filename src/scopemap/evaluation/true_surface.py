"""The true surface of a data set, what of it the camera saw, and all figures of a predicted surface against it.

| data | the true surface | what of it was seen |
|---|---|---|
| phantom | `mesh_truth.ply`: the shape at rest wherever a ray met it, and a rim of 2 voxels | `TrueSurface.seen_by` |
| C3VD | `coverage_mesh.obj`: the whole model, world mm | in the file, face by face |
| SCARED keyframe | `left_depth_map.tiff` or `point_cloud.obj`: points of one view | all; beyond it nothing is known |
| 7-Scenes | none | |

Tissue of a phantom may breathe. The shape at rest is that of frame 0 and of every whole breath; a method that takes the
tissue as rigid is measured against this one shape, and its errors contain the breath.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from scopemap.cameras.camera import CameraModel
from scopemap.errors import InputError, check_shape
from scopemap.evaluation.registration import refine
from scopemap.evaluation.surface import (
    THRESHOLDS_MM,
    DistanceSummary,
    Surface,
    compare_surfaces,
    distances_mm,
    normal_consistency,
    report_of_nothing,
    surface_figures,
    surface_points,
)
from scopemap.evaluation.visibility import View, pixels_near, seen_samples, visible_from
from scopemap.io.decoding import read_decoded

_PHANTOM, _PHANTOM_FRAMES = "mesh_truth.ply", "mesh_truth"
# The second is the name that the data set's page gives.
_C3VD = ("coverage_mesh.obj", "outputMesh.obj")
_SCARED_DEPTH, _SCARED_CLOUD = "left_depth_map.tiff", "point_cloud.obj"
_OBSERVED, _MISSED = 1, 2
_MISSING = float("nan")
_ICP_MISSING = DistanceSummary(*[_MISSING] * 4).figures("accuracy_icp") | {
    "icp_rms_before_mm": _MISSING,
    "icp_rms_after_mm": _MISSING,
}


@dataclass(frozen=True)
class SingleView:
    """The one view that a truth was taken from.

    Attributes
    ----------
    T_world_camera : (4, 4) float64, mm.
    reach_px : a pixel has a truth if a true point falls within this distance of it; larger for loose points.
    """

    T_world_camera: np.ndarray
    reach_px: float = 1.0


@dataclass(frozen=True)
class TrueSurface:
    """What is known of the true surface, in the true world, mm.

    Attributes
    ----------
    surface : a mesh, or points (N, 3).
    seen : (F,) bool, the faces of the mesh that the camera saw; None: not known.
    view : the view that the truth was taken from; None: it is of the whole scene.
    frames : where the tissue moves, the mesh file of every frame, with the faces of `surface`; empty: it is at rest.
    """

    surface: Surface
    seen: np.ndarray | None = None
    view: SingleView | None = None
    frames: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if self.seen is not None:
            check_shape("TrueSurface.seen", self.seen, (len(self._mesh.faces),))

    @property
    def _mesh(self) -> trimesh.Trimesh:
        if not isinstance(self.surface, trimesh.Trimesh):
            raise ValueError("TrueSurface: points have no faces that could be seen; leave unseen points out")
        return self.surface

    @property
    def observed(self) -> Surface | None:
        """The part that the camera saw; None where that is not known. A truth of one view was seen whole."""
        if self.seen is None:
            return None if self.view is None else self.surface
        return trimesh.Trimesh(self._mesh.vertices, self._mesh.faces[self.seen], process=False)

    def seen_by(
        self, camera: CameraModel, views: Iterable[View], *, indices: Sequence[int] | None = None
    ) -> TrueSurface:
        """Return the mesh with `seen` found anew: the faces whose centre some view shows (`seen_samples`).

        Views are (T_world_camera (4, 4), true depth (H, W) mm). Where the tissue moves, each is asked about the mesh of
        its own frame; `indices` are the frame numbers of the views, None: 0, 1, 2 and so on. Raises `InputError` where
        no face is seen, and where a frame's mesh is missing or has other faces.
        """

        def centres_then(number: int) -> np.ndarray:
            return np.asarray(self._mesh_of_frame(number if indices is None else indices[number]).triangles_center)

        centres = np.asarray(self._mesh.triangles_center)
        seen = seen_samples(centres, camera, views, moved=centres_then if self.frames else None)
        if not seen.any():
            raise InputError(
                "no view shows any of the true surface: check that camera, poses and depth belong to it and are in mm"
            )
        return replace(self, seen=seen)

    def _mesh_of_frame(self, index: int) -> trimesh.Trimesh:
        file = next((file for file in self.frames if file.stem.isdigit() and int(file.stem) == index), None)
        if file is None:
            raise InputError(f"the true surface of frame {index} is not among the {len(self.frames)} mesh files")
        mesh = _read_mesh(file)
        if not np.array_equal(mesh.faces, self._mesh.faces):
            raise InputError(f"the mesh {file} has other faces than the surface at rest")
        return mesh


def read_true_surface(folder: Path) -> TrueSurface | None:
    """Return the true surface in the folder of a phantom, a C3VD video or a SCARED keyframe; None where there is none.

    SCARED's points are in the left camera at the keyframe, which is the world of its poses. Raises `InputError` for a
    file that cannot be read.
    """
    folder = Path(folder)
    if (folder / _PHANTOM).is_file():
        frames = sorted((folder / _PHANTOM_FRAMES).glob("*.ply"))
        return TrueSurface(_read_mesh(folder / _PHANTOM), frames=tuple(frames))
    for name in _C3VD:
        if (folder / name).is_file():
            return _read_coverage(folder / name)
    if (folder / _SCARED_DEPTH).is_file():
        return _of_one_view(folder, _read_depth_points(folder / _SCARED_DEPTH))
    if (folder / _SCARED_CLOUD).is_file():
        return _of_one_view(folder, _read_cloud(folder / _SCARED_CLOUD))
    return None


def measure_surface(
    predicted: Surface,
    truth: TrueSurface,
    *,
    camera: CameraModel | None = None,
    icp: bool = True,
    thresholds_mm: Sequence[float] = THRESHOLDS_MM,
) -> dict[str, float]:
    """Return every figure of a predicted surface, which the fit of the camera paths has moved into the true world.

    The names of `surface_figures`, and `normal_consistency` (NaN unless both are meshes); with `icp` also
    accuracy_icp_*, icp_rms_before_mm and icp_rms_after_mm (`registration.refine`). Where nothing was predicted, recall,
    F and coverage are 0 and all else that depends on a prediction is NaN.

    Against a truth of one view only that part of the prediction is measured which the view sees on pixels that have a
    truth. This needs the `camera` of the view, at any size, rectified or not; other truths do not use it.
    """
    if truth.view is not None:
        if camera is None:
            raise ValueError("measure_surface: a truth of one view needs the camera of that view")
        T_world_camera = truth.view.T_world_camera
        valid = pixels_near(surface_points(truth.surface), camera, T_world_camera, radius_px=truth.view.reach_px)
        predicted = visible_from(predicted, camera, T_world_camera, valid)
    if len(predicted.faces if isinstance(predicted, trimesh.Trimesh) else predicted) == 0:
        report = report_of_nothing(truth.surface, observed=truth.observed, thresholds_mm=thresholds_mm)
        return surface_figures(report) | {"normal_consistency": _MISSING} | (_ICP_MISSING if icp else {})
    report = compare_surfaces(predicted, truth.surface, observed=truth.observed, thresholds_mm=thresholds_mm)
    consistency = {"normal_consistency": _normal_consistency(predicted, truth.surface)}
    return surface_figures(report) | consistency | (_icp_figures(predicted, truth.surface) if icp else {})


def _normal_consistency(predicted: Surface, truth: Surface) -> float:
    if isinstance(predicted, trimesh.Trimesh) and isinstance(truth, trimesh.Trimesh):
        return normal_consistency(predicted, truth)
    return _MISSING


def _icp_figures(predicted: Surface, truth: Surface) -> dict[str, float]:
    found = refine(predicted, truth)
    moved = found.similarity.transform_points(surface_points(predicted))
    accuracy = DistanceSummary.of(distances_mm(moved, truth))
    rms = {"icp_rms_before_mm": found.rms_before_mm, "icp_rms_after_mm": found.rms_after_mm}
    return accuracy.figures("accuracy_icp") | rms


def _read_mesh(path: Path) -> trimesh.Trimesh:
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # the readers of mesh files raise whatever their parsers raise
        raise InputError(f"cannot read the true surface {path}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"the true surface {path} holds no triangles")
    return mesh


def _read_coverage(path: Path) -> TrueSurface:
    """Read C3VD's mesh: `v x y z`, two `vt`, `f v/vt[/vn] ...`, all corners of a face with vt 1 = observed, 2 = missed.

    Source: the data set's page and `RenderingModule.cpp`, `writeOBJ` (github.com/DurrLab/C3VD). Common readers of OBJ
    give coordinates of texture, not their indices, and may reorder or split vertices: hence read here.
    """
    lines = _read_lines(path)
    vertices = _numbers(path, [line[2:] for line in lines if line.startswith("v ")])[:, :3]
    corners, marks = _corners(path, [line[2:] for line in lines if line.startswith("f ")])
    if corners.min() < 1 or corners.max() > len(vertices):
        raise InputError(f"cannot read the true surface {path}: a face names none of the {len(vertices)} vertices")
    if not np.isin(marks, (_OBSERVED, _MISSED)).all() or (marks != marks[:, :1]).any():
        raise InputError(f"cannot read the coverage in {path}: expected vt 1 (observed) or 2 (missed) on every face")
    return TrueSurface(trimesh.Trimesh(vertices, corners - 1, process=False), marks[:, 0] == _OBSERVED)


def _corners(path: Path, faces: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertex and texture numbers (F, 3) each, as written, of the faces of an OBJ file."""
    table = _numbers(path, [face.replace("/", " ") for face in faces])
    per_corner = table.shape[1] // 3
    # Without this count `v//vn` would pass for `v/vt`, and a hexagon for a triangle.
    slashes = sum(face.count("/") for face in faces)
    if table.shape[1] not in (6, 9) or slashes != 3 * (per_corner - 1) * len(table):
        raise InputError(f"cannot read the coverage in {path}: expected triangles `f v/vt v/vt v/vt`, as C3VD writes")
    corners, marks = table.astype(np.int64).reshape(-1, 3, per_corner)[..., :2].transpose(2, 0, 1)
    return corners, marks


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"cannot read the true surface {path}: {error.strerror or error}") from None


def _numbers(path: Path, rows: list[str]) -> np.ndarray:
    """Return rows of equally many numbers, (N, M) float64; `nan` is a number."""
    try:
        table = np.loadtxt(rows, ndmin=2) if rows else np.zeros((0, 0))
    except ValueError as error:
        raise InputError(f"cannot read the true surface {path}: {error}") from None
    if table.shape[1] < 3:
        raise InputError(f"cannot read the true surface {path}: expected lines `v x y z` and `f v/vt v/vt v/vt`")
    return table


def _read_depth_points(path: Path) -> np.ndarray:
    """Return SCARED's points (N, 3), mm, one per pixel, NaN where there is none; OpenCV reverses x, y, z."""
    points = read_decoded(path)
    if points is None or points.ndim != 3 or points.shape[2] != 3:
        raise InputError(f"cannot read the true surface {path}: expected an image of three channels, x, y and z")
    return points[..., ::-1].reshape(-1, 3)


def _read_cloud(path: Path) -> np.ndarray:
    """Return SCARED's points (N, 3), mm, one line each, `nan` where there is none."""
    return _numbers(path, [line[2:] for line in _read_lines(path) if line.startswith("v ")])[:, :3]


def _of_one_view(folder: Path, points_mm: np.ndarray) -> TrueSurface:
    with np.errstate(invalid="ignore"):
        known = np.isfinite(points_mm).all(axis=1) & (points_mm[:, 2] > 0)
    if not known.any():
        raise InputError(f"the true points of the keyframe in {folder} are all missing")
    return TrueSurface(points_mm[known].astype(np.float64), view=SingleView(np.eye(4)))
