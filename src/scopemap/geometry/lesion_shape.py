"""Sizes of a lesion on a wall, as one view shows it: from its mask, depth and the camera."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist, squareform

from scopemap.cameras.camera import PinholeCamera

FIGURES = ("diameter", "cross", "along", "area", "height")
_SMOOTH_PX, _PROFILE = 1.0, 64
_RING = (0.15, 0.6)  # the wall beside a lesion: from so far outside its outline to so far, over its radius
_GAP_PX, _LEAST_RING_PX = 2.0, 30
_OUTLIER = 2.5


def extents(points: np.ndarray) -> tuple[float, float]:
    """Return the largest distance between two of points (N, 3), and that between them seen along it; 0: too few."""
    largest, first, last = _farthest(points)
    if largest == 0:
        return 0.0, 0.0
    across = np.linalg.svd((points[last] - points[first])[None])[2][1:]
    return largest, _farthest((points - points[first]) @ across.T)[0]


def view_shape(mask: np.ndarray, depth_mm: np.ndarray, camera: PinholeCamera) -> dict[str, float]:
    """Return the figures of a lesion in a view, mm and mm2, and `facing`: the cosine at which its wall is seen.

    mask : (H, W) bool. depth_mm : (H, W), NaN = unknown. diameter, cross : `extents` of what is seen. along : length
    on the surface between the diameter's ends, where the view shows them joined by a straight line. height : from the
    wall beside it, NaN where too little of that is seen. {} where too little depth is known.
    """
    smooth = _smoothed(mask, depth_mm)
    known = mask & np.isfinite(smooth)
    if known.sum() < 0.7 * mask.sum() or known.sum() < 12:
        return {}
    v, u = np.nonzero(known)
    # A pixel is an area: its sides count.
    sides = np.array([[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]])
    pixels = (np.stack([u, v], -1)[:, None] + sides).reshape(-1, 2)
    points = camera.unproject(pixels) * np.repeat(smooth[known], len(sides))[:, None]
    diameter, cross = extents(points)
    _, first, last = _farthest(points)
    line = np.linspace(pixels[first], pixels[last], _PROFILE).astype(np.float32)
    filled = np.where(known, smooth, 0).astype(np.float32)
    weight = cv2.remap(known.astype(np.float32), line[:, 0], line[:, 1], cv2.INTER_LINEAR).ravel()
    profile = cv2.remap(filled, line[:, 0], line[:, 1], cv2.INTER_LINEAR).ravel() / np.maximum(weight, 1e-6)
    ends = weight > 0.05
    path = camera.unproject(line[ends].astype(float)) * profile[ends, None]
    along = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) * _PROFILE / max(int(ends.sum()), 1)
    height, facing = _height(mask, depth_mm, camera, points)
    return {
        "diameter": diameter,
        "cross": cross,
        "along": max(along, diameter),
        "area": _area(known, smooth, camera) * mask.sum() / known.sum(),
        "height": height,
        "facing": facing,
    }


def _smoothed(mask: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """Return depth (H, W) smoothed inside a mask, by pixels of it alone; NaN outside."""
    known = (mask & np.isfinite(depth_mm)).astype(np.float64)
    inverse = np.where(known > 0, 1 / np.where(known > 0, depth_mm, 1.0), 0.0)
    total, weight = (cv2.GaussianBlur(image, (0, 0), _SMOOTH_PX) for image in (inverse, known))
    return np.where(mask & (weight > 0.2), weight / np.maximum(total, 1e-12), np.nan)


def _area(known: np.ndarray, depth_mm: np.ndarray, camera: PinholeCamera) -> float:
    """Return the area of the cells between four known pixels, over their share of the known pixels."""
    points = camera.rays * np.where(known, depth_mm, np.nan)[..., None]
    one, other = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    area = np.linalg.norm(np.cross(one, other), axis=-1) / 2
    cells = np.isfinite(area)
    return float(area[cells].sum() * known.sum() / max(int(cells.sum()), 1))


def _height(mask: np.ndarray, depth_mm: np.ndarray, camera: PinholeCamera, points: np.ndarray) -> tuple[float, float]:
    """Return how far points (N, 3) rise from the wall around a mask, and the cosine at which the wall is seen."""
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    radius = np.sqrt(mask.sum() / np.pi)
    near = max(_RING[0] * radius, _GAP_PX)
    ring = (away > near) & (away < near + max(_RING[1] * radius, 2 * _GAP_PX)) & np.isfinite(depth_mm)
    if ring.sum() < _LEAST_RING_PX:
        return np.nan, np.nan
    wall = (camera.rays * depth_mm[..., None])[ring]
    middle = points.mean(0)
    for _ in range(3):
        plane = wall.mean(0)
        normal = np.linalg.svd(wall - plane, full_matrices=False)[2][2]
        off = (wall - plane) @ normal
        wall = wall[np.abs(off) <= _OUTLIER * max(float(np.median(np.abs(off))), 1e-9)]
    normal = -normal if normal @ middle > 0 else normal
    facing = float(-(normal @ middle) / np.linalg.norm(middle))
    return float(np.percentile((points - plane) @ normal, 98)), facing


def _farthest(points: np.ndarray) -> tuple[float, int, int]:
    """Return the largest distance between points (N, D), and which two have it; 0 where they fill no space."""
    try:
        corners = ConvexHull(points, qhull_options="QJ").vertices
    except (QhullError, ValueError):
        return 0.0, 0, 0
    apart = squareform(pdist(points[corners]))
    first, last = np.unravel_index(int(apart.argmax()), apart.shape)
    return float(apart.max()), int(corners[first]), int(corners[last])
