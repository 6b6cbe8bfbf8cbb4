"""Ray-mesh intersection, shortest path on a mesh (refined Dijkstra, Kanai and Suzuki 2001), area inside a polygon."""

from __future__ import annotations

from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.rendering import render_mesh

_PASSES = ((0, 1.03), (1, 1.01), (3, 1.003), (7, 1.0))
"""Points on an edge, and how much longer a path may be whose triangles the next pass has.

Lengths are then up to 1 % too long, by edges alone up to 40 %.
"""
_CELLS = 400  # by hand: along the longer side of a polygon, whose area is measured
_BREAK = 1.05  # by hand: between neighbouring cells: farther apart lie two surfaces
_INSIDE_EDGE = -1e-9  # guard: rays through an edge meet one of its triangles


class SurfacePoint(NamedTuple):
    """A point on a mesh: its position (3,) and the number of its triangle."""

    position: np.ndarray
    face: int


def meet_surface(mesh: trimesh.Trimesh, origin: np.ndarray, direction: np.ndarray) -> SurfacePoint | None:
    """Return the first point of a mesh on a ray, (3,), or None (Möller and Trumbore 1997); both sides count."""
    corner, first, second = _corners(mesh)
    across = np.cross(direction, second)
    determinant = np.einsum("ij,ij->i", first, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = origin - corner
        u = np.einsum("ij,ij->i", shift, across) / determinant
        along = np.cross(shift, first)
        v = along @ direction / determinant
        distance = np.einsum("ij,ij->i", second, along) / determinant
        met = (u >= _INSIDE_EDGE) & (v >= _INSIDE_EDGE) & (u + v <= 1 - _INSIDE_EDGE) & (distance > 0)
    if not met.any():
        return None
    face = int(np.argmin(np.where(met, distance, np.inf)))
    return SurfacePoint(origin + distance[face] * direction, face)


def path_length(mesh: trimesh.Trimesh, start: SurfacePoint, end: SurfacePoint) -> float:
    """Return the length of the shortest path on a mesh between two of its points; infinite where none joins them."""
    if start.face == end.face:
        return float(np.linalg.norm(end.position - start.position))
    kept, vertices, length = np.asarray(mesh.faces), np.asarray(mesh.vertices), np.inf
    for on_edge, longer in _PASSES:
        length, through = _shortest(vertices, kept, (start, end), on_edge)
        if not np.isfinite(length):
            break
        sides = np.linalg.norm(vertices[kept] - vertices[np.roll(kept, 1, axis=1)], axis=2).max(axis=1)
        near = np.flatnonzero(through <= longer * length + sides)
        start, end = (SurfacePoint(p.position, int(np.searchsorted(near, p.face))) for p in (start, end))
        kept = kept[near]
    return length


def area_inside(
    mesh: trimesh.Trimesh, polygon_px: np.ndarray, camera: PinholeCamera, T_world_camera: np.ndarray
) -> float:
    """Return the area, mm2, of what a camera sees of a mesh inside a polygon (N, 2) of its picture, px.

    The polygon's part of the picture is rendered finely; each cell between four of its pixels counts with the area
    that it covers on the surface, unless the surface breaks off there.
    """
    low, high = polygon_px.min(axis=0), polygon_px.max(axis=0)
    scale = _CELLS / max(float((high - low).max()), 1e-6)
    width, height = (int(side) for side in np.ceil((high - low) * scale) + 2)
    # So that `low` is in the middle of pixel (0.5, 0.5) of the part.
    shift = (low - [camera.cx, camera.cy]) * scale - 0.5
    part = PinholeCamera(camera.fx * scale, camera.fy * scale, -shift[0], -shift[1], width, height)
    depth_mm = render_mesh(mesh, part, T_world_camera).depth_mm.astype(np.float64)
    points = part.rays * depth_mm[..., None]
    one, other = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    area = np.linalg.norm(np.cross(one, other), axis=-1) / 2
    around = np.stack([depth_mm[:-1, :-1], depth_mm[1:, 1:], depth_mm[1:, :-1], depth_mm[:-1, 1:]])
    whole = around.max(axis=0) < _BREAK * around.min(axis=0)  # False where one is unknown
    # Cell (i, j) has its middle at pixel (i, j) + 0.5, in the polygon moved by half a pixel.
    inside = _cells_inside((polygon_px - low) * scale, height - 1, width - 1)
    return float(area[whole & inside].sum())


def _cells_inside(polygon: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return which cells' middles, at whole numbers, are inside a polygon (N, 2): to their right, odd crossings."""
    x, y, inside = np.arange(width), np.arange(height)[:, None], np.zeros((height, width), bool)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crossed = (a[1] > y) != (b[1] > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside ^= crossed & (x < (b[0] - a[0]) * ((y - a[1]) / (b[1] - a[1])) + a[0])
    return inside


def _corners(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first corners of all triangles and their two sides from there, (F, 3) each."""
    triangles = np.asarray(mesh.triangles)
    return triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]


def _shortest(
    vertices: np.ndarray, faces: np.ndarray, ends: tuple[SurfacePoint, SurfacePoint], on_edge: int
) -> tuple[float, np.ndarray]:
    """Return the shortest length through vertices and `on_edge` points on each edge, and through each face, (F,)."""
    nodes, of_face = _nodes(vertices, faces, on_edge)
    pairs = [of_face[:, pair] for pair in _joined_pairs(on_edge)]
    for number, point in enumerate(ends, start=len(nodes)):
        own = of_face[point.face]
        pairs.append(np.column_stack([own, np.full(len(own), number)]))
    places = np.vstack([nodes, *(point.position for point in ends)])
    # Each pair once: the sparse matrix would add the lengths of an edge that two triangles share.
    ordered = np.sort(np.concatenate(pairs), axis=1)
    joined = np.column_stack(np.divmod(np.unique(ordered[:, 0] * len(places) + ordered[:, 1]), len(places)))
    lengths = np.linalg.norm(places[joined[:, 0]] - places[joined[:, 1]], axis=1)
    graph = coo_array((lengths, tuple(joined.T)), shape=(len(places), len(places))).tocsr()
    from_start, from_end = dijkstra(graph, directed=False, indices=[len(nodes), len(nodes) + 1])
    return float(from_start[-1]), (from_start + from_end)[of_face].min(axis=1)


def _joined_pairs(on_edge: int) -> list[list[int]]:
    """Return the pairs of a face's nodes that are joined: neighbours on a side, and all that are on no common side."""
    sides = []
    for number, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
        first = 3 + number * on_edge
        sides.append([a, *range(first, first + on_edge), b])
    across = [pair for pair in combinations(range(3 + 3 * on_edge), 2) if not any(set(pair) <= set(s) for s in sides)]
    return [*map(list, across), *(list(pair) for side in sides for pair in pairwise(side))]


def _nodes(vertices: np.ndarray, faces: np.ndarray, on_edge: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (N, 3) and those of each face (F, 3 + 3 on_edge): corners, then points on sides 01, 12, 20.

    Both faces at an edge have the same points; a side that runs against its edge has them in reverse.
    """
    sides = np.stack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]], axis=1).reshape(-1, 2)
    edges, edge_of = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    shares = np.arange(1, on_edge + 1) / (on_edge + 1)
    ends = vertices[edges]
    added = ends[:, :1] + shares[None, :, None] * (ends[:, 1:] - ends[:, :1])
    order = np.arange(on_edge)
    places = np.where((sides[:, 0] < sides[:, 1])[:, None], order, order[::-1])
    points = len(vertices) + edge_of.reshape(-1, 1) * on_edge + places
    return np.vstack([vertices, added.reshape(-1, 3)]), np.hstack([faces, points.reshape(len(faces), -1)])
