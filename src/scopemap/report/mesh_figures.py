"""Figures of meshes and camera paths, without a display and without OpenGL.

Estimates are green, true values red, as in the paper's experiment 4 (arXiv 2508.11282).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape
from scopemap.geometry.rendering import Rendering, render_mesh, render_points
from scopemap.geometry.se3 import inverse, se3, so3_exp, transform
from scopemap.report.canvas import ESTIMATE_COLOUR, TRUTH_COLOUR
from scopemap.report.sheet import SOFT, Plot, Sheet, picture_grid

_SIDE_PX = 480
_AMBIENT = 0.35
_UNPAINTED = 190
_PLOT_PX = 400
_MARGIN_PX = 15


@dataclass(frozen=True)
class MeshView:
    """Viewpoint of a picture of a mesh: pose (4, 4) in the world, mm, and a pinhole camera."""

    T_world_camera: np.ndarray
    camera: PinholeCamera

    def project(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points (..., 3), world mm, in the camera, mm, and their pixels (..., 2)."""
        points = transform(inverse(self.T_world_camera), points_mm)
        return points, self.camera.project(points)


def draw_trajectories(estimate_positions_mm: np.ndarray, reference_positions_mm: np.ndarray | None, file: Path) -> None:
    """Draw camera positions (N, 3) and, if given, the true ones (M, 3), mm, in three orthogonal views as a PNG.

    A dot marks the start; rows of NaN (lost frames) are gaps.
    """
    sheet = Sheet(3 * _PLOT_PX + 20, _PLOT_PX + 20)
    paths = _paths(estimate_positions_mm, reference_positions_mm)
    for number, (across, up) in enumerate([(0, 1), (0, 2), (2, 1)]):
        shown = {name: (colour, positions[:, [across, up]]) for name, (colour, positions) in paths.items()}
        known = np.concatenate([values[np.isfinite(values).all(1)] for _, values in shown.values()])
        low, high = (known.min(0), known.max(0)) if len(known) else (np.zeros(2), np.ones(2))
        centre, half = (low + high) / 2, 0.55 * max(float((high - low).max()), 1e-3)
        x, y = ((float(value) - half, float(value) + half) for value in centre)
        # The world's y points down.
        inside = (number * _PLOT_PX + 60.0, 15.0, _PLOT_PX - 60.0, _PLOT_PX - 60.0)
        plot = Plot(sheet, inside, x, y[::-1] if up == 1 else y)
        plot.frame(f"{'xyz'[across]} mm", f"{'xyz'[up]} mm")
        for colour, values in shown.values():
            places = plot.place(values)
            sheet.line(places, colour, 2)
            start = places[np.isfinite(places).all(1)][:1]
            sheet.dots(start, "#000000", 5)
            sheet.dots(start, colour, 4)
    _write_legend(sheet, list(paths), 80, _PLOT_PX - 92)
    sheet.save(file)


def _write_legend(sheet: Sheet, names: list[str], left: float, top: float) -> None:
    for row, name in enumerate(reversed(names)):
        sheet.text((left, top + 16 * row), name, 14, ESTIMATE_COLOUR if name == "estimate" else TRUTH_COLOUR)
    sheet.text((left, top + 16 * len(names)), "dot: start", 12, SOFT)


def draw_mesh(
    mesh: trimesh.Trimesh,
    file: Path,
    T_world_view: np.ndarray | None = None,
    reference_mesh: trimesh.Trimesh | None = None,
) -> None:
    """Draw a mesh, world mm, as a PNG: from `T_world_view` (4, 4), and from two sides outside.

    A reference mesh (the truth) is drawn below from the same views. Without `T_world_view` there are only the outside
    views; an empty mesh gives empty views.
    """
    framed = reference_mesh if reference_mesh is not None and not len(mesh.faces) else mesh
    views = {} if T_world_view is None else {"from the camera": inside_view(T_world_view)}
    views |= outside_views(framed, T_world_view)
    meshes = {"": mesh} | ({} if reference_mesh is None else {"truth, ": reference_mesh})
    rows = [
        {prefix + title: mesh_picture(drawn, view) for title, view in views.items()} for prefix, drawn in meshes.items()
    ]
    picture_grid(rows, (400, 400)).save(file)


