"""Renders a mesh into a camera: depth and vertex colours by rasterisation with a z-buffer, without a display."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from numba import njit

from scopemap.cameras.camera import PinholeCamera
from scopemap.geometry.se3 import inverse

_NEAR_MM = 1e-3
# Pixels on the edge of two triangles belong to both; rounding must not open a gap between them.
_EDGE = -1e-9


class Rendering(NamedTuple):
    """What a camera sees of a mesh: depth_mm (H, W) float32, NaN where nothing is; rgb (H, W, 3) uint8, 0 there."""

    depth_mm: np.ndarray
    rgb: np.ndarray


def render_mesh(mesh: trimesh.Trimesh, camera: PinholeCamera, T_world_camera: np.ndarray) -> Rendering:
    """Return the view of a mesh with vertex colours, world mm, from a pose; both sides of a face are seen.

    Faces that reach behind the camera are left out. Inverse depth is interpolated linearly in the image and colours
    perspectively, which is exact for plane faces. Raises `ValueError` for a mesh with a texture.
    """
    T = inverse(T_world_camera)
    points = np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3]
    ahead = points[:, 2] > _NEAR_MM
    z = np.where(ahead, points[:, 2], 1.0)
    pixels = points[:, :2] / z[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    corners = np.column_stack([pixels, np.where(ahead, 1 / z, -1.0)])
    visual = mesh.visual
    if not isinstance(visual, trimesh.visual.ColorVisuals):
        raise ValueError("rendering a mesh: it has a texture; give it vertex colours")
    colours = np.asarray(visual.vertex_colors)[:, :3].astype(np.float32)
    inverse_depth = np.zeros((camera.height, camera.width), np.float32)
    rgb = np.zeros((camera.height, camera.width, 3), np.float32)
    _rasterise(corners, colours, np.asarray(mesh.faces), inverse_depth, rgb)
    depth_mm = np.divide(1, inverse_depth, out=np.full_like(inverse_depth, np.nan), where=inverse_depth > 0)
    return Rendering(depth_mm, np.round(rgb).astype(np.uint8))


@njit(cache=True, nogil=True, error_model="numpy")
def _rasterise(corners, colours, faces, inverse_depth, rgb):  # type: ignore[no-untyped-def]
    """Draw faces (F, 3) of corners (V, 3): u, v, 1 / z, negative behind the camera. Changes both images."""
    height, width = inverse_depth.shape
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ua, va, wa = corners[a, 0], corners[a, 1], corners[a, 2]
        ub, vb, wb = corners[b, 0], corners[b, 1], corners[b, 2]
        uc, vc, wc = corners[c, 0], corners[c, 1], corners[c, 2]
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if wa < 0 or wb < 0 or wc < 0 or area == 0:
            continue
        first_row, last_row = max(0, np.ceil(min(va, vb, vc))), min(height - 1, np.floor(max(va, vb, vc)))
        first_col, last_col = max(0, np.ceil(min(ua, ub, uc))), min(width - 1, np.floor(max(ua, ub, uc)))
        for row in range(first_row, last_row + 1):
            for col in range(first_col, last_col + 1):
                at_a = ((ub - col) * (vc - row) - (vb - row) * (uc - col)) / area
                at_b = ((uc - col) * (va - row) - (vc - row) * (ua - col)) / area
                at_c = 1.0 - at_a - at_b
                if at_a < _EDGE or at_b < _EDGE or at_c < _EDGE:
                    continue
                w = at_a * wa + at_b * wb + at_c * wc
                if w > inverse_depth[row, col]:
                    inverse_depth[row, col] = w
                    for channel in range(3):
                        rgb[row, col, channel] = (
                            at_a * wa * colours[a, channel]
                            + at_b * wb * colours[b, channel]
                            + at_c * wc * colours[c, channel]
                        ) / w
