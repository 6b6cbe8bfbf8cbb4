"""Figures of meshes and camera paths, without a display and without OpenGL.

Estimates are green, true values red, as in the paper's experiment 4 (arXiv 2508.11282); of two runs the first is green.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.rendering import Rendering, render_mesh
from scopemap.engine.geometry.se3 import inverse, se3, so3_exp, transform
from scopemap.report.sheet import SOFT, Plot, Sheet

ESTIMATE_COLOUR = "#1a9850"
TRUTH_COLOUR = "#d73027"
_SIDE_PX = 480
_AMBIENT = 0.35
_UNPAINTED = 190
_WHITE = 255
_PLOT_PX = 400
_MARGIN_PX = 15


@dataclass(frozen=True)
class Viewpoint:
    """Viewpoint of a picture of a mesh: pose (4, 4) in the world, mm, and a pinhole camera."""

    T_world_camera: np.ndarray
    camera: PinholeCamera

    def project(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points (..., 3), world mm, in the camera, mm, and their pixels (..., 2)."""
        points = transform(inverse(self.T_world_camera), points_mm)
        return points, self.camera.project(points)


def draw_trajectories(
    positions: np.ndarray,
    reference: np.ndarray,
    file: Path,
    *,
    names: tuple[str, str] = ("estimate", "truth"),
    unit: str = "mm",
) -> None:
    """Draw camera positions (N, 3) over those that they are compared with (M, 3), in three orthogonal views as a PNG.

    names : what the two are. unit : of the axes. A dot marks the start; rows of NaN (lost frames) are gaps.
    """
    sheet = Sheet(3 * _PLOT_PX + 20, _PLOT_PX + 20)
    paths = {TRUTH_COLOUR: reference, ESTIMATE_COLOUR: positions}
    for number, axes in enumerate([(0, 1), (0, 2), (2, 1)]):
        shown = {colour: positions[:, axes] for colour, positions in paths.items()}
        known = np.concatenate([values[np.isfinite(values).all(1)] for values in shown.values()])
        low, high = (known.min(0), known.max(0)) if len(known) else (np.zeros(2), np.ones(2))
        centre, half = (low + high) / 2, 0.55 * max(float((high - low).max()), 1e-3)
        x, y = ((float(value) - half, float(value) + half) for value in centre)
        # The world's y points down.
        inside = (number * _PLOT_PX + 60.0, 15.0, _PLOT_PX - 60.0, _PLOT_PX - 60.0)
        plot = Plot(sheet, inside, x, y[::-1] if axes[1] == 1 else y)
        plot.frame(f"{'xyz'[axes[0]]} {unit}", f"{'xyz'[axes[1]]} {unit}")
        for colour, values in shown.items():
            _draw_line(sheet, plot.place(values), colour, 2)
    sheet.text((80, _PLOT_PX - 92), names[0], 14, ESTIMATE_COLOUR)
    sheet.text((80, _PLOT_PX - 76), names[1], 14, TRUTH_COLOUR)
    sheet.text((80, _PLOT_PX - 60), "dot: start", 12, SOFT)
    sheet.save(file)


def _draw_line(sheet: Sheet, places: np.ndarray, colour: str, thickness_px: int) -> None:
    """Draw a path through places (N, 2), px, its start a dot."""
    start = places[np.isfinite(places).all(axis=1)][:1]
    sheet.line(places, colour, thickness_px)
    sheet.dots(start, "#000000", 3 + thickness_px)
    sheet.dots(start, colour, 2 + thickness_px)


def inside_view(T_world_camera: np.ndarray, field_of_view_rad: float = 1.6) -> Viewpoint:
    """Return the square view of a camera at `T_world_camera` (4, 4)."""
    focal_px = 0.5 * _SIDE_PX / np.tan(0.5 * field_of_view_rad)
    centre_px = 0.5 * (_SIDE_PX - 1)
    return Viewpoint(T_world_camera, PinholeCamera(focal_px, focal_px, centre_px, centre_px, _SIDE_PX, _SIDE_PX))


def view_from_behind(T_world_camera: np.ndarray, positions_mm: np.ndarray) -> Viewpoint:
    """Return the view along a camera (4, 4) from so far behind that the positions (N, 3), mm, are in view."""
    known = positions_mm[np.isfinite(positions_mm).all(axis=1)]
    R, centre = T_world_camera[:3, :3], T_world_camera[:3, 3]
    view = inside_view(T_world_camera)
    local = np.concatenate([(known - centre) @ R, np.zeros((1, 3))])
    # A point is in view where |x| and |y| are below its distance times the tangent of half the angle; 0.8: a margin.
    tangent = 0.8 * 0.5 * (view.camera.width - 1) / view.camera.fx
    needed_mm = np.abs(local[:, :2]).max(axis=1) / tangent - local[:, 2]
    behind_mm = float(needed_mm.max()) + 0.25 * float(np.ptp(local, axis=0).max()) + 1.0
    return Viewpoint(se3(R, centre - behind_mm * R[:, 2]), view.camera)