def draw_reconstruction(
    mesh: trimesh.Trimesh,
    estimate_positions_mm: np.ndarray,
    reference_positions_mm: np.ndarray | None,
    file: Path,
    T_world_view: np.ndarray | None = None,
) -> None:
    """Draw a mesh with the estimated (N, 3) and the true (M, 3) camera positions over it, all world mm, as a PNG.

    Views: from behind `T_world_view` (4, 4), the first camera, and from two sides outside; without it only from
    outside. A dot marks the start; rows of NaN (lost frames) are gaps.
    """
    paths = _paths(estimate_positions_mm, reference_positions_mm)
    # The truth is drawn first and broader: where both agree it is the edge of the estimate.
    widths_px = {"truth": 5, "estimate": 2}
    everywhere = np.concatenate([positions for _, positions in paths.values()])
    views = {} if T_world_view is None else {"from behind the start": view_from_behind(T_world_view, everywhere)}
    views |= outside_views(mesh, T_world_view, everywhere)
    pictures = {title: mesh_picture(mesh, view) for title, view in views.items()}
    for title, view in views.items():
        for name, (colour, positions) in paths.items():
            draw_path(pictures[title], view, positions, colour, thickness_px=widths_px[name])
    sheet = picture_grid([{title: cropped(picture) for title, picture in pictures.items()}], (460, 460))
    _write_legend(sheet, list(paths), 14, 30)
    if reference_positions_mm is None:
        sheet.text((14, 62), "no true poses are known", 12, SOFT)
    sheet.save(file)


def draw_registered_clouds(clouds: Mapping[str, tuple[np.ndarray, np.ndarray]], file: Path, *, where: str) -> None:
    """Draw the point clouds of two frames on each other as a PNG, one panel per method, from in front and aside.

    Each method gives points (N, 3), mm, in a camera of the clouds, and their colours (N, 3) uint8; `where` names the
    poses that registered them.
    """
    rows: list[dict[str, np.ndarray]] = [{}, {}]
    for method, (points, colours) in clouds.items():
        centre = np.median(points, axis=0)
        radius = float(np.percentile(np.linalg.norm(points - centre, axis=1), 95))
        for row, yaw_rad in zip(rows, (0.0, 0.8), strict=True):
            view = _view_of(np.eye(3), centre, radius, yaw_rad, 0.0)
            row[f"{method}\n{where}"] = cropped(
                _on_white(render_points(points, colours, view.camera, view.T_world_camera))
            )
    picture_grid(rows, (360, 360)).save(file)


def _paths(estimate_mm: np.ndarray, reference_mm: np.ndarray | None) -> dict[str, tuple[str, np.ndarray]]:
    """Return colour and positions by name, in the order in which they are drawn."""
    check_shape("estimate_positions_mm", estimate_mm, (None, 3))
    if reference_mm is None:
        return {"estimate": (ESTIMATE_COLOUR, estimate_mm)}
    check_shape("reference_positions_mm", reference_mm, (None, 3))
    return {"truth": (TRUTH_COLOUR, reference_mm), "estimate": (ESTIMATE_COLOUR, estimate_mm)}


def inside_view(T_world_camera: np.ndarray, field_of_view_rad: float = 1.6) -> MeshView:
    """Return the square view of a camera at `T_world_camera` (4, 4)."""
    focal_px = 0.5 * _SIDE_PX / np.tan(0.5 * field_of_view_rad)
    centre_px = 0.5 * (_SIDE_PX - 1)
    return MeshView(T_world_camera, PinholeCamera(focal_px, focal_px, centre_px, centre_px, _SIDE_PX, _SIDE_PX))


def view_from_behind(T_world_camera: np.ndarray, positions_mm: np.ndarray) -> MeshView:
    """Return the view along a camera (4, 4) from so far behind that the positions (N, 3), mm, are in view."""
    known = positions_mm[np.isfinite(positions_mm).all(axis=1)]
    R, centre = T_world_camera[:3, :3], T_world_camera[:3, 3]
    view = inside_view(T_world_camera)
    local = np.concatenate([(known - centre) @ R, np.zeros((1, 3))])
    # A point is in view where |x| and |y| are below its distance times the tangent of half the angle; 0.8: a margin.
    tangent = 0.8 * 0.5 * (view.camera.width - 1) / view.camera.fx
    needed_mm = np.abs(local[:, :2]).max(axis=1) / tangent - local[:, 2]
    behind_mm = float(needed_mm.max()) + 0.25 * float(np.ptp(local, axis=0).max()) + 1.0
    return MeshView(se3(R, centre - behind_mm * R[:, 2]), view.camera)


