"""A run's mesh as the page shows it: few faces, numbers of few bits, and how often each vertex was seen."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.fusion.mesh_files import texture_jpeg
from scopemap.engine.fusion.open_glb import texture_picture
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.engine.geometry.se3 import inverse
from scopemap.result.result import Result

MOST_FACES = 100_000
"""Of the result's main surface: what browsers turn without jerks (by hand)."""
FACES_OF_OTHERS = 20_000
_SAME_SURFACE = 0.1
_CELLS_PER_FACE = 2.5  # faces of a surface that crosses a grid, times a cell's area, over its area
_SHIFT = 4  # bits of a pixel
_BLUR_PX = 3
_LARGEST_LEVEL = 65535
"""Of a position, in 16 bits."""


@dataclass(frozen=True)
class SeenFrame:
    """A frame that looks at a mesh: its pose (4, 4), world mm, and its depth (h, w), mm, NaN = unknown, any size."""

    T_world_camera: np.ndarray
    depth_mm: np.ndarray


def base64_of(values: np.ndarray, dtype: str) -> str:
    """Return an array as base64 of its little-endian numbers."""
    return b64encode(np.ascontiguousarray(values, np.dtype(dtype).newbyteorder("<")).tobytes()).decode()


def simplified(mesh: trimesh.Trimesh, most_faces: int) -> trimesh.Trimesh:
    """Return a mesh with at most so many faces: vertices in one cell of a grid become their mean, with its colour.

    A twentieth of the time of quadric edge collapses, and colours are means, not those of single vertices (Rossignac
    and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993). Attributes are means, too.
    """
    if len(mesh.faces) <= most_faces:
        return mesh
    # `mesh.area` would keep all triangles: 30 MB for a submap.
    area = trimesh.triangles.area(np.asarray(mesh.vertices)[mesh.faces])
    cell = np.sqrt(_CELLS_PER_FACE * area.sum() / most_faces)
    while len((fewer := _clustered(mesh, cell)).faces) > most_faces:
        cell *= np.sqrt(max(len(fewer.faces) / most_faces, 1.04))
    return fewer


