"""The mesh: marching cubes on the distance field by chunks of 64^3 cells, welded by edge address, without floaters."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import trimesh

from scopemap.engine.config.mapping import FusionSettings
from scopemap.engine.fusion.albedo import displayed
from scopemap.engine.fusion.tsdf import BLOCK, unpack
from scopemap.engine.fusion.voxel_blocks import VoxelBlocks, dense
from scopemap.engine.geometry.kernels import (
    Float32_3d,
    Float64_1d,
    Float64_2d,
    Int64_1d,
    Int64_2d,
    inner_kernel,
    kernel,
)
from scopemap.engine.geometry.mesh_faces import connected_parts, without_unused

_CHUNK_BLOCKS = 8  # by hand, for memory: the result does not depend on it
_CHUNK = _CHUNK_BLOCKS * BLOCK
# Keeps every vertex off the grid corners, where its edge would be ambiguous.
_SMALLEST_DISTANCE_VOXELS = 1e-3
# A cell's diagonal is sqrt(3) voxels, and a distance changes by no more than the step: twice that is a depth edge, not
# a surface. Without the limit, walls of the truncation's depth would grow behind every fold's silhouette.
_LARGEST_SPREAD_VOXELS = 3.5
_MIN_WEIGHT = 0.1  # by hand: voxels with less weight give no surface
_UNSEEN_GREY = 128.0  # by hand: colour of what no frame saw
# Weight of a vertex whose confidence is 1 - 1/e: a frontal look from near weighs 1.
_CONFIDENT_WEIGHT = 1.5  # by hand
# Corners of a cell are numbered by 4 i + 2 j + k. Its faces, counter-clockwise seen from outside; its edges by axis.
_FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
_EDGES = np.array([(c, c + step) for step in (4, 2, 1) for c in range(8) if not c & step])  # pairs of corners
_EDGE_OF = np.full((8, 8), -1)  # edge between two corners; -1: none
_EDGE_OF[_EDGES, _EDGES[:, ::-1]] = np.arange(len(_EDGES))[:, None]
_ON_FACE = np.array([[{*edge} <= {*face} for face in _FACES] for edge in _EDGES])
_ON_ONE_FACE = (_ON_FACE[:, None] & _ON_FACE).any(-1)  # whether two edges are on one face
_MOST_TRIANGLES = len(_EDGES)  # of a cell


class _Chunk(NamedTuple):
    """Mesh of a chunk: vertices (V, 3) in voxels, edges (V, 3), values (V, 4) colour, confidence 0..1, faces (F, 3)."""

    vertices: np.ndarray
    edges: np.ndarray
    values: np.ndarray
    faces: np.ndarray


def extract_mesh(
    blocks: VoxelBlocks, settings: FusionSettings, voxel_mm: float, median_level: float | None = None
) -> trimesh.Trimesh:
    """Return the zero level of the field as a mesh in world mm, its normals towards free space, with vertex colours.

    Only cells whose 8 corners all have some weight, at least `_MIN_WEIGHT` unless weights are off, give faces: unseen
    space stays a hole. Components with less than `min_component_share` of the faces are dropped, the largest never. No
    surface: a mesh without vertices.
    `vertex_attributes["confidence"]`: (V,) float32, 0..1, 1 - exp(-weight / 1.5). median_level : median grey level,
    0..255, that the colours are scaled to; None: they stay as they are.
    """
    least = _MIN_WEIGHT if settings.weighted else 0.0
    chunks = [_extract_chunk(blocks, own, voxel_mm, least) for own in _by_chunk(unpack(blocks.keys()))]
    mesh = _weld([chunk for chunk in chunks if chunk is not None])
    vertices, faces, values = _without_floaters(*mesh, settings.min_component_share)
    shown = np.round(displayed(values[:, :3], median_level)).astype(np.uint8)
    confidence: dict[str, Any] = {"confidence": values[:, 3].astype(np.float32)}
    return trimesh.Trimesh(vertices * voxel_mm, faces, vertex_colors=shown, vertex_attributes=confidence, process=False)


def _by_chunk(coordinates: np.ndarray) -> list[np.ndarray]:
    """Return the coordinates (N, 3) of blocks by the chunk that they are in, each (n, 3)."""
    corners, chunk = np.unique(coordinates // _CHUNK_BLOCKS, axis=0, return_inverse=True)
    order, chunk = np.argsort(chunk.ravel()), np.sort(chunk.ravel())
    return np.split(coordinates[order], np.searchsorted(chunk, np.arange(1, len(corners)))) if len(corners) else []


def _extract_chunk(blocks: VoxelBlocks, own: np.ndarray, voxel_mm: float, min_weight: float) -> _Chunk | None:
    """Return the mesh of the cells whose first corner is in the blocks (n, 3) of a chunk; None: no surface."""
    first, count = own.min(axis=0), np.ptp(own, axis=0) + 1
    slots = blocks.box(first, count + 1)
    # Of the blocks beyond them the first samples alone.
    inside = tuple(slice(BLOCK * blocks_along + 1) for blocks_along in count.tolist())
    tsdf, weight = (dense(array[slots])[inside] for array in (blocks.voxels.tsdf, blocks.voxels.weight))
    smallest = _SMALLEST_DISTANCE_VOXELS * voxel_mm
    tsdf = np.where(np.abs(tsdf) < smallest, np.copysign(np.float32(smallest), tsdf), tsdf)
    known = weight >= max(min_weight, np.finfo(np.float32).tiny)
    cells = _crossed_cells(tsdf, known, _LARGEST_SPREAD_VOXELS * voxel_mm)
    if not cells.any():
        return None
    # Counted from the chunk's corner, so that how they are rounded does not depend on which blocks are there.
    corner, start = first // _CHUNK_BLOCKS * _CHUNK, first % _CHUNK_BLOCKS * BLOCK
    local, faces = marching_cubes(tsdf, cells, tuple(start.tolist()))
    low, high = np.floor(local).astype(np.int64), np.ceil(local).astype(np.int64)
    ends = [(_colours(blocks, slots, end), weight[tuple(end.T)]) for end in (low - start, high - start)]
    share = np.ascontiguousarray((local - low).T).max(axis=0)[:, None]
    return _Chunk(local + corner, low + high + 2 * corner, _values(share, *ends), faces)


def _colours(blocks: VoxelBlocks, slots: np.ndarray, voxels: np.ndarray) -> np.ndarray:
    """Return the colours (N, 4) of voxels (N, 3) of a box of blocks, counted from its first one."""
    block, (i, j, k) = voxels // BLOCK, voxels.T % BLOCK
    return np.asarray(blocks.voxels.colour[slots[tuple(block.T)], i, j, k])


def _crossed_cells(tsdf: np.ndarray, known: np.ndarray, largest_spread_mm: float) -> np.ndarray:
    """(n-1)^3 bool: all 8 corners known, on both sides of the surface, and not on both sides of a depth edge."""
    low, high = _corners(tsdf, np.minimum), _corners(tsdf, np.maximum)
    return _corners(known, np.logical_and) & (low < 0) & (high > 0) & (high - low <= largest_spread_mm)


def _corners(samples: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Combine the 8 corners of every cell of (n, n, n) samples, one axis after the other."""
    samples = combine(samples[1:], samples[:-1])
    samples = combine(samples[:, 1:], samples[:, :-1])
    return combine(samples[:, :, 1:], samples[:, :, :-1])


