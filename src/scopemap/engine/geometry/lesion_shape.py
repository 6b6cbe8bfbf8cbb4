"""Sizes of a lesion on a wall, as one frame shows it: from its mask, depth and the camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist, squareform

from scopemap.engine.cameras.camera import PinholeCamera

_SMOOTH_PX = 1.0  # by hand: of depth within a lesion
_RIM_PX = 2.5  # by hand: width of the outline
_RIM_SHARE = 0.5  # by hand: of it, at most, over the lesion's inner radius
_RING = (0.15, 0.6)  # by hand: the wall beside a lesion: from so far outside its outline to so far, over its radius
_GAP_PX = 2.0  # by hand: between the outline and the wall beside it, at least
_LEAST_RING_PX = 30  # by hand: of that wall
_OUTLIER = 2.5  # by hand: median deviations from its plane
_LEAST_KNOWN = 0.7  # by hand: share of the lesion with known depth
_LEAST_PX = 12  # by hand: of a lesion
# Standard deviations, as shares, by phantoms: of a lesion's diameter by that across the line of sight; of it by depth,
# and what that grows by with the depth between its ends over what is across.
_ROUND_ERROR = 0.1
_DEPTH_ERROR = 0.06  # by phantoms
_SLANT_ERROR = 0.2  # by phantoms
# Correction of ln diameter in a slanted view, by phantoms: the far rim is occluded; what protrudes shows its side.
_OCCLUSION = 0.1
_PROTRUSION = 0.5  # by phantoms


@dataclass(frozen=True)
class LesionShape:
    """Sizes of a lesion as one frame shows it, mm and mm2; NaN: unknown.

    diameter, cross : the largest, and the largest across it. height : of its top over the plane of the wall beside it.
    along, area : over a cap with this outline and height. facing : cosine at which that plane is seen. sigma : standard
    deviation of the diameter, as a share, by how much its two estimates differ.
    """

    diameter: float
    cross: float
    along: float
    area: float
    height: float
    facing: float
    sigma: float


def extents(points: np.ndarray) -> tuple[float, float]:
    """Return the largest distance between two of points (N, 3), and that between them seen along it; 0: too few."""
    largest, first, last = _farthest(points)
    if largest == 0:
        return 0.0, 0.0
    across = np.linalg.svd((points[last] - points[first])[None])[2][1:]
    return largest, _farthest((points - points[first]) @ across.T)[0]


def lesion_shape(mask: np.ndarray, depth_mm: np.ndarray, camera: PinholeCamera) -> LesionShape | None:
    """Return the sizes of a lesion in a frame; None where too little of its depth is known.

    mask : (H, W) bool. depth_mm : (H, W), NaN = unknown. Depth errs most along the line of sight, so the diameter by
    depth is joined with that across the line of sight, which is nearly as large as lesions are round; each has its
    weight.
    """
    known = mask & np.isfinite(depth_mm)
    if known.sum() < max(_LEAST_KNOWN * mask.sum(), _LEAST_PX):
        return None
    smooth, outline = _smoothed(mask, depth_mm)
    v, u = np.nonzero(mask)
    # A pixel is an area: the outline is this far beyond the middles of a mask's outermost, by ellipses.
    sides = 0.25 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    pixels = (np.stack([u, v], -1)[:, None] + sides).reshape(-1, 2)
    rays = camera.unproject(pixels)
    points = rays * np.repeat(smooth[mask], len(sides))[:, None]
    largest, first, last = _farthest(points)
    flat = _farthest(rays[:, :2])[0] * float(np.median(smooth[outline]))
    if largest == 0 or flat == 0:
        return None
    slant = _slant(points[first], points[last])
    weights = np.array([_DEPTH_ERROR**2 + (_SLANT_ERROR * slant) ** 2, _ROUND_ERROR**2]) ** -1
    both = np.log([largest, flat])
    diameter = float(np.exp(np.average(both, weights=weights)))
    apart = float(np.sqrt(np.average((both - np.log(diameter)) ** 2, weights=weights)))
    height, facing = _height(mask, depth_mm, camera, points)
    if np.isfinite(height):
        diameter *= float(np.exp((1 - facing) * (_OCCLUSION - _PROTRUSION * np.clip(height / diameter, 0, 1))))
    cross = min(extents(points)[1], diameter)
    rise = max(float(np.nan_to_num(height)), 1e-3 * diameter)
    radius = (diameter**2 / 4 + rise**2) / (2 * rise)
    along = 2 * radius * float(np.arctan2(diameter / 2, radius - rise))
    # Over the ellipse that is as long and wide, in the picture.
    length, width = extents(np.column_stack([pixels, np.zeros(len(pixels))]))
    base = diameter * cross * mask.sum() / (length * width)
    return LesionShape(diameter, cross, along, float(base + np.pi * rise**2), height, facing, apart)


def _slant(first: np.ndarray, last: np.ndarray) -> float:
    """Return how much of the way between two points (3,) is along the line of sight, over what is across it."""
    sight = (first + last) / np.linalg.norm(first + last)
    along = abs(float((last - first) @ sight))
    return along / max(float(np.linalg.norm(last - first - ((last - first) @ sight) * sight)), 1e-9)


def _smoothed(mask: np.ndarray, depth_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return depth (H, W) of a mask's pixels, smoothed, NaN outside; and which pixels are beside the outline.

    There depth runs into that of what is behind: it is off the plane of what is farther inside as the nearest pixel of
    that is.
    """
    within = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outline = mask & (within <= min(_RIM_PX, _RIM_SHARE * float(within.max())))
    inner = mask & np.isfinite(depth_mm) & ~outline
    inner = inner if inner.any() else mask & np.isfinite(depth_mm)
    # A plane has a linear inverse depth.
    v, u = np.indices(mask.shape)
    linear = np.stack([np.ones(mask.shape), u, v], axis=-1)
    plane = linear @ np.linalg.lstsq(linear[inner], 1 / depth_mm[inner])[0]
    outside = (~inner).astype(np.uint8)
    labels = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    off = np.zeros(labels.max() + 1)
    off[labels[inner]] = 1 / depth_mm[inner] - plane[inner]
    inside = mask.astype(np.float64)
    total, weight = (cv2.GaussianBlur(x, (0, 0), _SMOOTH_PX) for x in ((plane + off[labels]) * inside, inside))
    return np.where(mask, weight / np.maximum(total, 1e-12), np.nan), outline if outline.any() else mask


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
