"""The true surface of a data set, its observed part, and all figures of a predicted surface against it.

| data | the true surface | observed part |
|---|---|---|
| phantom | `mesh_truth.ply`: the shape at rest wherever a ray met it | `TrueSurface.seen_by` |
| C3VD | `coverage_mesh.obj`: the whole model, world mm | in the file, face by face |
| SCARED keyframe | `left_depth_map.tiff` or `point_cloud.obj`: points of one view | all |

A method that takes breathing tissue as rigid is measured against the shape at rest; its errors include the breath.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from scopemap.cameras.camera import CameraModel
from scopemap.errors import InputError
from scopemap.evaluation.surface import (
    Surface,
    compare_surfaces,
    distance_figures,
    distances_mm,
    is_empty,
    normal_consistency,
    refine,
    surface_points,
)
from scopemap.evaluation.visibility import TrueView, pixels_near, seen_points, visible_from
from scopemap.io.decoding import read_decoded

_PHANTOM, _PHANTOM_FRAMES = "mesh_truth.ply", "mesh_truth"
# The second is the name on the data set's page.
_C3VD = ("coverage_mesh.obj", "outputMesh.obj")
_SCARED_DEPTH, _SCARED_CLOUD = "left_depth_map.tiff", "point_cloud.obj"
_OBSERVED, _MISSED = 1, 2


@dataclass(frozen=True)
class TrueSurface:
    """A true surface in the true world, mm.

    Attributes
    ----------
    surface : a mesh, or points (N, 3).
    seen : (F,) bool, the faces of the mesh that the camera saw; None: not known.
    frames : where the tissue moves, the mesh file of every frame, with the faces of `surface`; empty: it is at rest.
    T_view : (4, 4), world from camera, mm, of the one view that the truth was taken from; None: the whole scene.
    reach_px : a pixel of that view has a truth if a true point falls within this distance; larger for sparse points.
    """

    surface: Surface
    seen: np.ndarray | None = None
    frames: tuple[Path, ...] = ()
    T_view: np.ndarray | None = None
    reach_px: float = 1.0

    @property
    def _mesh(self) -> trimesh.Trimesh:
        assert isinstance(self.surface, trimesh.Trimesh), "points have no faces that could be seen"
        return self.surface

    @property
    def observed(self) -> Surface | None:
        """The part that the camera saw; None where that is not known. A truth of one view is all observed."""
        if self.seen is None:
            return None if self.T_view is None else self.surface
        return trimesh.Trimesh(self._mesh.vertices, self._mesh.faces[self.seen], process=False)

    def seen_by(self, camera: CameraModel, views: Mapping[int, TrueView]) -> TrueSurface:
        """Return the mesh with a new `seen`: the faces whose centre some view, by its frame's number, sees.

        Where the tissue moves, each view is compared with the mesh of its own frame. Raises `InputError` where no face
        is seen, and where a frame's mesh is missing or has other faces.
        """
        seen = np.zeros(len(self._mesh.faces), dtype=bool)
        for index, view in views.items():
            mesh = self._mesh_of_frame(index) if self.frames else self._mesh
            seen |= seen_points(np.asarray(mesh.triangles_center), camera, view)
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

    SCARED's points are in the left camera at the keyframe, the world of its poses. `InputError` for an unreadable file.
    """
    folder = Path(folder)
    if (folder / _PHANTOM).is_file():
        return TrueSurface(
            _read_mesh(folder / _PHANTOM), frames=tuple(sorted((folder / _PHANTOM_FRAMES).glob("*.ply")))
        )
    for name in _C3VD:
        if (folder / name).is_file():
            return _read_coverage(folder / name)
    for name, read in ((_SCARED_DEPTH, _read_depth_points), (_SCARED_CLOUD, _read_cloud)):
        if (folder / name).is_file():
            points_mm = read(folder / name)
            with np.errstate(invalid="ignore"):
                known = np.isfinite(points_mm).all(axis=1) & (points_mm[:, 2] > 0)
            if not known.any():
                raise InputError(f"the true points of the keyframe in {folder} are all missing")
            return TrueSurface(points_mm[known].astype(np.float64), T_view=np.eye(4))
    return None


