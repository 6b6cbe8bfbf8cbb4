"""Finishes the fused mesh: small holes closed and the border even, or all closed; on request smoothed, simplified."""

from __future__ import annotations

from typing import Any

import fast_simplification
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.engine.config import FusionSettings
from scopemap.engine.geometry.kernels import Float64_1d, Int64_1d, Int64_2d, kernel
from scopemap.engine.geometry.mesh_faces import without_unused
from scopemap.engine.geometry.rendering import vertex_colours

# Taubin, SIGGRAPH 1995: steps that shrink and steps that grow, 1 / 0.5 - 1 / 0.52 = 0.08, hardly change the volume.
_SHRINK = 0.5
_GROW = 0.52  # see above
_LARGEST_PERIMETER_VOXELS = 20.0  # by hand: of a hole that is closed
# Cosine between a loop's own normal and the surface's beside it: -1 around a hole in a plane, 1 around an island, 0 at
# the end of a tube, which leads to what no frame saw.
_HOLE_COSINE = -0.5  # by hand
# Rings of vertices that are taken away at borders, and given back to what is left: strips and specks do not come back.
_BORDER_RINGS = 1  # by hand
# As many given back as taken away cost 6 % of laparoscopy_rvim 60:120, and right results were called Doubtful for it;
# these cost 2 %.
_GROWN_RINGS = 4
_LEAST_BROAD = 0.5  # guard: of a surface without any broad part its thin parts are all there is
_BORDER_STEPS = 12  # by hand


def finished(mesh: trimesh.Trimesh, settings: FusionSettings) -> trimesh.Trimesh:
    """Return the mesh of a fusion as the settings, with the voxel size that was used, want it."""
    if settings.holes == "small" and settings.voxel_mm is not None:
        mesh = with_even_border(without_small_holes(mesh, _LARGEST_PERIMETER_VOXELS * settings.voxel_mm))
    elif settings.holes == "watertight" and settings.voxel_mm is not None:
        from scopemap.engine.fusion.watertight import watertight

        mesh = watertight(mesh, settings.voxel_mm)
    mesh = smoothed(mesh, settings.mesh_smooth)
    return mesh if settings.mesh_faces is None else simplified(mesh, settings.mesh_faces)


