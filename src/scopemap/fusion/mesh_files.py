"""Mesh files: PLY and GLB, with normals, colours and the confidence of each vertex."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.geometry.rendering import vertex_colours

# glTF is y-up and looks along -z, in metres; the world is y-down and looks along +z, in mm.
T_GLTF_WORLD = np.diag([1e-3, -1e-3, -1e-3, 1.0])
# trimesh writes colours with 8 bits, but any attribute as it is, with an underscore before its name.
_PLY_AXES = "unit: mm; axes: OpenCV (x right, y down, z forward)"
_WRITTEN_COLOURS = "_COLOR_0"


def save_mesh(
    mesh: trimesh.Trimesh, ply_file: Path | None = None, glb_file: Path | None = None, *, comment: str = ""
) -> None:
    """Write a mesh with vertex colours, world mm, as binary PLY and as GLB.

    The PLY keeps the world of trajectory.tum: mm, OpenCV axes (y down, z forward); vertex attributes such as
    `confidence` are properties there. The GLB has metres, y up: 0.001 of the trajectory's unit with y and z negated. It
    is matt and visible from both sides, its colours are linear with 16 bits (glTF 2.0, section 3.7.2.1): 8 bits would
    hold dark sRGB levels 0 to 12 in two steps. Both have vertex normals. A mesh without faces gives no GLB. The unit,
    the axes and `comment` are comments in the PLY and `asset.extras` in the GLB.
    """
    if ply_file is not None:
        ply_file.write_bytes(ply_bytes(mesh, [_PLY_AXES, comment]))
    if glb_file is not None and len(mesh.faces):
        glb_file.write_bytes(_glb(mesh, comment))


def ply_bytes(mesh: trimesh.Trimesh, comments: list[str]) -> bytes:
    """Return a mesh, or its vertices where it has no faces, as binary PLY with these comments but empty ones."""
    content = trimesh.exchange.ply.export_ply(mesh, encoding="binary", vertex_normal=bool(len(mesh.faces)))
    head, end, rest = content.partition(b"\nelement vertex")
    for line in comments:
        head += f"\ncomment {line}".encode() if line else b""
    return head + end + rest


def _glb(mesh: trimesh.Trimesh, comment: str) -> bytes:
    R = T_GLTF_WORLD[:3, :3]
    rotated = trimesh.Trimesh(
        mesh.vertices @ R.T,
        mesh.faces,
        vertex_normals=mesh.vertex_normals @ np.sign(R),
        vertex_attributes={_WRITTEN_COLOURS: _linear_16_bit(vertex_colours(mesh)[:, :3])},
        process=False,
    )

    def finish(tree: dict[str, Any]) -> None:
        # Without a material viewers show metal.
        matt = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
        tree["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": matt}]
        tree["asset"]["extras"] = {"unit": "m", "axes": "y up", "comment": comment}
        for primitive in (primitive for part in tree["meshes"] for primitive in part["primitives"]):
            primitive["material"] = 0
            colours = primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop(_WRITTEN_COLOURS)
            tree["accessors"][colours]["normalized"] = True

    return trimesh.exchange.gltf.export_glb(trimesh.Scene(rotated), include_normals=True, tree_postprocessor=finish)


def _linear_16_bit(srgb: np.ndarray) -> np.ndarray:
    """Return (V, 4) uint16 linear colours, opaque, 65535 = 1, of (V, 3) uint8 sRGB colours (IEC 61966-2-1)."""
    level = np.arange(256) / 255.0
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    rgba = np.full((len(srgb), 4), 65535, np.uint16)
    rgba[:, :3] = np.round(65535 * linear).astype(np.uint16)[srgb]
    return rgba
