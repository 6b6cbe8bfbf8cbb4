"""Distances from points to the triangles of a mesh, exact near the surface.

`trimesh.proximity` needs an index that is not among the dependencies; this one is scipy's k-d tree of centroids.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.errors import check_shape

_LARGEST_EDGE_MM = 2.0
_MOST_TRIANGLES = 1_000_000
_CANDIDATES = (8, 32, 128)
_CHUNK = 5_000


def distance_to_mesh(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the distance (N,) float64, mm, of points (N, 3), mm, to the nearest triangle of a mesh.

    Triangles with an edge over 2 mm are first subdivided (which moves no surface), so that each is within r <= 1.4 mm
    of its centroid (more only on meshes over 4 m^2). The triangles of the 8 nearest centroids are measured exactly; the
    result is exact once the last of these centroids is farther than the result + r, else 32 and at last 128 are taken.
    What remains (points far from a bent surface) is too large by at most r, and never too small.
    """
    check_shape("points", points, (None, 3))
    triangles = small_triangles(mesh)
    centroids = triangles.mean(axis=1)
    radii = np.linalg.norm(triangles - centroids[:, None], axis=2).max(axis=1)
    normals = trimesh.util.unitize(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    tree = cKDTree(centroids)
    distances, unsettled = np.full(len(points), np.inf), np.arange(len(points))
    for candidates in _CANDIDATES:
        count = min(candidates, len(triangles))
        settled = np.zeros(len(points), dtype=bool)
        for start in range(0, len(unsettled), _CHUNK):
            rows = unsettled[start : start + _CHUNK]
            to_centroid, nearest = tree.query(points[rows], k=list(range(1, count + 1)))
            # No triangle is nearer than the disc about it in its plane; without area its normal is 0, the disc a ball.
            offsets = points[rows, None] - centroids[nearest]
            height = np.einsum("nki,nki->nk", offsets, normals[nearest])
            beside = np.sqrt(np.maximum(np.einsum("nki,nki->nk", offsets, offsets) - height**2, 0.0))
            at_least = np.hypot(height, np.maximum(beside - radii[nearest], 0.0))
            distances[rows] = _nearest_mm(points[rows], triangles, nearest, at_least)
            settled[rows] = (distances[rows] <= to_centroid[:, -1] - radii.max()) | (count == len(triangles))
        unsettled = unsettled[~settled[unsettled]]
    return distances


def _nearest_mm(points: np.ndarray, triangles: np.ndarray, nearest: np.ndarray, at_least_mm: np.ndarray) -> np.ndarray:
    """Return the smallest distance of each point to its candidate triangles `nearest` (N, K).

    A candidate whose lower bound `at_least_mm` (N, K) exceeds the first one's distance is not measured.
    """
    first = np.linalg.norm(trimesh.triangles.closest_point(triangles[nearest[:, 0]], points) - points, axis=1)
    rows, columns = np.nonzero(at_least_mm[:, 1:] < first[:, None])
    chosen = triangles[nearest[rows, columns + 1]]
    measured = np.linalg.norm(trimesh.triangles.closest_point(chosen, points[rows]) - points[rows], axis=1)
    np.minimum.at(first, rows, measured)
    return first


def small_triangles(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the mesh as triangles (F, 3, 3) with no edge over 2 mm (more only on meshes over 4 m^2)."""
    longest = max(_LARGEST_EDGE_MM, float(np.sqrt(mesh.area / _MOST_TRIANGLES)))
    if mesh.edges_unique_length.max() <= longest:
        return np.asarray(mesh.triangles)
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=longest, max_iter=40)
    return vertices[faces]
