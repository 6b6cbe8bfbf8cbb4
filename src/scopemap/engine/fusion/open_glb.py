"""What trimesh cannot write into a GLB: textures as JPEG, animations, colours of more than 8 bits."""

from __future__ import annotations

import io
import json
import struct
from typing import Any

import numpy as np
import trimesh
from PIL import Image

# trimesh writes colours with 8 bits, but any attribute as it is, with an underscore before its name.
WRITTEN_COLOURS = "_COLOR_0"
WRITTEN_UV = "_TEXCOORD_0"
_FLOAT = 5126  # glTF 2.0, sections 3.6.2.2 and 4.4.3
_JSON = 0x4E4F534A  # glTF 2.0, section 4.4.3: "JSON"
_BIN = 0x004E4942  # glTF 2.0, section 4.4.3: "BIN"
_LINEAR = 9729  # glTF 2.0, section 5.26
_LINEAR_MIPMAPS = 9987  # the same
_CLAMPED = 33071  # the same
# Vessels are red on red: at full resolution of the colours. The quality by hand, that of the frame store less what it
# needs to be opened again.
_TEXTURE_QUALITY = {"quality": 92, "subsampling": 0}


def texture_picture(textured: trimesh.Trimesh) -> np.ndarray:
    """Return the texture of a surface, (H, W, 3) uint8 sRGB."""
    visual: Any = textured.visual
    return np.asarray(visual.material.image)[..., :3]


def texture_bytes(picture: Image.Image) -> bytes:
    """Return a texture as JPEG."""
    content = io.BytesIO()
    # Of 4096x4096 px a copy would take 67 MB.
    (picture if picture.mode == "RGB" else picture.convert("RGB")).save(content, "JPEG", **_TEXTURE_QUALITY)
    return content.getvalue()


def with_gltf_names(primitive: dict[str, Any]) -> dict[str, int]:
    """Return the attributes of a part of a mesh that trimesh wrote, after it got the names that glTF 2.0 has."""
    attributes: dict[str, int] = primitive["attributes"]
    for name in {WRITTEN_COLOURS, WRITTEN_UV} & set(attributes):
        attributes[name[1:]] = attributes.pop(name)
    return attributes


class OpenGlb:
    """A GLB whose JSON can be changed, and to which arrays can be added."""

    def __init__(self, glb: bytes) -> None:
        (length,) = struct.unpack_from("<I", glb, 12)
        self.tree, self._binary = json.loads(glb[20 : 20 + length]), bytearray(glb[28 + length :])

    @property
    def mesh_nodes(self) -> list[int]:
        """The nodes with a mesh, by the numbers of their meshes."""
        nodes = [(node["mesh"], number) for number, node in enumerate(self.tree["nodes"]) if "mesh" in node]
        return [number for _, number in sorted(nodes)]

    def view(self, content: bytes) -> int:
        """Add bytes, and return the number of their buffer view."""
        self._binary.extend(b"\0" * (-len(self._binary) % 4))
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": len(content)}
        self.tree["bufferViews"].append(view)
        self._binary.extend(content)
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, kind: str) -> int:
        """Add values and return their number."""
        content = np.ascontiguousarray(values, "<f4")
        rows = content.reshape(len(content), -1)
        limits = {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        about = {"bufferView": self.view(content.tobytes()), "componentType": _FLOAT, "count": len(content)}
        self.tree["accessors"].append(about | {"type": kind} | limits)
        return len(self.tree["accessors"]) - 1

    def sampler(self, times_s: np.ndarray, values: np.ndarray, kind: str) -> dict[str, Any]:
        """Add the values (F, ...) of an animation at times (F,), s."""
        return {"input": self.accessor(times_s, "SCALAR"), "output": self.accessor(values, kind)}

    def add_texture(self, jpeg: bytes) -> None:
        """Give the first material a picture as its colour, which a viewer may show smaller."""
        filters = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS, "wrapS": _CLAMPED, "wrapT": _CLAMPED}
        self.tree["images"] = [{"bufferView": self.view(jpeg), "mimeType": "image/jpeg"}]
        self.tree["samplers"] = [filters]
        self.tree["textures"] = [{"source": 0, "sampler": 0}]
        self.tree["materials"][0].setdefault("pbrMetallicRoughness", {})["baseColorTexture"] = {"index": 0}

    @property
    def content(self) -> bytes:
        """The file."""
        self.tree["buffers"][0]["byteLength"] = len(self._binary)
        text = json.dumps(self.tree).encode()
        self._binary.extend(b"\0" * (-len(self._binary) % 4))
        chunks = ((text + b" " * (-len(text) % 4), _JSON), (bytes(self._binary), _BIN))
        body = b"".join(struct.pack("<II", len(part), kind) + part for part, kind in chunks)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
