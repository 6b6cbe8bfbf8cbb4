"""The true surface of a data set, its part that a camera sees, and all figures of a predicted surface against it.

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

import cv2
import numpy as np
import trimesh

from scopemap.engine.cameras.camera import CameraModel
from scopemap.engine.errors import InputError, reporting
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.decoding import read_decoded
from scopemap_bench.evaluation.surface import (
    Surface,
    compare_surfaces,
    distance_figures,
    distances_mm,
    is_empty,
    normal_consistency,
    refine,
    small_triangles,
    surface_points,
    thinned,
)

TrueView = tuple[np.ndarray, np.ndarray]
"""One frame's pose (4, 4), camera to world, mm, and its true depth (H, W), mm, NaN = unknown."""

_TOLERANCE = 0.02
_NEARER = 0.01
_SUBPIXEL_BITS = 4
_PAINTED_PX = 1280
_OBSERVED = 1
_MISSED = 2


def seen_points(points_mm: np.ndarray, camera: CameraModel, view: TrueView) -> np.ndarray:
    """Return which points (N, 3), world mm, one view sees, (N,) bool: its true depth is within 2 % of the point's."""
    T_world_camera, depth_mm = view
    seen = np.zeros(len(points_mm), dtype=bool)
    rows, columns, z_mm, inside = _pixels(points_mm, camera, T_world_camera)
    true_mm = depth_mm[rows, columns]
    # Unknown depth is NaN and matches nothing.
    seen[inside] = np.abs(z_mm - true_mm) <= _TOLERANCE * true_mm
    return seen


def visible_from(
    surface: Surface, camera: CameraModel, T_world_camera: np.ndarray, valid: np.ndarray | None = None
) -> Surface:
    """Return the part of a surface, world mm, that one view sees on its `valid` pixels (H, W), None: on all.

    Triangles of 2 mm are painted from far to near on a grid at least 1280 wide; one is kept unless the ray to its
    centre meets the triangle painted there more than 1 % nearer. Points hide nothing.
    """
    usable = np.ones((camera.height, camera.width), dtype=bool) if valid is None else valid
    if not isinstance(surface, trimesh.Trimesh):
        rows, columns, _, inside = _pixels(surface, camera, T_world_camera)
        return surface[inside[usable[rows, columns]]]
    if is_empty(surface):
        return surface
    triangles = small_triangles(surface)
    local = transform(inverse(T_world_camera), triangles.reshape(-1, 3)).reshape(triangles.shape)
    rows, columns, _, inside = _pixels(local.mean(axis=1), camera, np.eye(4))
    in_view = inside[usable[rows, columns]]
    kept = in_view[~_hidden(local, in_view, camera)]
    corners = np.arange(3 * len(kept)).reshape(-1, 3)
    return trimesh.Trimesh(triangles[kept].reshape(-1, 3), corners, process=False)