def with_normals_alone(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh with its vertex normals and nothing else that trimesh keeps once it was asked for.

    Angles, triangles and normals of faces take 60 MB of a submap, and an examination has dozens.
    """
    if not len(mesh.faces):
        return mesh
    lean = _moved(mesh, np.asarray(mesh.vertices))
    lean.vertex_normals = mesh.vertex_normals  # type: ignore[method-assign]  # a property
    return lean


def simplified(mesh: trimesh.Trimesh, most_faces: int) -> trimesh.Trimesh:
    """Return the mesh with at most about so many faces (Garland and Heckbert, SIGGRAPH 1997); borders stay."""
    if len(mesh.faces) <= most_faces:
        return mesh
    vertices, faces = fast_simplification.simplify(
        np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32), target_count=most_faces
    )
    nearest = cKDTree(mesh.vertices).query(vertices)[1]
    return trimesh.Trimesh(
        np.asarray(vertices, np.float64),
        faces,
        vertex_colors=vertex_colours(mesh)[nearest],
        vertex_attributes={name: np.asarray(values)[nearest] for name, values in mesh.vertex_attributes.items()},
        process=False,
    )


def smoothed(mesh: trimesh.Trimesh, iterations: int) -> trimesh.Trimesh:
    """Return the mesh after so many pairs of steps, one that shrinks and one that grows; border vertices stay."""
    if not iterations or not len(mesh.faces):
        return mesh
    laplacian = trimesh.smoothing.laplacian_calculation(mesh, pinned_vertices=np.unique(border_edges(mesh)))
    return trimesh.smoothing.filter_taubin(mesh.copy(), _SHRINK, _GROW, 2 * iterations, laplacian)


def without_small_holes(mesh: trimesh.Trimesh, largest_perimeter_mm: float) -> trimesh.Trimesh:
    """Return the mesh with the holes closed whose border is at most so long and that the surface surrounds.

    Each gets a vertex in its middle and a fan of triangles. The vertex has the border's mean colour and 0 for all
    vertex attributes, such as `confidence`. Vertices and faces keep their numbers, new ones follow. Islands and open
    ends stay as they are.
    """
    if not len(mesh.faces):
        return mesh
    vertices, edges = np.asarray(mesh.vertices), border_edges(mesh)
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    found = _LoopVertices(*_loops(edges, lengths, len(vertices), largest_perimeter_mm))
    if not len(found.counts) or not (is_hole := _are_holes(mesh, found)).any():
        return mesh
    loops = _LoopVertices(found.vertices[is_hole[found.loop]], found.counts[is_hole])
    fans = np.stack([loops.vertices[loops.after], loops.vertices, len(vertices) + loops.loop], axis=1)
    colours = vertex_colours(mesh)
    shades = np.round(loops.means(colours)).astype(colours.dtype)
    attributes: dict[str, Any] = {
        name: np.concatenate([values, np.zeros((len(loops.counts), *np.shape(values)[1:]), np.asarray(values).dtype)])
        for name, values in mesh.vertex_attributes.items()
    }
    return trimesh.Trimesh(
        np.concatenate([vertices, loops.means(vertices)]),
        np.concatenate([mesh.faces, fans]),
        vertex_colors=np.concatenate([colours, shades]),
        vertex_attributes=attributes,
        process=False,
    )


def _loops(edges: np.ndarray, lengths: np.ndarray, count: int, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the closed loops of directed edges (E, 2) that are not longer: their vertices, and how many each has.

    lengths : (E,), of the edges. count : of the mesh's vertices. Where two loops touch they are parted.
    """
    order, of_vertex = np.argsort(edges[:, 0], kind="stable"), np.bincount(edges[:, 0], minlength=count)
    lasts = np.cumsum(of_vertex)
    found, counts = np.empty(len(edges), np.int64), np.empty(len(edges), np.int64)
    size, loops = _follow(edges, order, np.column_stack([lasts - of_vertex, lasts]), lengths, longest, found, counts)
    return found[:size].copy(), counts[:loops].copy()


@kernel
def _follow(
    edges: Int64_2d,
    order: Int64_1d,
    remaining: Int64_2d,
    lengths: Float64_1d,
    longest: float,
    found: Int64_1d,
    counts: Int64_1d,
) -> tuple[int, int]:
    """Put the vertices of the loops into `found`, how many each has into `counts`; return how many there are of both.

    order : edges by the vertex where they begin. remaining : (V, 2), of each vertex, its first edge in this order and
    the one after its last, which counts down.
    """
    place, size, loops = np.full(len(remaining), -1), 0, 0
    path, travelled = np.empty(len(edges) + 1, np.int64), np.empty(len(edges) + 1)
    for edge in range(len(edges)):
        path[0], travelled[0], last = edges[edge, 0], 0.0, 0
        place[path[0]] = 0
        while remaining[path[last], 1] > remaining[path[last], 0]:
            remaining[path[last], 1] -= 1
            onwards = order[remaining[path[last], 1]]
            end, far = edges[onwards, 1], travelled[last] + lengths[onwards]
            if place[end] < 0:
                last += 1
                place[end], path[last], travelled[last] = last, end, far
                continue
            # The path has come back: what it encloses is a loop, and it goes on from there.
            back = place[end]
            if far - travelled[back] <= longest:
                for n in range(back, last + 1):
                    found[size] = path[n]
                    size += 1
                counts[loops] = last + 1 - back
                loops += 1
            for n in range(back + 1, last + 1):
                place[path[n]] = -1
            last = back
        for n in range(last + 1):
            place[path[n]] = -1
    return size, loops


class _LoopVertices:
    """Loops of vertices one after the other.

    vertices : (N,) their numbers. loop : (N,) the number of the loop of each. after : (N,) where the one that follows
    each in its loop is. counts : (L,) how many each loop has.
    """

    def __init__(self, vertices: np.ndarray, counts: np.ndarray) -> None:
        self.vertices, self.counts = vertices, counts
        self.loop = np.repeat(np.arange(len(counts)), counts)
        ends = np.cumsum(counts)
        self.after = np.arange(1, len(vertices) + 1)
        self.after[ends - 1] = ends - counts

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sums (L, n) of values (N, n)."""
        # One value after the other: `np.add.reduceat` adds in another order.
        return np.stack([np.bincount(self.loop, column, len(self.counts)) for column in values.T], axis=1)

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the means (L, n) of values (V, n) of all vertices of the mesh."""
        return self.sums(values[self.vertices]) / self.counts[:, None]


def _are_holes(mesh: trimesh.Trimesh, loops: _LoopVertices) -> np.ndarray:
    """Return whether loops of border vertices, directed as their faces, go around a hole in the surface, (L,) bool."""
    vertices, faces, at_border = np.asarray(mesh.vertices), np.asarray(mesh.faces), np.zeros(len(mesh.vertices), bool)
    at_border[loops.vertices] = True
    # Normals of all vertices would take most of the time.
    beside = trimesh.Trimesh(vertices, faces[_with_any(at_border, faces)], process=False)
    arms = vertices[loops.vertices] - loops.means(vertices)[loops.loop]
    areas = loops.sums(np.cross(arms, arms[loops.after]))
    around = loops.sums(np.asarray(beside.vertex_normals)[loops.vertices])
    found: np.ndarray = (areas * around).sum(axis=1) < _HOLE_COSINE * (
        np.linalg.norm(areas, axis=1) * np.linalg.norm(around, axis=1)
    )
    return found


def with_even_border(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh without strips and specks, its border smooth; the inside stays as it is.

    A border lies where voxels got too little weight, at grazing angles and at the frames' edges, so it is as ragged as
    the grid: saw-teeth, combs. The surface is opened, nearly as a picture is in morphology (Serra, "Image analysis and
    mathematical morphology", 1982), with rings of vertices in place of pixels. Vertices that are left keep colours and
    attributes. A mesh that is mostly so thin stays as it is.
    """
    if not len(mesh.faces):
        return mesh
    faces, at_border = np.asarray(mesh.faces), np.zeros(len(mesh.vertices), bool)
    at_border[border_edges(mesh)] = True
    inside = ~_grown(at_border, faces, _BORDER_RINGS)
    kept = ~_with_any(~_grown(inside, faces, _GROWN_RINGS), faces)
    if kept.sum() < _LEAST_BROAD * len(faces):
        return mesh
    return _with_smooth_border(mesh if kept.all() else _part(mesh, kept))


def border_edges(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the edges (E, 2) that only one face has, directed as in their face, sorted by their vertices."""
    starts = np.asarray(mesh.faces).T.ravel()
    ends, count = np.roll(starts, -len(mesh.faces)), len(mesh.vertices)
    # Numbers that hold both vertices and the direction: they are sorted in half the time of their order.
    keys = np.sort(2 * (np.minimum(starts, ends) * count + np.maximum(starts, ends)) + (starts > ends))
    differs = np.diff(keys >> 1, prepend=-1, append=-1) != 0
    keys = keys[differs[1:] & differs[:-1]]
    edges = np.stack(np.divmod(keys >> 1, max(count, 1)), axis=1)
    return np.where((keys & 1 > 0)[:, None], edges[:, ::-1], edges)


def _grown(chosen: np.ndarray, faces: np.ndarray, rings: int) -> np.ndarray:
    """Return the chosen vertices (V,) bool with so many rings around them."""
    grown = chosen.copy()
    for _ in range(rings):
        grown[faces[_with_any(grown, faces)]] = True
    return grown


def _with_any(chosen: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the faces (F,) bool that have any of the chosen vertices (V,) bool."""
    a, b, c = faces.T
    return np.asarray(chosen[a] | chosen[b] | chosen[c])


def _part(mesh: trimesh.Trimesh, kept: np.ndarray) -> trimesh.Trimesh:
    """Return the kept faces (F,) bool of a mesh and their vertices."""
    used, faces = without_unused(np.asarray(mesh.faces)[kept], len(mesh.vertices))
    attributes: dict[str, Any] = {name: np.asarray(values)[used] for name, values in mesh.vertex_attributes.items()}
    return trimesh.Trimesh(
        np.asarray(mesh.vertices)[used],
        faces,
        vertex_colors=vertex_colours(mesh)[used],
        vertex_attributes=attributes,
        process=False,
    )


def _with_smooth_border(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with its border's vertices smoothed along it; where borders touch they stay."""
    starts, ends = border_edges(mesh).T
    vertices = np.asarray(mesh.vertices).copy()
    one, other = np.concatenate([starts, ends]), np.concatenate([ends, starts])
    free = np.flatnonzero(np.bincount(one, minlength=len(vertices)) == 2)
    order = np.argsort(one)
    first = order[np.searchsorted(one, free, sorter=order)]
    second = order[np.searchsorted(one, free, side="right", sorter=order) - 1]
    before, after = other[first], other[second]
    # No step grows: points of a comb are to become flat, and a line as long as a border does not shrink.
    for _ in range(_BORDER_STEPS):
        vertices[free] += _SHRINK * ((vertices[before] + vertices[after]) / 2 - vertices[free])
    return _moved(mesh, vertices)


def _moved(mesh: trimesh.Trimesh, vertices: np.ndarray) -> trimesh.Trimesh:
    """Return the mesh with its vertices (V, 3) elsewhere; `copy` of trimesh finds the colours of all faces, too."""
    has_colours = mesh.visual is not None and mesh.visual.defined
    return trimesh.Trimesh(
        vertices,
        mesh.faces.copy(),
        vertex_colors=vertex_colours(mesh).copy() if has_colours else None,
        vertex_attributes=dict(mesh.vertex_attributes),
        process=False,
    )
