"""Mesh files: PLY and GLB, with normals, colours or a texture, and confidence; GLB with surfaces in time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.errors import reporting
from scopemap.engine.fusion.open_glb import (
    WRITTEN_COLOURS,
    WRITTEN_UV,
    OpenGlb,
    texture_bytes,
    with_gltf_names,
)
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.engine.geometry.srgb import LINEAR

# glTF is y-up and looks along -z, in metres; the world is y-down and looks along +z, in mm.
T_GLTF_WORLD = np.diag([1e-3, -1e-3, -1e-3, 1.0])
_PLY_AXES = "unit: mm; axes: OpenCV (x right, y down, z forward)"


def save_mesh(
    mesh: trimesh.Trimesh,
    ply_file: Path | None = None,
    glb_file: Path | None = None,
    *,
    comment: str = "",
    textured: trimesh.Trimesh | None = None,
) -> None:
    """Write a mesh with vertex colours, world mm, as binary PLY and as GLB.

    The PLY keeps the world of trajectory.tum: mm, OpenCV axes (y down, z forward); vertex attributes such as
    `confidence` are properties there. The GLB has metres, y up: 0.001 of the trajectory's unit with y and z negated. It
    is matt and visible from both sides, its colours are linear with 16 bits (glTF 2.0, section 3.7.2.1): 8 bits would
    hold dark sRGB levels 0 to 12 in two steps. Both have vertex normals. A mesh without faces gives no GLB. The unit,
    the axes and `comment` are comments in the PLY and `asset.extras` in the GLB. textured : the same triangles with a
    texture, which the GLB has instead of vertex colours, as JPEG inside.
    """
    if ply_file is not None:
        ply_file.write_bytes(ply_bytes(mesh, [_PLY_AXES, comment]))
    if glb_file is not None and len(mesh.faces):
        glb_file.write_bytes(_glb([mesh], comment) if textured is None else _textured_glb(textured, comment))


def read_mesh(file: Path) -> trimesh.Trimesh:
    """Return the surface in a PLY file with its vertices' attributes; empty where there is no file or no face.

    Raises `InputError` where it is damaged.
    """
    if not file.is_file():
        return trimesh.Trimesh()
    with reporting(f"cannot read {file}"):
        mesh = trimesh.load(file, process=False)
        if not isinstance(mesh, trimesh.Trimesh):
            return trimesh.Trimesh()
        # trimesh leaves properties that it does not know in the raw table.
        vertices = mesh.metadata["_ply_raw"]["vertex"]["data"]
        for name in sorted({"confidence", "moving", "sigma_mm"} & set(vertices.dtype.names)):
            mesh.vertex_attributes[name] = np.array(vertices[name])
        if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError("it is damaged: a face has a vertex that is not there")
        if not np.isfinite(mesh.vertices).all():
            raise ValueError("it is damaged: a vertex is nowhere")
    return mesh


def read_textured(file: Path) -> trimesh.Trimesh | None:
    """Return the surface with a texture that `save_mesh` wrote as GLB, world mm; None where there is none.

    Raises `InputError` where it is damaged.
    """
    if not file.is_file():
        return None
    with reporting(f"cannot read {file}"):
        content = file.read_bytes()
        if not OpenGlb(content).tree.get("images"):
            return None
        # As one mesh trimesh would copy the texture, three times the picture's memory.
        scene: Any = trimesh.load_scene(io.BytesIO(content), file_type="glb", process=False)
        (mesh,) = scene.geometry.values()
        material = trimesh.visual.material.SimpleMaterial(image=mesh.visual.material.baseColorTexture)
        return trimesh.Trimesh(
            mesh.vertices @ np.linalg.inv(T_GLTF_WORLD)[:3, :3].T,
            mesh.faces,
            vertex_normals=mesh.vertex_normals @ np.sign(T_GLTF_WORLD[:3, :3]),
            visual=trimesh.visual.TextureVisuals(uv=mesh.visual.uv, material=material),
            process=False,
        )


def texture_jpeg(textured: trimesh.Trimesh) -> bytes:
    """Return the texture of a surface as JPEG."""
    visual: Any = textured.visual
    return texture_bytes(visual.material.image)


def save_meshes_in_time(
    meshes: Sequence[trimesh.Trimesh], starts_s: Sequence[float], glb_file: Path, *, comment: str = ""
) -> None:
    """Write meshes as GLB, each of which shows from its start, s, until that of the next one; otherwise as `save_mesh`.

    An animation scales the others to a point (glTF 2.0, section 3.11). Meshes without faces are left out.
    """
    shown = [(mesh, start) for mesh, start in zip(meshes, starts_s, strict=True) if len(mesh.faces)]
    if not shown:
        return
    glb = OpenGlb(_glb([mesh for mesh, _ in shown], comment))
    times_s = np.array([start for _, start in shown]) - shown[0][1]
    samplers, channels = [], []
    for number, node in enumerate(glb.mesh_nodes):
        scale = np.repeat(np.where(np.arange(len(shown)) == number, 1.0, 0.0)[:, None], 3, axis=1)
        samplers.append(glb.sampler(times_s, scale, "VEC3") | {"interpolation": "STEP"})
        channels.append({"sampler": number, "target": {"node": node, "path": "scale"}})
    glb.tree["animations"] = [{"name": "segments", "samplers": samplers, "channels": channels}]
    glb_file.write_bytes(glb.content)


def ply_bytes(mesh: trimesh.Trimesh, comments: list[str]) -> bytes:
    """Return a mesh, or its vertices where it has no faces, as binary PLY with these comments but empty ones."""
    content = trimesh.exchange.ply.export_ply(mesh, encoding="binary", vertex_normal=bool(len(mesh.faces)))
    head, end, rest = content.partition(b"\nelement vertex")
    for line in comments:
        head += f"\ncomment {line}".encode() if line else b""
    return head + end + rest


def _textured_glb(textured: trimesh.Trimesh, comment: str) -> bytes:
    """Return a surface with a texture as GLB; the texture is the colour, so it is shown as it is where a viewer can."""
    glb = OpenGlb(_glb([textured], comment))
    glb.add_texture(texture_jpeg(textured))
    return glb.content


def _glb(meshes: Sequence[trimesh.Trimesh], comment: str) -> bytes:
    R = T_GLTF_WORLD[:3, :3]
    scene = trimesh.Scene()
    for mesh in meshes:
        rotated = trimesh.Trimesh(
            mesh.vertices @ R.T,
            mesh.faces,
            vertex_normals=mesh.vertex_normals @ np.sign(R),
            vertex_attributes=_written_visual(mesh),
            process=False,
        )
        scene.add_geometry(rotated)

    def finish(tree: dict[str, Any]) -> None:
        # Without a material viewers show metal.
        matt = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
        tree["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": matt}]
        tree["asset"]["extras"] = {"unit": "m", "axes": "y up", "comment": comment}
        for primitive in (primitive for part in tree["meshes"] for primitive in part["primitives"]):
            primitive["material"] = 0
            attributes = with_gltf_names(primitive)
            if "COLOR_0" in attributes:
                tree["accessors"][attributes["COLOR_0"]]["normalized"] = True

    return trimesh.exchange.gltf.export_glb(scene, include_normals=True, tree_postprocessor=finish)


def _written_visual(mesh: trimesh.Trimesh) -> dict[str, Any]:
    """Return the colours of a mesh's vertices, or where they are in its texture, as trimesh writes attributes."""
    if isinstance(mesh.visual, trimesh.visual.TextureVisuals):
        # glTF counts from the upper left.
        return {WRITTEN_UV: (mesh.visual.uv * [1, -1] + [0, 1]).astype(np.float32)}
    return {WRITTEN_COLOURS: _linear_16_bit(vertex_colours(mesh)[:, :3])}


def _linear_16_bit(srgb: np.ndarray) -> np.ndarray:
    """Return (V, 4) uint16 linear colours, opaque, 65535 = 1, of (V, 3) uint8 sRGB colours."""
    rgba = np.full((len(srgb), 4), 65535, np.uint16)
    rgba[:, :3] = np.round(65535 * LINEAR).astype(np.uint16)[srgb]
    return rgba
