"""A mesh as GLB whose colours viser shows as they are, without light, from both sides."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from PIL import Image

from scopemap.engine.fusion.open_glb import (
    WRITTEN_COLOURS,
    WRITTEN_UV,
    OpenGlb,
    texture_bytes,
    with_gltf_names,
)
from scopemap.engine.geometry.srgb import LINEAR, srgb_picture

# The tone mapping of viser's page, three.js' ACESFilmicToneMapping: exposure, matrices, and the curve between them.
_EXPOSURE = 0.6
_ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_ABOVE = (0.0245786, -0.000090537)
_BELOW = (0.983729, 0.4329510, 0.238081)
_BRIGHTEST = 0.97
"""Of the curve, which reaches 1 far out: white is shown by 1 % darker, so that colours between vertices stay right."""
_LARGEST_IN_TEXTURE = 2.0
"""Before the tone mapping, of a texture with 8 bits: level 240 of 255. With more, dark tissue would have few steps."""
_ROWS = 128
"""Of a texture at once: in floating point all of it would take gigabytes."""


def unlit_glb(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> bytes:
    """Return vertices (V, 3), as they are, faces (F, 3) and sRGB colours (V, 3) uint8 as GLB.

    Its material has no light (KHR_materials_unlit). Its colours are those that viser's tone mapping turns into the
    given ones.
    """
    return _glb(vertices, faces, {WRITTEN_COLOURS: before_tone_mapping(LINEAR[colours]).astype(np.float32)})


def unlit_textured_glb(textured: trimesh.Trimesh, jpeg: bytes) -> bytes:
    """Return a surface with a texture as GLB, as `unlit_glb` does; jpeg : its `texture_before_tone_mapping`."""
    visual: Any = textured.visual
    bright = np.full((len(textured.vertices), 3), _LARGEST_IN_TEXTURE, np.float32)
    attributes: dict[str, Any] = {WRITTEN_COLOURS: bright}
    # glTF counts from the upper left.
    attributes[WRITTEN_UV] = (visual.uv * [1, -1] + [0, 1]).astype(np.float32)
    return _glb(textured.vertices, textured.faces, attributes, jpeg)


def texture_before_tone_mapping(picture: np.ndarray) -> bytes:
    """Return a texture (H, W, 3) uint8 as JPEG: what the tone mapping turns into it, over `_LARGEST_IN_TEXTURE`."""
    parts = list[np.ndarray]()
    for first in range(0, len(picture), _ROWS):
        part = picture[first : first + _ROWS]
        shares = before_tone_mapping(LINEAR[part.reshape(-1, 3)]) / _LARGEST_IN_TEXTURE
        parts.append(srgb_picture(np.clip(shares, 0, 1)).reshape(part.shape))
    return texture_bytes(Image.fromarray(np.concatenate(parts)))


def _glb(vertices: np.ndarray, faces: np.ndarray, attributes: dict[str, Any], jpeg: bytes = b"") -> bytes:
    def finish(tree: dict[str, Any]) -> None:
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
        tree["materials"] = [{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}]
        for primitive in tree["meshes"][0]["primitives"]:
            with_gltf_names(primitive)
            primitive["material"] = 0

    mesh = trimesh.Trimesh(vertices, faces, vertex_attributes=attributes, process=False)
    content = trimesh.exchange.gltf.export_glb(mesh.scene(), include_normals=False, tree_postprocessor=finish)
    if not jpeg:
        return bytes(content)
    glb = OpenGlb(content)
    glb.add_texture(jpeg)
    return glb.content


def before_tone_mapping(linear: np.ndarray) -> np.ndarray:
    """Return the linear colours (N, 3) that three.js' filmic tone mapping turns into these, 0..1; some are negative."""
    shown = np.minimum(linear @ np.linalg.inv(_ACES_OUT).T, _BRIGHTEST)
    square = 1 - _BELOW[0] * shown
    once = _ABOVE[0] - _BELOW[1] * shown
    none = _ABOVE[1] - _BELOW[2] * shown
    curve = (-once + np.sqrt(once**2 - 4 * square * none)) / (2 * square)
    return np.asarray(_EXPOSURE * curve @ np.linalg.inv(_ACES_IN).T)
