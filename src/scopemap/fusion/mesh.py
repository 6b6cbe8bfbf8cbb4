"""The mesh: marching cubes on the distance field, chunk by chunk, welded, without floaters.

A chunk is 64^3 cells, so it needs one sample more on each side, which it shares with its neighbour; a vertex is on a
grid edge, and the edge's address welds the chunks exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from scopemap.config.mapping import FusionAdvanced
from scopemap.fusion.albedo import displayed
from scopemap.fusion.tsdf import BLOCK, VoxelBlocks, Voxels, unpack

_CHUNK_BLOCKS = 8
_CHUNK = _CHUNK_BLOCKS * BLOCK
# Keeps every vertex off the grid corners, where its edge would be ambiguous.
_SMALLEST_DISTANCE_VOXELS = 1e-3
# A cell's diagonal is sqrt(3) voxels, and a distance changes by no more than the step: twice that is a depth edge, not
# a surface. Without the limit, walls of the truncation's depth would grow behind every fold's silhouette.
_LARGEST_SPREAD_VOXELS = 3.5
_UNSEEN_GREY = 128.0
# Weight of a vertex whose confidence is 1 - 1/e: a frontal look from near weighs 1.
_CONFIDENT_WEIGHT = 1.5


@dataclass(frozen=True)
class _Chunk:
    """Mesh of a chunk: vertices (V, 3) in voxels, edge addresses (V, 3), values (V, 4), faces (F, 3).

    values : colour, 0..255, and confidence, 0..1.
    """

    vertices: np.ndarray
    edges: np.ndarray
    values: np.ndarray
    faces: np.ndarray


def extract_mesh(
    blocks: VoxelBlocks, settings: FusionAdvanced, voxel_mm: float, median_level: float | None = None
) -> trimesh.Trimesh:
    """Return the zero level of the field as a mesh in world mm, its normals towards free space, with vertex colours.

    Only cells whose 8 corners all weigh at least `min_weight` give faces: unseen space stays a hole, and so does the
    space that a fold hides behind its silhouette. Components with
    less than `min_component_share` of the faces are dropped, the largest never. No surface: a mesh without vertices.
    `vertex_attributes["confidence"]`: (V,) float32, 0..1, 1 - exp(-weight / 1.5): rises with the number of frames that
    saw a vertex, and falls with their distance, obliqueness and uncertainty; the latter beside the median of its
    frame: a frame that is uncertain everywhere counts like any other.

    median_level : median grey level, 0..255, that the colours are scaled to; None: they stay as they are.
    """
    corners = np.unique(unpack(blocks.keys()) // _CHUNK_BLOCKS, axis=0)
    chunks = [_extract_chunk(blocks, corner * _CHUNK_BLOCKS, voxel_mm, settings.min_weight) for corner in corners]
    mesh = _weld([chunk for chunk in chunks if chunk is not None])
    vertices, faces, values = _without_floaters(*mesh, settings.min_component_share)
    shown = np.round(displayed(values[:, :3], median_level)).astype(np.uint8)
    confidence: dict[str, Any] = {"confidence": values[:, 3].astype(np.float32)}
    return trimesh.Trimesh(vertices * voxel_mm, faces, vertex_colors=shown, vertex_attributes=confidence, process=False)


def _extract_chunk(blocks: VoxelBlocks, corner: np.ndarray, voxel_mm: float, min_weight: float) -> _Chunk | None:
    samples = Voxels(*(array[(slice(_CHUNK + 1),) * 3] for array in blocks.dense(corner, _CHUNK_BLOCKS + 1)))
    smallest = _SMALLEST_DISTANCE_VOXELS * voxel_mm
    tsdf = np.where(np.abs(samples.tsdf) < smallest, np.copysign(np.float32(smallest), samples.tsdf), samples.tsdf)
    known = samples.weight >= max(min_weight, np.finfo(np.float32).tiny)
    cells = _crossed_cells(tsdf, known, _LARGEST_SPREAD_VOXELS * voxel_mm)
    if not cells.any():
        return None
    # scikit-image reads the mask of a cell at the cell's last corner.
    mask = np.pad(cells, ((1, 0), (1, 0), (1, 0)))
    local, faces, _, _ = marching_cubes(tsdf, 0.0, mask=mask, gradient_direction="descent")
    low, high = np.floor(local).astype(np.int64), np.ceil(local).astype(np.int64)
    offset = corner * BLOCK
    return _Chunk(local + offset.astype(np.float64), low + high + 2 * offset, _values(samples, local, low, high), faces)


def _crossed_cells(tsdf: np.ndarray, known: np.ndarray, largest_spread_mm: float) -> np.ndarray:
    """(n-1)^3 bool: all 8 corners known, on both sides of the surface, and not on both sides of a depth edge."""
    low, high = _corners(tsdf, np.minimum), _corners(tsdf, np.maximum)
    return _corners(known, np.logical_and) & (low < 0) & (high > 0) & (high - low <= largest_spread_mm)


def _corners(samples: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Combine the 8 corners of every cell of (n, n, n) samples, one axis after the other."""
    samples = combine(samples[1:], samples[:-1])
    samples = combine(samples[:, 1:], samples[:, :-1])
    return combine(samples[:, :, 1:], samples[:, :, :-1])


def _values(samples: Voxels, vertices: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Mix the two ends of each vertex's grid edge: colour, an end counting by how well seen it is, and confidence."""
    share = (vertices - low).max(axis=1, keepdims=True)
    ends = tuple(low.T), tuple(high.T)
    total = (1 - share) * samples.colour[ends[0]] + share * samples.colour[ends[1]]
    weight = (1 - share) * samples.weight[ends[0]][:, None] + share * samples.weight[ends[1]][:, None]
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
    links = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    graph = coo_matrix((np.ones(links.shape[1], bool), links), shape=(len(vertices), len(vertices)))
    component = connected_components(graph, directed=False)[1][faces[:, 0]]
    sizes = np.bincount(component)
    large = sizes >= min(min_share * len(faces), sizes.max())
    used, renumbered = np.unique(faces[large[component]], return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3), values[used]
