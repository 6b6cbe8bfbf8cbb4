"""Small holes within a surface: found as loops of its border, closed by a fan of triangles around a new vertex."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from scopemap.geometry.rendering import vertex_colours

# Perimeter of the largest hole that is closed, in voxels.
LARGEST_PERIMETER_VOXELS = 20.0
# Cosine between a loop's own normal and the surface's beside it: -1 around a hole in a plane, 1 around an island, 0 at
# the end of a tube, which leads to what no frame saw.
_HOLE_COSINE = -0.5


def without_small_holes(mesh: trimesh.Trimesh, largest_perimeter_mm: float) -> trimesh.Trimesh:
    """Return the mesh with the holes closed whose border is at most so long and that the surface surrounds.

    Each gets a vertex in its middle, with the border's mean colour and 0 for all vertex attributes, such as
    `confidence`. Vertices and faces keep their numbers, new ones follow. Islands and open ends stay as they are.
    """
    starts, ends = _border(np.asarray(mesh.faces))
    vertices = np.asarray(mesh.vertices)
    normals = mesh.vertex_normals if len(starts) else np.zeros((0, 3))
    lengths = np.linalg.norm(vertices[starts] - vertices[ends], axis=1)
    loops = [
        np.array(loop)
        for loop in _loops(starts, ends, lengths, largest_perimeter_mm)
        if _is_hole(vertices[loop], normals[loop])
    ]
    if not loops:
        return mesh
    new = len(vertices) + np.arange(len(loops))
    fans = [
        np.stack([np.roll(loop, -1), loop, np.full(len(loop), k)], axis=1) for loop, k in zip(loops, new, strict=True)
    ]
    colours = vertex_colours(mesh)
    middles = np.stack([vertices[loop].mean(axis=0) for loop in loops])
    shades = np.round([colours[loop].mean(axis=0) for loop in loops]).astype(colours.dtype)
    attributes: dict[str, Any] = {
        name: np.concatenate([values, np.zeros((len(loops), *np.shape(values)[1:]), np.asarray(values).dtype)])
        for name, values in mesh.vertex_attributes.items()
    }
    return trimesh.Trimesh(
        np.concatenate([vertices, middles]),
        np.concatenate([mesh.faces, *fans]),
        vertex_colors=np.concatenate([colours, shades]),
        vertex_attributes=attributes,
        process=False,
    )


def _border(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and second vertex, as in their face, of all edges that only one face has, (E,) each."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    count = edges.max(initial=0) + 1
    keys = edges.min(axis=1) * count + edges.max(axis=1)
    _, first, uses = np.unique(keys, return_index=True, return_counts=True)
    border = edges[first[uses == 1]]
    return border[:, 0], border[:, 1]


def _loops(starts: np.ndarray, ends: np.ndarray, lengths: np.ndarray, longest: float) -> list[list[int]]:
    """Return the closed loops of directed edges, as vertices, that are not longer; where two touch they are parted."""
    onwards: dict[int, list[tuple[int, float]]] = {}
    for start, end, length in zip(starts.tolist(), ends.tolist(), lengths.tolist(), strict=True):
        onwards.setdefault(start, []).append((end, length))
    loops = []
    while onwards:
        path, travelled = [next(iter(onwards))], [0.0]
        place = {path[0]: 0}
        while choices := onwards.get(path[-1]):
            end, length = choices.pop()
            if not choices:
                del onwards[path[-1]]
            travelled.append(travelled[-1] + length)
            if end not in place:
                place[end] = len(path)
                path.append(end)
                continue
            # The path has come back: what it encloses is a loop, and it goes on from there.
            back = place[end]
            if travelled[-1] - travelled[back] <= longest:
                loops.append(path[back:])
            for vertex in path[back + 1 :]:
                del place[vertex]
            del path[back + 1 :], travelled[back + 1 :]
    return loops


def _is_hole(points: np.ndarray, normals: np.ndarray) -> bool:
    """Whether a loop of border points (N, 3), in the direction of their faces, goes around a hole in the surface."""
    arms = points - points.mean(axis=0)
    area = np.cross(arms, np.roll(arms, -1, axis=0)).sum(axis=0)
    around = normals.sum(axis=0)
    return bool(area @ around < _HOLE_COSINE * np.linalg.norm(area) * np.linalg.norm(around))
