"""The vertices of the surface as a point cloud, and as the start of a 3D Gaussian splatting.

The Gaussians have the columns that the reference code saves and loads (github.com/graphdeco-inria/gaussian-splatting,
scene/gaussian_model.py, `save_ply`, `load_ply`, degree 3): logarithms of the scales, the logit of the opacity, and the
quaternion with w first. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", TOG 2023.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.apps.export.surfaces import vertex_attributes
from scopemap.engine.errors import InputError
from scopemap.engine.fusion.mesh_files import ply_bytes
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Unit
from scopemap.result.result import Result

_AXES = "axes: OpenCV (x right, y down, z forward)"
_SH_DEGREE_0 = 0.28209479177387814
_HIGHER_COEFFICIENTS = 45  # of degrees 1 to 3, three colours each
_OPACITY = 0.9  # of a surface that was measured; points of structure from motion start at 0.1
_NEIGHBOURS = 3
_LEAST_SCALE = 1e-7
_THICKNESS = 0.1  # across the surface, of the scale along it


def write_points(run: Result, file: Path, unit: Unit) -> None:
    """Write the vertices of the surface with their colours and normals as binary PLY without faces."""
    points, normals, colours = _points_of(run, unit)
    attributes: dict[str, Any] = vertex_attributes(run.mesh, unit) | {
        name: normals[:, column].astype(np.float32) for column, name in enumerate(("nx", "ny", "nz"))
    }
    cloud = trimesh.Trimesh(points, vertex_colors=colours, vertex_attributes=attributes, process=False)
    file.write_bytes(ply_bytes(cloud, [_AXES, f"unit: {unit}", run.scale]))


def write_gaussians(run: Result, file: Path, unit: Unit) -> None:
    """Write a Gaussian at each vertex, a disc on the surface as wide as the distance to its neighbours.

    Its colour is the vertex's from all sides: the coefficients of degrees 1 to 3 are 0.
    """
    points, normals, colours = _points_of(run, unit)
    distances = cKDTree(points).query(points, k=min(_NEIGHBOURS + 1, len(points)))[0].reshape(len(points), -1)[:, 1:]
    along = np.maximum(np.sqrt(np.mean(distances**2, axis=1)) if distances.size else np.ones(1), _LEAST_SCALE)
    columns: dict[str, np.ndarray] = dict(zip("xyz", points.T, strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), normals.T, strict=True))
    columns |= {f"f_dc_{k}": (colours[:, k] / 255 - 0.5) / _SH_DEGREE_0 for k in range(3)}
    columns |= {f"f_rest_{k}": np.zeros(len(points)) for k in range(_HIGHER_COEFFICIENTS)}
    columns["opacity"] = np.full(len(points), np.log(_OPACITY / (1 - _OPACITY)))
    columns |= {f"scale_{k}": np.log(along * (1 if k < 2 else _THICKNESS)) for k in range(3)}
    columns |= dict(zip((f"rot_{k}" for k in range(4)), _from_z_to(normals).T, strict=True))
    table = np.stack(list(columns.values()), axis=-1).astype("<f4")
    head = ["ply", "format binary_little_endian 1.0", f"comment {_AXES}", f"comment unit: {unit}"]
    head += [f"comment {run.scale}", f"element vertex {len(table)}"]
    head += [*(f"property float {name}" for name in columns), "end_header", ""]
    file.write_bytes("\n".join(head).encode() + table.tobytes())


def _points_of(run: Result, unit: Unit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions (V, 3) in a unit, normals (V, 3) and colours (V, 3) uint8 of the vertices."""
    points_mm, colours = np.asarray(run.mesh.vertices, np.float64), vertex_colours(run.mesh)[:, :3]
    if not len(points_mm):
        raise InputError(f"{run.path}: the run has no surface to export")
    return points_mm / MM_PER_UNIT[unit], np.asarray(run.mesh.vertex_normals, np.float64), colours


def _from_z_to(normals: np.ndarray) -> np.ndarray:
    """Return the quaternions (V, 4), w first, of the shortest rotations from the z axis to unit normals (V, 3)."""
    wxyz = np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    # Half a turn about x where the normal is opposite, or none is known.
    wxyz[np.linalg.norm(wxyz, axis=1) < 1e-6] = (0, 1, 0, 0)
    return wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