def outside_views(
    mesh: trimesh.Trimesh, T_world_camera: np.ndarray | None = None, positions_mm: np.ndarray | None = None
) -> Mapping[str, MeshView]:
    """Return two views of the whole mesh from opposite sides, upright for the camera at `T_world_camera` (4, 4).

    Positions (N, 3), mm, are in view, too; those of NaN do not count.
    """
    R = np.eye(3) if T_world_camera is None else T_world_camera[:3, :3]
    points = [np.empty((0, 3)) if positions_mm is None else positions_mm[np.isfinite(positions_mm).all(axis=1)]]
    points += [np.asarray(mesh.bounds)] if len(mesh.vertices) else []
    shown = np.concatenate(points)
    low, high = (shown.min(axis=0), shown.max(axis=0)) if len(shown) else (np.zeros(3), np.ones(3))
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    sides = {"from outside": -1.0, "from the other side": 2.1}
    return {name: _view_of(R, centre, radius, yaw_rad, -0.45) for name, yaw_rad in sides.items()}


def _view_of(R: np.ndarray, centre_mm: np.ndarray, radius_mm: float, yaw_rad: float, pitch_rad: float) -> MeshView:
    """Return a view of a whole ball, turned from the orientation R (3, 3)."""
    R_view = R @ so3_exp(np.array([0.0, yaw_rad, 0.0])) @ so3_exp(np.array([pitch_rad, 0.0, 0.0]))
    # From 4 radii away the ball fills a field of view of 2 asin(1/4).
    return inside_view(se3(R_view, centre_mm - 4.0 * radius_mm * R_view[:, 2]), 2.1 * float(np.arcsin(0.25)))


def mesh_picture(mesh: trimesh.Trimesh, view: MeshView, *, smooth: bool = True) -> np.ndarray:
    """Return the (H, W, 3) uint8 picture of a mesh, lit by a lamp at the camera, on white.

    Both sides of a triangle are drawn; triangles partly behind the camera are left out. A mesh without vertex colours
    is grey. smooth : draw it twice as large and take means, which a picture that will be shrunk does not need.
    """
    visual, camera, colours = mesh.visual, view.camera, np.full((len(mesh.vertices), 3), _UNPAINTED)
    if isinstance(visual, trimesh.visual.ColorVisuals) and visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors)[:, :3]
    rays = np.asarray(mesh.vertices) - view.T_world_camera[:3, 3]
    lengths = np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    cosine = np.abs((np.asarray(mesh.vertex_normals) * rays).sum(1)) / lengths
    shaded = np.round((_AMBIENT + (1 - _AMBIENT) * cosine)[:, None] * colours).astype(np.uint8)
    lit = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=shaded, process=False)
    if not smooth:
        return _on_white(render_mesh(lit, camera, view.T_world_camera))
    # Half a pixel's sampling: the mesh's triangles are often smaller than a pixel.
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    picture = _on_white(render_mesh(lit, fine, view.T_world_camera))
    return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def _on_white(rendering: Rendering) -> np.ndarray:
    return np.where(np.isnan(rendering.depth_mm)[..., None], np.uint8(255), rendering.rgb)


def draw_path(
    picture: np.ndarray, view: MeshView, positions_mm: np.ndarray, colour: str, *, thickness_px: int = 2
) -> None:
    """Draw a path of positions (N, 3), world mm, over a picture (H, W, 3) uint8 of a view, in place, its start a dot.

    `colour` is "#rrggbb". The mesh does not hide the path. Rows of NaN, and positions behind the view, are gaps.
    """
    points, pixels = view.project(positions_mm)
    places = np.where(points[:, 2:] > 0, pixels, np.nan)
    sheet, start = Sheet.over(picture), places[np.isfinite(places).all(axis=1)][:1]
    sheet.line(places, colour, thickness_px)
    sheet.dots(start, "#000000", 3 + thickness_px)
    sheet.dots(start, colour, 2 + thickness_px)


def cropped(picture: np.ndarray) -> np.ndarray:
    """Return the square part of a square picture (H, H, 3) that holds all that is not white, and a margin."""
    rows, columns = np.nonzero((picture != 255).any(axis=-1))
    if not len(rows):
        return picture
    low, high = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()])
    side = min(int((high - low).max()) + 2 * _MARGIN_PX, len(picture))
    top, left = np.clip((low + high - side) // 2, 0, len(picture) - side)
    return picture[top : top + side, left : left + side]
