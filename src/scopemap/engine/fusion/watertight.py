"""A watertight mesh: the surface that was seen stays in place, and what no frame saw is closed smoothly.

On a grid around the mesh the signed distance is known near its vertices; the Laplace equation continues it, negative at
the grid's border (the volumetric diffusion of Davis et al., 3DPVT 2002, to its end). Its zero level encloses the free
space in front of the surface where that surrounds it, as in a colon; else the tissue behind it, so that the front stays
in view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numba import prange
from scipy import ndimage
from scipy.spatial import cKDTree

from scopemap.engine.fusion.mesh import marching_cubes
from scopemap.engine.geometry.kernels import Bool_3d, Float32_3d, kernel
from scopemap.engine.geometry.rendering import vertex_colours

_MOST_CELLS = 160  # by hand: along the longest side of the mesh
_MARGIN_CELLS = 10  # by hand: of the grid around the mesh
# The distance is known so far from the surface, in cells, and is the mean over the planes of so many vertices.
_BAND_CELLS = 2  # by hand
_PLANES = 4  # by hand
SEEN_CELLS = 1.5  # by hand: vertices farther from the mesh than this were not seen
_LEVELS = (8, 4, 2, 1)  # by hand: cell sizes over the finest; each level starts from the one before
_SWEEPS = 40  # by hand: of each level
_OVER_RELAXATION = 1.7  # by hand, below 2, where successive over-relaxation converges (Young 1954)
# Length of the mean normal above which a surface faces one way: that of a cavity as deep as its radius.
_ONE_WAY = 1 / 3  # by hand
_SMALLEST_CELLS = 1e-3  # no vertex on a grid corner, where its edge would be ambiguous
_UNSEEN_GREY = 128  # by hand: colour of what no frame saw


@dataclass(frozen=True)
class ClosedSpace:
    """The space that a surface encloses, in a grid of cells.

    field : (l, m, n) float64, positive inside, about the distance to the surface in cells near it. corner_mm : (3,),
    world, the grid's. tissue : whether the tissue behind the surface is inside; else the free space in front of it.
    """

    field: np.ndarray
    corner_mm: np.ndarray
    cell_mm: float
    tissue: bool

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (V, 3), world mm, and faces (F, 3), whose normals point to the free space."""
        vertices, faces = marching_cubes(self.field, np.ones(np.array(self.field.shape) - 1, bool))
        return self.corner_mm + (vertices + 0.5) * self.cell_mm, faces[:, :: -1 if self.tissue else 1]


def watertight(mesh: trimesh.Trimesh, voxel_mm: float) -> trimesh.Trimesh:
    """Return a closed mesh around the free space in front of a mesh, or around the tissue behind; normals stay.

    Cells are voxels, or larger where more than 160 would be along a side. Vertices that no frame saw are grey, and 0 in
    all vertex attributes, such as `confidence`; the others have colour and attributes of the mesh's nearest vertex.
    """
    if not len(mesh.faces):
        return mesh
    space = closed_space(mesh, voxel_mm)
    vertices, faces = space.surface()
    distance_mm, nearest = cKDTree(mesh.vertices).query(vertices)
    seen = distance_mm <= SEEN_CELLS * space.cell_mm
    colours = vertex_colours(mesh)[nearest]
    colours[~seen, :3] = _UNSEEN_GREY
    attributes = {name: np.asarray(values)[nearest].copy() for name, values in mesh.vertex_attributes.items()}
    for values in attributes.values():
        values[~seen] = 0
    return trimesh.Trimesh(vertices, faces, vertex_colors=colours, vertex_attributes=attributes, process=False)


def closed_space(mesh: trimesh.Trimesh, voxel_mm: float) -> ClosedSpace:
    """Return the space that the surface of a mesh with faces encloses, once it is closed; cells as in `watertight`."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    cell_mm = max(voxel_mm, float((high - low).max()) / _MOST_CELLS)
    coarse = np.ceil(((high - low) / cell_mm + 2 * _MARGIN_CELLS) / _LEVELS[0]).astype(int)
    corner = (low + high - _LEVELS[0] * cell_mm * coarse) / 2
    facing = np.linalg.norm(mesh.area_faces @ mesh.face_normals) / max(float(mesh.area), 1e-12)
    side = -1 if facing > _ONE_WAY else 1
    planes, tree = (np.asarray(mesh.vertices), side * np.asarray(mesh.vertex_normals)), cKDTree(mesh.vertices)
    field = np.full(coarse, -float(_BAND_CELLS))
    for level in _LEVELS:
        if level != _LEVELS[0]:
            field = field.repeat(2, 0).repeat(2, 1).repeat(2, 2)
        fixed = _set_distances(field, planes, tree, corner, level * cell_mm)
        _relax(field, fixed, _SWEEPS)
    field = _one_space(np.where(np.abs(field) < _SMALLEST_CELLS, np.copysign(_SMALLEST_CELLS, field), field))
    return ClosedSpace(field, corner, cell_mm, side < 0)


def _set_distances(
    field: np.ndarray, planes: tuple[np.ndarray, np.ndarray], tree: cKDTree, corner: np.ndarray, cell_mm: float
) -> np.ndarray:
    """Set cells near the surface to their signed distance, in cells; return which are set, with the grid's border."""
    vertices, normals = planes
    near = np.zeros(field.shape, bool)
    near[tuple(((vertices - corner) / cell_mm).astype(int).T)] = True
    near = ndimage.binary_dilation(near, iterations=_BAND_CELLS)
    points = corner + (np.argwhere(near) + 0.5) * cell_mm
    index = tree.query(points, k=min(_PLANES, len(vertices)))[1].reshape(len(points), -1)
    distance = np.einsum("nkc,nkc->nk", points[:, None] - vertices[index], normals[index]).mean(axis=1)
    field[near] = np.clip(distance / cell_mm, -_BAND_CELLS, _BAND_CELLS)
    for axis in range(3):
        for side in (0, -1):
            border = np.moveaxis(field, axis, 0), np.moveaxis(near, axis, 0)
            border[0][side], border[1][side] = -_BAND_CELLS, True
    return near


@kernel(parallel=True)  # type: ignore[untyped-decorator]
def _relax(field: Float32_3d, fixed: Bool_3d, sweeps: int) -> None:
    """Solve the Laplace equation where the field (l, m, n) is not fixed: successive over-relaxation, red and black."""
    for half in range(2 * sweeps):
        for i in prange(1, field.shape[0] - 1):
            for j in range(1, field.shape[1] - 1):
                for k in range(1 + (i + j + half) % 2, field.shape[2] - 1, 2):
                    if not fixed[i, j, k]:
                        total = field[i - 1, j, k] + field[i + 1, j, k] + field[i, j - 1, k]
                        total += field[i, j + 1, k] + field[i, j, k - 1] + field[i, j, k + 1]
                        field[i, j, k] += _OVER_RELAXATION * (total / 6 - field[i, j, k])


def _one_space(field: np.ndarray) -> np.ndarray:
    """Return the field with the largest positive region alone, and without negative bubbles in it."""
    regions = ndimage.label(field > 0)[0]
    sizes = np.bincount(regions.ravel())
    sizes[0] = 0
    outside = ndimage.label(regions != np.argmax(sizes))[0]
    inside = outside != outside[0, 0, 0]
    return np.where(inside, np.abs(field), -np.abs(field))
