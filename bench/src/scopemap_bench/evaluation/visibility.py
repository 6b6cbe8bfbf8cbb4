"""Visibility from a camera: of a true surface, given its depth, and of a predicted one, by hiding itself."""

from __future__ import annotations

import cv2
import numpy as np
import trimesh

from scopemap.cameras.camera import CameraModel
from scopemap.geometry.se3 import inverse, transform
from scopemap_bench.evaluation.surface import Surface, is_empty, small_triangles

TrueView = tuple[np.ndarray, np.ndarray]
"""One frame's pose (4, 4), camera to world, mm, and its true depth (H, W), mm, NaN = unknown."""

_TOLERANCE = 0.02
_SUBPIXEL_BITS = 4
_PAINTED_PX = 1280
_NEARER = 0.01


def seen_points(points_mm: np.ndarray, camera: CameraModel, view: TrueView) -> np.ndarray:
    """Return which points (N, 3) of a surface, true world mm, one view sees, (N,) bool.

    A point is seen if it projects onto a pixel whose true depth is within 2 % of the point's own z, which allows for
    walls that slope within a pixel.
    """
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

    A mesh hides itself: its triangles, subdivided to 2 mm, are painted from far to near on a grid at least 1280 wide;
    one is kept unless the ray to its centre meets the triangle painted there more than 1 % nearer. Points hide nothing.
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
    """Return which of the `chosen` (M,) triangles (F, 3, 3), in the camera and centred in the image, are hidden.

    The painted triangle's plane is compared, so that neighbours on a wall seen at a grazing angle do not hide each
    other.
    """
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
