"""A picture of a mesh without OpenGL: project the triangles and paint them from far to near."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh

from scopemap.camera import PinholeCamera
from scopemap.geometry.se3 import inverse, se3, so3_exp, transform

_SIDE_PX = 480
_BACKGROUND = 255
_SUBPIXEL_BITS = 4
_AMBIENT = 0.35


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


def outside_views(mesh: trimesh.Trimesh, T_world_camera: np.ndarray | None = None) -> list[MeshView]:
    """Return two views of the whole mesh from opposite sides, upright for the camera at `T_world_camera` (4, 4)."""
    R = np.eye(3) if T_world_camera is None else T_world_camera[:3, :3]
    low, high = mesh.bounds if len(mesh.vertices) else (np.zeros(3), np.ones(3))
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