def _values(share: np.ndarray, low: tuple[np.ndarray, np.ndarray], high: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Mix the two ends of each vertex's grid edge: colour, an end counting by how well seen it is, and confidence.

    share : (V, 1), of the second end. low, high : colours (V, 4) and weights (V,) at the ends.
    """
    total = (1 - share) * low[0] + share * high[0]
    weight = (1 - share) * low[1][:, None] + share * high[1][:, None]
    seen = total[:, 3:] > 0
    colours = np.where(seen, total[:, :3] / np.where(seen, total[:, 3:], 1.0), _UNSEEN_GREY)
    return np.hstack([colours, 1 - np.exp(-weight / _CONFIDENT_WEIGHT)])


def _weld(chunks: list[_Chunk]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join chunks; vertices on the same grid edge become one. Returns vertices, faces, values."""
    if not chunks:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 4))
    starts = np.cumsum([0, *(len(chunk.vertices) for chunk in chunks[:-1])])
    faces = np.concatenate([chunk.faces + start for chunk, start in zip(chunks, starts, strict=True)])
    edges = np.concatenate([chunk.edges for chunk in chunks])
    edges -= edges.min(axis=0)
    addresses = np.ravel_multi_index(tuple(edges.T), tuple(edges.max(axis=0) + 1))
    _, first, inverse = np.unique(addresses, return_index=True, return_inverse=True)
    vertices = np.concatenate([chunk.vertices for chunk in chunks])[first]
    return vertices, inverse[faces], np.concatenate([chunk.values for chunk in chunks])[first]


