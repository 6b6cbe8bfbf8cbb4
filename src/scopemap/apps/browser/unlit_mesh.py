"""A mesh as GLB whose colours viser shows as they are, without light, from both sides."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from scopemap.engine.geometry.srgb import LINEAR

# glTF 2.0, sections 3.6.2.2, 3.7.2.1 and 4.4.3
_FLOAT = 5126
_UINT32 = 5125
_VERTICES = 34962
_INDICES = 34963
_JSON = 0x4E4F534A
_BIN = 0x004E4942
# The tone mapping of viser's page, three.js' ACESFilmicToneMapping: exposure, matrices, and the curve between them.
_EXPOSURE = 0.6
_ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_ABOVE = (0.0245786, -0.000090537)
_BELOW = (0.983729, 0.4329510, 0.238081)
_BRIGHTEST = 0.97
"""Of the curve, which reaches 1 far out: white is shown by 1 % darker, so that colours between vertices stay right."""


def unlit_glb(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> bytes:
    """Return vertices (V, 3), as they are, faces (F, 3) and sRGB colours (V, 3) uint8 as GLB.

    Its material has no light (KHR_materials_unlit). Its colours are those that viser's tone mapping turns into the
    given ones.
    """
    positions = np.ascontiguousarray(vertices, "<f4")
    rgb = np.ascontiguousarray(before_tone_mapping(LINEAR[colours]), "<f4")
    parts: list[tuple[np.ndarray, int, dict[str, Any]]] = [
        (positions, _VERTICES, {"componentType": _FLOAT, "type": "VEC3"} | _limits(positions)),
        (rgb, _VERTICES, {"componentType": _FLOAT, "type": "VEC3"}),
        (np.ascontiguousarray(faces, "<u4").ravel(), _INDICES, {"componentType": _UINT32, "type": "SCALAR"}),
    ]
    views, accessors, binary = [], [], b""
    for number, (values, target, about) in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes, "target": target})
        accessors.append({"bufferView": number, "count": len(values)} | about)
        binary += values.tobytes()
    material = {"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    tree = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(tree).encode()
    chunks = ((text + b" " * (-len(text) % 4), _JSON), (binary + b"\0" * (-len(binary) % 4), _BIN))
    body = b"".join(struct.pack("<II", len(content), kind) + content for content, kind in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def before_tone_mapping(linear: np.ndarray) -> np.ndarray:
    """Return the linear colours (N, 3) that three.js' filmic tone mapping turns into these, 0..1; some are negative."""
    shown = np.minimum(linear @ np.linalg.inv(_ACES_OUT).T, _BRIGHTEST)
    square = 1 - _BELOW[0] * shown
    once = _ABOVE[0] - _BELOW[1] * shown
    none = _ABOVE[1] - _BELOW[2] * shown
    curve = (-once + np.sqrt(once**2 - 4 * square * none)) / (2 * square)
    return np.asarray(_EXPOSURE * curve @ np.linalg.inv(_ACES_IN).T)


def _limits(positions: np.ndarray) -> dict[str, list[float]]:
    return {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
