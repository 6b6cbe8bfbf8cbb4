"""What becomes of the fused mesh: small holes closed, or all; on request smoothed (Taubin), simplified (quadrics)."""

from __future__ import annotations

import fast_simplification
import numpy as np
import trimesh.smoothing
from scipy.spatial import cKDTree

from scopemap.config import FusionSettings
from scopemap.fusion.holes import LARGEST_PERIMETER_VOXELS, without_small_holes
from scopemap.fusion.watertight import watertight
from scopemap.geometry.rendering import vertex_colours

# Taubin, SIGGRAPH 1995: steps that shrink and steps that grow, 1 / 0.5 - 1 / 0.52 = 0.08, hardly change the volume.
_SHRINK, _GROW = 0.5, 0.52


def finished(mesh: trimesh.Trimesh, settings: FusionSettings) -> trimesh.Trimesh:
    """Return the mesh of a fusion as the settings, with the voxel size that was used, want it."""
    if settings.holes == "small" and settings.voxel_mm is not None:
        mesh = without_small_holes(mesh, LARGEST_PERIMETER_VOXELS * settings.voxel_mm)
    elif settings.holes == "watertight" and settings.voxel_mm is not None:
        mesh = watertight(mesh, settings.voxel_mm)
    mesh = smoothed(mesh, settings.mesh_smooth)
    return mesh if settings.mesh_faces is None else simplified(mesh, settings.mesh_faces)


def simplified(mesh: trimesh.Trimesh, most_faces: int) -> trimesh.Trimesh:
    """Return the mesh with at most about so many faces (Garland and Heckbert, SIGGRAPH 1997).

    Colours and vertex attributes, such as `confidence`, are those of the nearest vertex. Borders stay where they are.
    """
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
    border = np.unique(mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)])
    laplacian = trimesh.smoothing.laplacian_calculation(mesh, pinned_vertices=border)
    return trimesh.smoothing.filter_taubin(mesh.copy(), _SHRINK, _GROW, 2 * iterations, laplacian)