def _without_floaters(
    vertices: np.ndarray, faces: np.ndarray, values: np.ndarray, min_share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if not len(faces):
        return vertices, faces, values
    component = connected_parts(np.concatenate([faces[:, :2], faces[:, 1:]]), len(vertices))[0][faces[:, 0]]
    sizes = np.bincount(component)
    large = sizes >= min(min_share * len(faces), sizes.max())
    used, kept = without_unused(faces[large[component]], len(vertices))
    return vertices[used], kept, values[used]


def marching_cubes(
    field: np.ndarray, cells: np.ndarray, first: tuple[int, int, int] = (0, 0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """Return the zero level of a field: vertices (V, 3) float64 in samples, faces (F, 3) int64.

    field : (l, m, n). cells : (l - 1, m - 1, n - 1) bool, those that give faces. first : coordinates of the first
    sample. Normals are towards positive values, each crossed edge has one vertex. Lorensen and Cline, SIGGRAPH 1987;
    faces of a cell with positive and negative corners across are cut as the bilinear interpolation between them is
    (Nielson and Hamann, Visualization 1991), so that neighbouring cells fit together. Parts of the surface are not
    joined through the inside of a cell.
    """
    positive = field > 0
    used = np.flatnonzero(cells & _corners(positive, np.logical_or) & ~_corners(positive, np.logical_and))
    # Of this, the operating system gives as much memory as is written.
    vertices = np.empty(((len(_EDGES) + 4) * len(used), 3))
    faces = np.empty((_MOST_TRIANGLES * len(used), 3), np.int64)
    vertex_count, face_count = _march(
        np.ascontiguousarray(field), used, np.array(first), _all_contours(), vertices, faces
    )
    return vertices[:vertex_count].copy(), faces[:face_count].copy()


@cache
def _all_contours() -> np.ndarray:
    """Return `_contours` (256, 12) of all cells by their signs, bit c of corner c; ambiguous ones are -2."""
    signs = np.where(np.arange(256)[:, None] >> np.arange(8) & 1, 1.0, -1.0)
    table = np.stack([_contours(corners) for corners in signs])
    faces = signs[:, _FACES]
    table[(np.abs(np.diff(faces, axis=2, append=faces[..., :1])).sum(2) == 8).any(1)] = -2
    return table


@kernel
def _march(
    field: Float32_3d, used: Int64_1d, first: Int64_1d, contours: Int64_2d, vertices: Float64_2d, faces: Int64_2d
) -> tuple[int, int]:
    """Fill in vertices and faces of the used cells, flat numbers in increasing order; return how many there are.

    first : (3,), coordinates of the first sample.
    """
    rows, columns = field.shape[1] - 1, field.shape[2] - 1
    # Numbers of the vertices on edges that begin in this layer of samples or the next, by axis.
    numbers: np.ndarray = np.full((2, rows + 1, columns + 1, 3), -1)
    corners, loop, edges = np.empty(8), np.empty(len(_EDGES), np.int64), np.empty(len(_EDGES), np.int64)
    layer, vertex_count, face_count = -2, 0, 0
    for cell in used:
        i, j, k = cell // (rows * columns), cell // columns % rows, cell % columns
        if i != layer:
            numbers[(i + 1) % 2] = -1
            if i != layer + 1:
                numbers[i % 2] = -1
            layer = i
        signs = 0
        for c in range(8):
            corners[c] = field[i + (c >> 2), j + (c >> 1 & 1), k + (c & 1)]
            signs |= (corners[c] > 0) << c
        following = contours[signs].copy() if contours[signs, 0] > -2 else _contours(corners)
        for beginning in range(len(_EDGES)):
            size, edge = 0, beginning
            while following[edge] >= 0:
                low, high, axis = _EDGES[edge, 0], _EDGES[edge, 1], edge // 4
                a, b, c = i + (low >> 2), j + (low >> 1 & 1), k + (low & 1)
                if numbers[a % 2, b, c, axis] < 0:
                    vertices[vertex_count, 0], vertices[vertex_count, 1] = first[0] + a, first[1] + b
                    vertices[vertex_count, 2] = first[2] + c
                    vertices[vertex_count, axis] += corners[low] / (corners[low] - corners[high])
                    numbers[a % 2, b, c, axis] = vertex_count
                    vertex_count += 1
                loop[size], edges[size] = numbers[a % 2, b, c, axis], edge
                size += 1
                following[edge], edge = -1, following[edge]
            start = _fan_start(vertices, loop, edges, size)
            centre = loop[max(start, 0)]
            if start < 0 and size > 0:
                centre = vertex_count
                for axis in range(3):
                    vertices[centre, axis] = 0.0
                    for n in range(size):
                        vertices[centre, axis] += vertices[loop[n], axis] / size
                vertex_count += 1
            for n in range(size) if start < 0 else range(1, size - 1):
                faces[face_count, 0] = centre
                faces[face_count, 1] = loop[(start + n) % size]
                faces[face_count, 2] = loop[(start + n + 1) % size]
                face_count += 1
    return vertex_count, face_count


@kernel
def _contours(corners: Float64_1d) -> np.ndarray:
    """Return the edge (12,) that follows each around the surface in a cell with these corners (8,); -1: not crossed."""
    following: np.ndarray = np.full(len(_EDGES), -1)
    for face in _FACES:
        exits, entries, count = np.zeros(2, np.int64), np.zeros(2, np.int64), 0
        for n in range(4):
            if corners[face[n]] > 0 and not corners[face[(n + 1) % 4]] > 0:
                last = n + 1
                while not corners[face[(last + 1) % 4]] > 0:
                    last += 1
                exits[count] = _EDGE_OF[face[n], face[(n + 1) % 4]]
                entries[count] = _EDGE_OF[face[last % 4], face[(last + 1) % 4]]
                count += 1
        if count == 2:
            even, odd = corners[face[0]] * corners[face[2]], corners[face[1]] * corners[face[3]]
            # The saddle between them has the sign of the larger product: where negative, negative corners connect.
            if (even < odd) if corners[face[0]] > 0 else (odd < even):
                entries[0], entries[1] = entries[1], entries[0]
        for n in range(count):
            following[exits[n]] = entries[n]
    return following


@inner_kernel
def _fan_start(vertices: np.ndarray, loop: np.ndarray, edges: np.ndarray, size: int) -> int:
    """Return where a contour's fan of triangles begins, so that its diagonals are short; -1: not at any vertex.

    A diagonal in a face of the cell may be one of the neighbouring cell, too: four triangles would share it.
    """
    best, least = -1, np.inf
    for start in range(size if size > 4 else size - 2):
        total = 0.0
        for n in range(2, size - 1):
            end = (start + n) % size
            total += np.inf if _ON_ONE_FACE[edges[start], edges[end]] else 0.0
            for axis in range(3):
                total += (vertices[loop[start], axis] - vertices[loop[end], axis]) ** 2
        if total < least:
            best, least = start, total
    return best
