"""A mesh as GLB whose colours are shown as they are, without light, from both sides."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from scopemap.engine.geometry.srgb import LINEAR

# glTF 2.0, sections 3.6.2.2, 3.7.2.1 and 4.4.3
_FLOAT = 5126
_UINT16 = 5123
_UINT32 = 5125
_VERTICES = 34962
_INDICES = 34963
_JSON = 0x4E4F534A
_BIN = 0x004E4942


def unlit_glb(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> bytes:
    """Return vertices (V, 3), as they are, faces (F, 3) and sRGB colours (V, 3) uint8 as GLB.

    Its material has no light (KHR_materials_unlit). Colours are linear with 16 bits, as glTF wants them.
    """
    rgba = np.full((len(colours), 4), 65535, "<u2")
    rgba[:, :3] = np.round(65535 * LINEAR).astype("<u2")[colours]
    positions = np.ascontiguousarray(vertices, "<f4")
    parts: list[tuple[np.ndarray, int, dict[str, Any]]] = [
        (positions, _VERTICES, {"componentType": _FLOAT, "type": "VEC3"} | _limits(positions)),
        (rgba, _VERTICES, {"componentType": _UINT16, "type": "VEC4", "normalized": True}),
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


def _limits(positions: np.ndarray) -> dict[str, list[float]]:
    return {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