def textured_surface(run: Result, segment: int, shown: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """Return the surface of a segment with its texture; None where it has none, or `shown` has fewer of its triangles.

    The triangles are those of `shown`, in their order; vertices at seams are there more than once.
    """
    # Of a mesh that was simplified the texture, whose file takes long to read, is of no use.
    is_whole = segment == run.main_segment and len(shown.faces) == len(run.mesh.faces)
    textured = run.textured if is_whole else None
    return textured if textured is not None and len(textured.faces) == len(shown.faces) else None


def at_split_vertices(values: np.ndarray, mesh: trimesh.Trimesh, textured: trimesh.Trimesh) -> np.ndarray:
    """Return values (V, ...) at a mesh's vertices for those of its `textured_surface`."""
    found = np.empty((len(textured.vertices), *values.shape[1:]), values.dtype)
    found[np.asarray(textured.faces)] = values[np.asarray(mesh.faces)]
    return found


def in_texture(values: np.ndarray, textured: trimesh.Trimesh) -> np.ndarray:
    """Return values (V,), 0..1, at the vertices of a surface with a texture as a picture of that, (H, W) float32.

    Each triangle has one value, and 1 is where there is none. They change slowly: edges between triangles are blurred.
    """
    visual: Any = textured.visual
    height, width = texture_picture(textured).shape[:2]
    from_above = (visual.uv * [1, -1] + [0, 1]) * [width, height] - 0.5
    places = np.round(from_above * 2**_SHIFT).astype(np.int32)[np.asarray(textured.faces)]
    levels = np.round(1 + 254 * values[np.asarray(textured.faces)].mean(axis=1)).tolist()
    drawn = np.zeros((height, width), np.uint8)
    for corners, level in zip(places, levels, strict=True):
        cv2.fillConvexPoly(drawn, corners, level, shift=_SHIFT)
    # Linear interpolation looks at the pixel beside a chart, too.
    beside = cv2.dilate(drawn, np.ones((3, 3), np.uint8))
    shares = np.where(drawn > 0, drawn, np.where(beside > 0, beside, np.uint8(255))).astype(np.float32)
    return np.asarray((cv2.blur(shares, (_BLUR_PX, _BLUR_PX)) - 1) / 254)


def _clustered(mesh: trimesh.Trimesh, cell: float) -> trimesh.Trimesh:
    """Return a mesh whose vertices are the means of those in each cube of a grid; `cell` is the cube's side."""
    vertices = np.asarray(mesh.vertices)
    places = np.floor((vertices - vertices.min(axis=0)) / cell).astype(np.int64)
    across, along, _ = places.max(axis=0) + 1
    keys = places[:, 0] + across * (places[:, 1] + along * places[:, 2])
    cluster_of, count = np.unique(keys, return_inverse=True, return_counts=True)[1:]

    def mean(values: Any) -> np.ndarray:
        columns = np.asarray(values, np.float64).reshape(len(vertices), -1).T
        return np.stack([np.bincount(cluster_of, column, len(count)) / count for column in columns], axis=-1)

    faces = cluster_of[np.asarray(mesh.faces)]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    attributes: dict[str, Any] = {name: mean(values).ravel() for name, values in mesh.vertex_attributes.items()}
    colours = np.round(mean(vertex_colours(mesh)[:, :3])).astype(np.uint8)
    return trimesh.Trimesh(mean(vertices), faces, vertex_colors=colours, vertex_attributes=attributes, process=False)


def times_seen(mesh: trimesh.Trimesh, frames: list[SeenFrame], camera: PinholeCamera) -> np.ndarray:
    """Return in how many of the frames each vertex is seen, (V,) int64: where their depth is within 10 % of its own."""
    count = np.zeros(len(mesh.vertices), np.int64)
    vertices = np.asarray(mesh.vertices, np.float32)
    for frame in frames:
        height, width = frame.depth_mm.shape
        T_camera_world = inverse(frame.T_world_camera).astype(np.float32)
        points = vertices @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        ahead = np.flatnonzero(points[:, 2] > 0)
        pixels = camera.project(points[ahead]) * np.array([width / camera.width, height / camera.height], np.float32)
        inside = ((pixels >= -0.5) & (pixels < [width - 0.5, height - 0.5])).all(axis=1)
        ahead, (column, row) = ahead[inside], np.round(pixels[inside]).astype(int).T
        with np.errstate(invalid="ignore"):
            count[ahead] += np.abs(frame.depth_mm[row, column] / points[ahead, 2] - 1) < _SAME_SURFACE
    return count


def mesh_data(
    mesh: trimesh.Trimesh, frames: list[SeenFrame], camera: PinholeCamera, textured: trimesh.Trimesh | None = None
) -> dict[str, Any]:
    """Return a mesh for the page: base64 arrays; `seen` is how often each vertex was seen, 255 = in all frames.

    textured : of the same triangles. positions: uint16 between `low` and `high`, mm. normals: int8. colours,
    confidence, moving, seen: uint8. faces: uint32. texture: None, or a JPEG and uint16, where each corner of the faces
    is in it, 65535 = its right or lower end.
    """
    confidence, moving = (
        np.asarray(mesh.vertex_attributes.get(name, np.full(len(mesh.vertices), otherwise)), np.float64)
        for name, otherwise in (("confidence", 1.0), ("moving", 0.0))
    )
    seen = times_seen(mesh, frames, camera)
    return {
        "vertices": len(mesh.vertices),
        **_shape_data(mesh),
        "normals": base64_of(np.round(127 * np.asarray(mesh.vertex_normals)), "i1"),
        "colours": base64_of(vertex_colours(mesh)[:, :3], "u1"),
        "confidence": base64_of(np.round(255 * np.clip(confidence.ravel(), 0, 1)), "u1"),
        "moving": base64_of(np.round(255 * np.clip(moving.ravel(), 0, 1)), "u1"),
        "seen": base64_of(np.round(255 * seen / max(len(frames), 1)), "u1"),
        "looked": len(frames),
        "texture": None if textured is None else _texture_data(textured),
    }


def _texture_data(textured: trimesh.Trimesh) -> dict[str, str]:
    visual: Any = textured.visual
    from_above = np.clip(visual.uv * [1, -1] + [0, 1], 0, 1)
    places = np.round(_LARGEST_LEVEL * from_above)[np.asarray(textured.faces)]
    return {"jpg": b64encode(texture_jpeg(textured)).decode(), "places": base64_of(places, "u2")}


def _shape_data(mesh: trimesh.Trimesh) -> dict[str, Any]:
    """Return positions, as levels between the lowest and the highest corner, and faces."""
    low, high = (np.zeros(3), np.ones(3)) if not len(mesh.vertices) else np.asarray(mesh.bounds)
    spread = np.maximum(high - low, 1e-9)
    levels = np.round((np.asarray(mesh.vertices) - low) / spread * _LARGEST_LEVEL)
    shape: dict[str, Any] = {"low": low.tolist(), "spread": spread.tolist(), "high": (low + spread).tolist()}
    return shape | {"positions": base64_of(levels, "u2"), "faces": base64_of(mesh.faces, "u4")}