def pixels_near(
    points_mm: np.ndarray, camera: CameraModel, T_world_camera: np.ndarray, *, radius_px: float
) -> np.ndarray:
    """Return the pixels (H, W) bool within `radius_px` of the projection of any point (N, 3), world mm."""
    hit = np.zeros((camera.height, camera.width), dtype=np.uint8)
    rows, columns, _, _ = _pixels(points_mm, camera, T_world_camera)
    hit[rows, columns] = 1
    away_px = cv2.distanceTransform(1 - hit, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (away_px <= radius_px) & hit.any()


def _pixels(
    points_mm: np.ndarray, camera: CameraModel, T_world_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and z (M,) of the points inside the image, and their numbers (M,)."""
    local = transform(inverse(T_world_camera), points_mm)
    pixels = camera.project(local)
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(((pixels >= -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(axis=1))
    columns, rows = np.rint(pixels[inside]).astype(np.intp).T
    return rows, columns, local[inside, 2], inside


def _hidden(triangles: np.ndarray, chosen: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Return which of the `chosen` (M,) triangles (F, 3, 3), in the camera, are behind the painted ones' planes."""
    finer = -(-_PAINTED_PX // camera.width)
    grid = camera.resized(finer * camera.width, finer * camera.height)
    nearest = _nearest_triangle(triangles, grid)
    centres = triangles[chosen].mean(axis=1)
    rows, columns, _, inside = _pixels(centres, grid, np.eye(4))
    front = np.full(len(chosen), -1)
    front[inside] = nearest[rows, columns]
    a, b, c = triangles[front].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        met = np.sum(normals * a, axis=1) / np.sum(normals * centres, axis=1)
    return (front >= 0) & (met < 1 - _NEARER)


def _nearest_triangle(triangles: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Return the number (H, W) int32 of the nearest triangle (F, 3, 3), in the camera, on each pixel, -1 = none."""
    painted = np.full((camera.height, camera.width), -1, dtype=np.int32)
    pixels = camera.project(triangles)
    with np.errstate(invalid="ignore"):
        touching = (pixels.max(axis=1) > -1).all(axis=1)
        touching &= (pixels.min(axis=1) < [camera.width, camera.height]).all(axis=1)
    drawn = np.flatnonzero(touching)
    drawn = drawn[np.argsort(-triangles[drawn, :, 2].mean(axis=1), kind="stable")]
    outlines = np.round(pixels[drawn] * (1 << _SUBPIXEL_BITS)).astype(np.int32)
    for outline, number in zip(outlines, drawn.tolist(), strict=True):
        cv2.fillConvexPoly(painted, outline, number, cv2.LINE_8, _SUBPIXEL_BITS)
    return painted


@dataclass(frozen=True)
class TrueSurface:
    """A true surface in the true world, mm: a mesh, or points (N, 3).

    seen : (F,) bool, the faces of the mesh that the camera saw; None: not known.
    frames : where the tissue moves, the mesh file of every frame, with the faces of `surface`; empty: it is at rest.
    T_view : (4, 4), world from camera, mm, of the one view that the truth was taken from; None: the whole scene.
    reach_px : a pixel of that view has a truth if a true point falls within this distance.
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
        """Return the mesh with the faces that some view, by its frame's number, sees; `InputError` where none fits."""
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
    """Return the true surface of a phantom, a C3VD video or a SCARED keyframe in the world of its poses, or None."""
    for name, read in _READERS.items():
        file = Path(folder) / name
        if file.is_file():
            with reporting(f"cannot read the true surface {file}"):
                return read(file)
    return None


def measure_surface(
    predicted: Surface, truth: TrueSurface, *, camera: CameraModel | None = None, icp: bool = True
) -> dict[str, float]:
    """Return every figure of a predicted surface, which the alignment of the trajectories has moved to the true world.

    Those of `compare_surfaces`, normal_consistency; with `icp` accuracy_icp_*, icp_rms_before_mm, icp_rms_after_mm.
    Against a truth of one view, only what the view, whose `camera` is then needed, sees on pixels with a truth is
    measured.
    """
    if truth.T_view is not None:
        if camera is None:
            raise ValueError("measure_surface: a truth of one view needs the camera of that view")
        valid = pixels_near(surface_points(truth.surface), camera, truth.T_view, radius_px=truth.reach_px)
        predicted = visible_from(predicted, camera, truth.T_view, valid)
    truth = replace(truth, surface=thinned(truth.surface))
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


def _read_phantom(path: Path) -> TrueSurface:
    return TrueSurface(_read_mesh(path), frames=tuple(sorted((path.parent / path.stem).glob("*.ply"))))


def _read_mesh(path: Path) -> trimesh.Trimesh:
    with reporting(f"cannot read the true surface {path}"):
        mesh = trimesh.load_mesh(path, process=False)
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"the true surface {path} holds no triangles")
    return mesh


def _read_coverage(path: Path) -> TrueSurface:
    """Read C3VD's mesh: `v x y z`, two `vt`, `f v/vt[/vn] ...`, all corners of a face with vt 1 = observed, 2 = missed.

    Source: `RenderingModule.cpp`, `writeOBJ` (github.com/DurrLab/C3VD). Readers of OBJ give no indices of `vt`.
    """
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    vertices = _vertices(lines)
    faces = [line.split()[1:] for line in lines if line.startswith("f ")]
    try:
        corners, marks = np.array([[c.split("/")[:2] for c in face] for face in faces], np.int64).transpose(2, 0, 1)
    except ValueError:
        corners = np.empty((0, 0))
    if corners.shape[1] != 3:
        raise ValueError("expected triangles `f v/vt v/vt v/vt`, as C3VD writes")
    if corners.min() < 1 or corners.max() > len(vertices):
        raise ValueError(f"a face names none of the {len(vertices)} vertices")
    if not np.isin(marks, (_OBSERVED, _MISSED)).all() or (marks != marks[:, :1]).any():
        raise ValueError("expected vt 1 (observed) or 2 (missed) on every face")
    return TrueSurface(trimesh.Trimesh(vertices, corners - 1, process=False), marks[:, 0] == _OBSERVED)


def _read_depth_points(path: Path) -> TrueSurface:
    """Read SCARED's points, mm, one per pixel; OpenCV reverses x, y, z."""
    points = read_decoded(path)
    if points is None or points.ndim != 3 or points.shape[2] != 3:
        raise ValueError("expected an image of three channels, x, y and z")
    return _of_one_view(points[..., ::-1].reshape(-1, 3))


def _read_cloud(path: Path) -> TrueSurface:
    return _of_one_view(_vertices(path.read_text(encoding="utf-8", errors="replace").splitlines()))


def _of_one_view(points_mm: np.ndarray) -> TrueSurface:
    """Return the truth of SCARED's points (N, 3), NaN or z = 0 where there is none."""
    known = np.isfinite(points_mm).all(axis=1) & (points_mm[:, 2] > 0)
    if not known.any():
        raise ValueError("the points are all missing")
    return TrueSurface(points_mm[known].astype(np.float64), T_view=np.eye(4))


def _vertices(lines: list[str]) -> np.ndarray:
    """Return x, y, z of the lines `v x y z`, (N, 3) float64; `nan` is a number."""
    table = np.loadtxt([line[2:] for line in lines if line.startswith("v ")], ndmin=2)
    if table.shape[1] < 3:
        raise ValueError("expected lines `v x y z`")
    return table[:, :3]


_READERS = {
    "mesh_truth.ply": _read_phantom,
    "coverage_mesh.obj": _read_coverage,
    "outputMesh.obj": _read_coverage,  # its name on the data set's page
    "left_depth_map.tiff": _read_depth_points,
    "point_cloud.obj": _read_cloud,
}
