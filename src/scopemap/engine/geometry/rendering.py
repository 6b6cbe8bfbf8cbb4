"""Renders meshes and coloured points into a camera: depth and colours with a z-buffer, without a display."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.kernels import Float32_2d, Float32_3d, Float64_2d, Int64_2d, kernel
from scopemap.engine.geometry.se3 import inverse, transform

_NEAR_MM = 1e-3  # guard: division by z
# Pixels on the edge of two triangles belong to both; rounding must not open a gap between them.
_EDGE = -1e-9
# Of the points that fall on a pixel, those farther than the nearest by more than this share are hidden.
_SAME_SURFACE = 1.05  # by hand


class Rendering(NamedTuple):
    """What a camera sees of a mesh: depth_mm (H, W) float32, NaN where nothing is; rgb (H, W, 3) uint8, 0 there."""

    depth_mm: np.ndarray
    rgb: np.ndarray


def vertex_colours(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the vertex colours of a mesh, (V, 4) uint8. Raises `ValueError` for a mesh with a texture."""
    visual = mesh.visual
    if not isinstance(visual, trimesh.visual.ColorVisuals):
        raise ValueError("the mesh has a texture; give it vertex colours")
    return np.asarray(visual.vertex_colors)


def render_mesh(mesh: trimesh.Trimesh, camera: PinholeCamera, T_world_camera: np.ndarray) -> Rendering:
    """Return the view of a mesh with vertex colours or a texture, world mm, from a pose; both sides of a face are seen.

    Faces that reach behind the camera are left out. Inverse depth is interpolated linearly in the image and colours
    perspectively, which is exact for plane faces.
    """
    T = inverse(T_world_camera)
    points = np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3]
    corners = _projected(points, camera.fx, camera.fy, camera.cx, camera.cy)
    texture = mesh.visual if isinstance(mesh.visual, trimesh.visual.TextureVisuals) else None
    colours = vertex_colours(mesh) if texture is None else np.column_stack([texture.uv, np.zeros(len(points))])
    inverse_depth = np.zeros((camera.height, camera.width), np.float32)
    rgb = np.zeros((camera.height, camera.width, 3), np.float32)
    _rasterise(corners, colours.astype(np.float32), np.asarray(mesh.faces), inverse_depth, rgb)
    with np.errstate(divide="ignore"):
        depth_mm = np.where(inverse_depth > 0, 1 / inverse_depth, np.float32(np.nan))
    if texture is not None:
        return Rendering(depth_mm, _from_texture(rgb, inverse_depth > 0, texture))
    return Rendering(depth_mm, np.asarray(cv2.convertScaleAbs(rgb)))


def _from_texture(uv: np.ndarray, seen: np.ndarray, texture: trimesh.visual.TextureVisuals) -> np.ndarray:
    """Return the colours (H, W, 3) uint8 at places uv (H, W, 2 or more), 0..1 from the lower left, 0 where not seen."""
    picture = np.asarray(texture.material.image)[..., :3]
    height, width = picture.shape[:2]
    x, y = width * uv[..., 0] - 0.5, height * (1 - uv[..., 1]) - 0.5
    found = cv2.remap(picture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    return np.where(seen[..., None], found, np.uint8(0))


def render_points(
    points_mm: np.ndarray, colours: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray
) -> Rendering:
    """Return the view of points (N, 3), world mm, in their colours (N, 3) uint8, as squares a pixel wide."""
    points = transform(inverse(T_world_camera), points_mm)
    ahead = points[:, 2] > _NEAR_MM
    points, colours = points[ahead], colours[ahead]
    pixels = camera.project(points)
    first = np.floor(pixels)
    column = (first[:, :1] + [0, 1, 0, 1]).ravel()
    row = (first[:, 1:] + [0, 0, 1, 1]).ravel()
    area = np.prod(1 - np.abs(np.stack([column, row], -1) - np.repeat(pixels, 4, axis=0)), axis=-1)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (area > 0)
    place = (row[inside] * camera.width + column[inside]).astype(np.int64)
    z, area, of_point = np.repeat(points[:, 2], 4)[inside], area[inside], np.repeat(np.arange(len(points)), 4)[inside]
    nearest = np.full(camera.height * camera.width, np.inf)
    np.minimum.at(nearest, place, z)
    front = z <= _SAME_SURFACE * nearest[place]
    place, area, of_point, z = place[front], area[front], of_point[front], z[front]
    layers = [np.bincount(place, area * values, len(nearest)) for values in (1 / z, *colours[of_point].T.astype(float))]
    covered = np.bincount(place, area, len(nearest))
    shape = (camera.height, camera.width)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth_mm = (covered / layers[0]).reshape(shape).astype(np.float32)
        rgb = np.nan_to_num(np.stack(layers[1:], -1) / covered[:, None]).reshape(*shape, 3)
    return Rendering(depth_mm, np.round(rgb).astype(np.uint8))


@kernel
def _projected(points: Float64_2d, fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Return u, v, 1 / z of points (V, 3) in the camera, (V, 3); the last is negative where they are not ahead."""
    corners = np.empty(points.shape)
    for n in range(len(points)):
        is_ahead = points[n, 2] > _NEAR_MM
        z = points[n, 2] if is_ahead else 1.0
        corners[n, 0] = points[n, 0] / z * fx + cx
        corners[n, 1] = points[n, 1] / z * fy + cy
        corners[n, 2] = 1 / z if is_ahead else -1.0
    return corners


@kernel
def _rasterise(
    corners: Float64_2d, colours: Float32_2d, faces: Int64_2d, inverse_depth: Float32_2d, rgb: Float32_3d
) -> None:
    """Draw faces (F, 3) of corners (V, 3) as `_projected` returns them. Changes both images.

    colours : (V, 3 or more), of which the first three are drawn.
    """
    height, width = inverse_depth.shape
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ua, va, wa = corners[a, 0], corners[a, 1], corners[a, 2]
        ub, vb, wb = corners[b, 0], corners[b, 1], corners[b, 2]
        uc, vc, wc = corners[c, 0], corners[c, 1], corners[c, 2]
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if wa < 0 or wb < 0 or wc < 0 or area == 0:
            continue
        first_row, last_row = int(max(0, np.ceil(min(va, vb, vc)))), int(min(height - 1, np.floor(max(va, vb, vc))))
        first_col, last_col = int(max(0, np.ceil(min(ua, ub, uc)))), int(min(width - 1, np.floor(max(ua, ub, uc))))
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
