"""Mesh files: PLY as it is in the world, GLB as glTF viewers expect it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

# glTF is y-up and looks along -z, in metres; the world is y-down and looks along +z, in mm.
T_GLTF_WORLD = np.diag([1e-3, -1e-3, -1e-3, 1.0])


def save_mesh(mesh: trimesh.Trimesh, ply_file: Path | None = None, glb_file: Path | None = None) -> list[Path]:
    """Write a mesh with vertex colours, world mm, as binary PLY and as GLB; return the files written.

    The GLB is in metres and y-up, matt and visible from both sides, because a lumen is looked at from inside and
    outside; its colours are linear as glTF asks (section 3.7.2.1). A mesh without faces gives no GLB.
    """
    written: list[Path] = []
    if ply_file is not None:
        Path(ply_file).write_bytes(trimesh.exchange.ply.export_ply(mesh, encoding="binary"))
        written.append(Path(ply_file))
    if glb_file is not None and len(mesh.faces):
        Path(glb_file).write_bytes(_glb(mesh))
        written.append(Path(glb_file))
    return written


def _glb(mesh: trimesh.Trimesh) -> bytes:
    visual = mesh.visual
    if not isinstance(visual, trimesh.visual.ColorVisuals):
        raise ValueError("writing a GLB: the mesh has a texture; give it vertex colours")
    srgb = np.asarray(visual.vertex_colors)[:, :3] / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    turned = trimesh.Trimesh(
        mesh.vertices @ T_GLTF_WORLD[:3, :3].T,
        mesh.faces,
        vertex_colors=np.round(255 * linear).astype(np.uint8),
        process=False,
    )
    return trimesh.exchange.gltf.export_glb(trimesh.Scene(turned), tree_postprocessor=_matt)


def _matt(tree: dict[str, Any]) -> None:
    """Give all meshes of a glTF tree a matt material seen from both sides; without one viewers show metal."""
    tree["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9}}]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
