"""Sizes of a lesion on a wall."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist, squareform


def extents(points: np.ndarray) -> tuple[float, float]:
    """Return the largest distance between two of points (N, 3), and that between them seen along it; 0: too few."""
    largest, along = _largest(points)
    if largest == 0:
        return 0.0, 0.0
    return largest, _largest((points - points[0]) @ np.linalg.svd(along[None])[2][1:].T)[0]


def _largest(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the largest distance between points (N, D), and the direction (D,) of it; 0 where they fill no space."""
    try:
        hull = points[ConvexHull(points, qhull_options="QJ").vertices]
    except (QhullError, ValueError):
        return 0.0, np.zeros(points.shape[1])
    apart = squareform(pdist(hull))
    first, last = np.unravel_index(int(apart.argmax()), apart.shape)
    return float(apart.max()), (hull[last] - hull[first]) / apart.max()