def outside_views(
    mesh: trimesh.Trimesh, T_world_camera: np.ndarray, positions_mm: np.ndarray | None = None
) -> Mapping[str, Viewpoint]:
    """Return two views of the whole mesh from opposite sides, upright for the camera at `T_world_camera` (4, 4).

    Positions (N, 3), mm, are in view, too; those of NaN do not count.
    """
    points = [np.empty((0, 3)) if positions_mm is None else positions_mm[np.isfinite(positions_mm).all(axis=1)]]
    points += [np.asarray(mesh.bounds)] if len(mesh.vertices) else []
    shown = np.concatenate(points)
    low, high = (shown.min(axis=0), shown.max(axis=0)) if len(shown) else (np.zeros(3), np.ones(3))
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    sides = {"from outside": -1.0, "from the other side": 2.1}
    return {name: view_of(T_world_camera[:3, :3], centre, radius, yaw_rad, -0.45) for name, yaw_rad in sides.items()}


def view_of(R: np.ndarray, centre_mm: np.ndarray, radius_mm: float, yaw_rad: float, pitch_rad: float) -> Viewpoint:
    """Return a view of a whole ball, rotated from the orientation R (3, 3)."""
    R_view = R @ so3_exp(np.array([0.0, yaw_rad, 0.0])) @ so3_exp(np.array([pitch_rad, 0.0, 0.0]))
    # From 4 radii away the ball fills a field of view of 2 asin(1/4).
    return inside_view(se3(R_view, centre_mm - 4.0 * radius_mm * R_view[:, 2]), 2.1 * float(np.arcsin(0.25)))


def zoomed(view: Viewpoint, factor: float) -> Viewpoint:
    """Return a view with its focal length times a factor."""
    camera = view.camera
    return replace(view, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy))


def mesh_picture(mesh: trimesh.Trimesh, view: Viewpoint, *, smooth: bool = True) -> np.ndarray:
    """Return the (H, W, 3) uint8 picture of a mesh, lit by a lamp at the camera, on white.

    Both sides of a triangle are drawn; triangles partly behind the camera are left out. A mesh without vertex colours
    and without a texture is grey. smooth : draw it twice as large and take means, which a picture that will be shrunk
    does not need.
    """
    visual: Any = mesh.visual
    camera, colours = view.camera, np.full((len(mesh.vertices), 3), _UNPAINTED)
    is_textured = isinstance(visual, trimesh.visual.TextureVisuals)
    if is_textured:
        colours[:] = _WHITE
    elif visual.kind == "vertex":
        colours = np.asarray(visual.vertex_colors)[:, :3]
    rays = np.asarray(mesh.vertices) - view.T_world_camera[:3, 3]
    lengths = np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    cosine = np.abs((np.asarray(mesh.vertex_normals) * rays).sum(1)) / lengths
    shaded = np.round((_AMBIENT + (1 - _AMBIENT) * cosine)[:, None] * colours).astype(np.uint8)
    lit = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=shaded, process=False)
    # Half a pixel's sampling: the mesh's triangles are often smaller than a pixel.
    drawn = camera.resized(2 * camera.width, 2 * camera.height) if smooth else camera
    rendering = render_mesh(lit, drawn, view.T_world_camera)
    if is_textured:
        tissue = render_mesh(mesh, drawn, view.T_world_camera).rgb
        rendering = rendering._replace(rgb=(rendering.rgb.astype(np.uint16) * tissue // _WHITE).astype(np.uint8))
    picture = on_white(rendering)
    return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA) if smooth else picture


def on_white(rendering: Rendering) -> np.ndarray:
    """Return the colours of a rendering, (H, W, 3) uint8, white where there is no surface."""
    return np.where(np.isnan(rendering.depth_mm)[..., None], np.uint8(_WHITE), rendering.rgb)


def draw_path(
    picture: np.ndarray, view: Viewpoint, positions_mm: np.ndarray, colour: str, *, thickness_px: int = 2
) -> None:
    """Draw a path of positions (N, 3), world mm, over a picture (H, W, 3) uint8 of a view, in place, its start a dot.

    `colour` is "#rrggbb". The mesh does not hide the path. Rows of NaN, and positions behind the view, are gaps.
    """
    points, pixels = view.project(positions_mm)
    places = np.where(points[:, 2:] > 0, pixels, np.nan)
    _draw_line(Sheet.over(picture), places, colour, thickness_px)


def cropped(picture: np.ndarray) -> np.ndarray:
    """Return the square part of a square picture (H, H, 3) that holds all that is not white, and a margin."""
    left, top, side = content(picture)
    return picture[top : top + side, left : left + side]


def content(picture: np.ndarray) -> tuple[int, int, int]:
    """Return left, top and side, px, of the square that `cropped` leaves of a picture."""
    rows, columns = np.nonzero((picture != 255).any(axis=-1))
    if not len(rows):
        return 0, 0, len(picture)
    low, high = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()])
    side = min(int((high - low).max()) + 2 * _MARGIN_PX, len(picture))
    top, left = np.clip((low + high - side) // 2, 0, len(picture) - side)
    return int(left), int(top), side