def measure_surface(
    predicted: Surface, truth: TrueSurface, *, camera: CameraModel | None = None, icp: bool = True
) -> dict[str, float]:
    """Return every figure of a predicted surface, which the alignment of the trajectories has moved to the true world.

    The names of `compare_surfaces`, and `normal_consistency`; with `icp` also accuracy_icp_*, icp_rms_before_mm and
    icp_rms_after_mm. Against a truth of one view, only the part of the prediction is measured that the view, whose
    `camera` is then needed, sees on pixels with a truth.
    """
    if truth.T_view is not None:
        if camera is None:
            raise ValueError("measure_surface: a truth of one view needs the camera of that view")
        valid = pixels_near(surface_points(truth.surface), camera, truth.T_view, radius_px=truth.reach_px)
        predicted = visible_from(predicted, camera, truth.T_view, valid)
    figures = compare_surfaces(predicted, truth.surface, observed=truth.observed)
    figures["normal_consistency"] = normal_consistency(predicted, truth.surface)
    return figures | (_icp_figures(predicted, truth.surface) if icp else {})


def _icp_figures(predicted: Surface, truth: Surface) -> dict[str, float]:
    before_mm = after_mm = float("nan")
    distances = np.empty(0)
    if not is_empty(predicted):
        similarity, before_mm, after_mm = refine(predicted, truth)
        distances = distances_mm(similarity.transform_points(surface_points(predicted)), truth)
    rms = {"icp_rms_before_mm": before_mm, "icp_rms_after_mm": after_mm}
    return distance_figures("accuracy_icp", distances) | rms


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

    Source: `RenderingModule.cpp`, `writeOBJ` (github.com/DurrLab/C3VD). Readers of OBJ give no indices of `vt`.
    """
    lines = _read_lines(path)
    vertices = _numbers(path, [line[2:] for line in lines if line.startswith("v ")])
    faces = [line.split()[1:] for line in lines if line.startswith("f ")]
    try:
        corners, marks = np.array([[c.split("/")[:2] for c in face] for face in faces], np.int64).transpose(2, 0, 1)
        if corners.shape[1] != 3:
            raise ValueError
    except ValueError:
        raise InputError(
            f"cannot read the coverage in {path}: expected triangles `f v/vt v/vt v/vt`, as C3VD writes"
        ) from None
    if corners.min() < 1 or corners.max() > len(vertices):
        raise InputError(f"cannot read the true surface {path}: a face names none of the {len(vertices)} vertices")
    if not np.isin(marks, (_OBSERVED, _MISSED)).all() or (marks != marks[:, :1]).any():
        raise InputError(f"cannot read the coverage in {path}: expected vt 1 (observed) or 2 (missed) on every face")
    return TrueSurface(trimesh.Trimesh(vertices, corners - 1, process=False), marks[:, 0] == _OBSERVED)


def _read_depth_points(path: Path) -> np.ndarray:
    """Return SCARED's points (N, 3), mm, one per pixel, NaN where there is none; OpenCV reverses x, y, z."""
    points = read_decoded(path)
    if points is None or points.ndim != 3 or points.shape[2] != 3:
        raise InputError(f"cannot read the true surface {path}: expected an image of three channels, x, y and z")
    return points[..., ::-1].reshape(-1, 3)


def _read_cloud(path: Path) -> np.ndarray:
    """Return SCARED's points (N, 3), mm, one line each, `nan` where there is none."""
    return _numbers(path, [line[2:] for line in _read_lines(path) if line.startswith("v ")])


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"cannot read the true surface {path}: {error.strerror or error}") from None


def _numbers(path: Path, rows: list[str]) -> np.ndarray:
    """Return the first three numbers of each row, (N, 3) float64; `nan` is a number."""
    try:
        table = np.loadtxt(rows, ndmin=2) if rows else np.zeros((0, 0))
    except ValueError as error:
        raise InputError(f"cannot read the true surface {path}: {error}") from None
    if table.shape[1] < 3:
        raise InputError(f"cannot read the true surface {path}: expected lines `v x y z`")
    return table[:, :3]
