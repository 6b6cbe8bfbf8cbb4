"""A picture of a mesh without OpenGL: project the triangles and paint them from far to near."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import trimesh

from scopemap.cameras.camera import PinholeCamera
from scopemap.geometry.se3 import inverse, se3, so3_exp, transform

_SIDE_PX = 480
_BACKGROUND = 255
_SUBPIXEL_BITS = 4
_AMBIENT = 0.35
# Where a path is cut off before the view.
_NEAREST_MM = 0.1


@dataclass(frozen=True)
class MeshView:
    """From where a mesh is looked at: pose (4, 4) in the world, mm, and a pinhole camera."""

    T_world_camera: np.ndarray
    camera: PinholeCamera


def inside_view(T_world_camera: np.ndarray, field_of_view_rad: float = 1.6) -> MeshView:
    """Return the view of an endoscope at `T_world_camera` (4, 4), square."""
    focal_px = 0.5 * _SIDE_PX / np.tan(0.5 * field_of_view_rad)
    centre_px = 0.5 * (_SIDE_PX - 1)
    return MeshView(T_world_camera, PinholeCamera(focal_px, focal_px, centre_px, centre_px, _SIDE_PX, _SIDE_PX))


def outside_views(
    mesh: trimesh.Trimesh, T_world_camera: np.ndarray | None = None, positions_mm: np.ndarray | None = None
) -> list[MeshView]:
    """Return two views of the whole mesh from opposite sides, upright for the camera at `T_world_camera` (4, 4).

    Positions (N, 3), mm, are held in view, too; those of NaN do not count.
    """
    R = np.eye(3) if T_world_camera is None else T_world_camera[:3, :3]
    low, high = _bounds(mesh, positions_mm)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    # 4 radii away the sphere around the mesh fills a field of view of 2 asin(1/4).
    angle_rad = 2.1 * float(np.arcsin(0.25))
    views = []
    for turn_rad in (-1.0, 2.1):
        R_view = R @ so3_exp(np.array([0.0, turn_rad, 0.0])) @ so3_exp(np.array([-0.45, 0.0, 0.0]))
        views.append(inside_view(se3(R_view, centre - 4.0 * radius * R_view[:, 2]), angle_rad))
    return views


def render_mesh(mesh: trimesh.Trimesh, view: MeshView) -> np.ndarray:
    """Return the (H, W, 3) uint8 picture of a mesh, lit by a lamp at the camera, on white.

    Both sides of a triangle are drawn; triangles that reach behind the camera are left out.
    """
    camera = view.camera
    picture = np.full((camera.height, camera.width, 3), _BACKGROUND, np.uint8)
    corners = transform(inverse(view.T_world_camera), np.asarray(mesh.vertices))[mesh.faces]
    pixels = camera.project(corners)
    inside = (pixels.max(1) > -1).all(1) & (pixels.min(1) < [camera.width, camera.height]).all(1)
    drawn = np.flatnonzero(inside & (corners[..., 2] > 0).all(1))
    drawn = drawn[np.argsort(-corners[drawn, :, 2].mean(1), kind="stable")]
    colours = np.round(_shades(corners[drawn]) * _face_colours(mesh)[drawn])
    outlines = np.round(pixels[drawn] * (1 << _SUBPIXEL_BITS)).astype(np.int32)
    for outline, colour in zip(outlines, colours.tolist(), strict=True):
        cv2.fillConvexPoly(picture, outline, colour, cv2.LINE_8, _SUBPIXEL_BITS)
    return picture


def draw_path(
    picture: np.ndarray, view: MeshView, positions_mm: np.ndarray, colour: str, *, thickness_px: int = 2
) -> None:
    """Draw a path of positions (N, 3), world mm, over a picture (H, W, 3) uint8 of a view, in place, its start a dot.

    `colour` is "#rrggbb". The mesh hides nothing of the path. Rows of NaN are gaps; what lies behind is cut off.
    """
    rgb = tuple(int(colour[place : place + 2], 16) for place in (1, 3, 5))
    points = transform(inverse(view.T_world_camera), positions_mm)
    for start, end in pairwise(points):
        if np.isfinite([start, end]).all() and max(start[2], end[2]) > _NEAREST_MM:
            ends = _fixed_point(view.camera.project(np.stack([_in_front(start, end), _in_front(end, start)])))
            cv2.line(picture, ends[0], ends[1], rgb, thickness_px, cv2.LINE_AA, _SUBPIXEL_BITS)
    known = points[np.isfinite(points).all(axis=1)]
    if len(known) and known[0, 2] > _NEAREST_MM:
        dot = _fixed_point(view.camera.project(known[:1]))[0]
        for radius_px, filling in ((3 + thickness_px, (0, 0, 0)), (2 + thickness_px, rgb)):
            cv2.circle(picture, dot, radius_px << _SUBPIXEL_BITS, filling, cv2.FILLED, cv2.LINE_AA, _SUBPIXEL_BITS)


def _in_front(point: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return `point`, or where the line to `other`, which lies before the view, crosses the nearest plane."""
    if point[2] > _NEAREST_MM:
        return point
    return point + (other - point) * (_NEAREST_MM - point[2]) / (other[2] - point[2])


def _fixed_point(pixels: np.ndarray) -> list[list[int]]:
    """Return pixels (N, 2) in OpenCV's fixed point, far ones kept from overflowing it."""
    return np.round(np.clip(pixels, -1e6, 1e6) * (1 << _SUBPIXEL_BITS)).astype(int).tolist()


def _bounds(mesh: trimesh.Trimesh, positions_mm: np.ndarray | None) -> np.ndarray:
    """Return the corners (2, 3) of the box around mesh and positions; a unit box around nothing."""
    points = [] if positions_mm is None else [positions_mm[np.isfinite(positions_mm).all(axis=1)]]
    points += [np.asarray(mesh.bounds)] if len(mesh.vertices) else []
    held = np.concatenate([*points, np.empty((0, 3))])
    return np.stack([held.min(axis=0), held.max(axis=0)]) if len(held) else np.stack([np.zeros(3), np.ones(3)])


def _shades(corners: np.ndarray) -> np.ndarray:
    """(F, 1) brightness 0..1 of triangles (F, 3, 3) in the camera: ambient plus the cosine to the lamp."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rays = corners.mean(1)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    cosine = np.abs((normals * rays).sum(1)) / np.maximum(lengths, 1e-12)
    return (_AMBIENT + (1 - _AMBIENT) * cosine)[:, None]


def _face_colours(mesh: trimesh.Trimesh) -> np.ndarray:
    """(F, 3) mean vertex colours; grey where the mesh has none."""
    visual = mesh.visual
    if not isinstance(visual, trimesh.visual.ColorVisuals) or visual.kind != "vertex":
        return np.full((len(mesh.faces), 3), 190.0)
    return np.asarray(visual.vertex_colors, dtype=np.float64)[mesh.faces, :3].mean(1)
