"""The surface of a result as the window draws it and as clicks meet it: few triangles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.apps.browser.unlit_mesh import texture_before_tone_mapping
from scopemap.engine.fusion.open_glb import texture_picture
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.engine.geometry.surface_measures import meet_surface
from scopemap.report.pale_parts import certainty, faded
from scopemap.report.shown_mesh import at_split_vertices, in_texture, simplified, textured_surface
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result

MOST_FACES = 200_000


@dataclass(frozen=True)
class SurfacePick:
    """A place on a surface: its triangle, and the weights (3,) of the triangle's corners."""

    face: int
    weights: np.ndarray


class ShownSurface:
    """The surface of a segment of a result, or of one of its submaps, of at most 200,000 triangles.

    segment : its number; None: the main one.
    """

    def __init__(self, run: Result, most_faces: int = MOST_FACES, *, segment: int | None = None) -> None:
        self.run, self.segment = run, run.main_segment if segment is None else segment
        self.mesh = simplified(run.surface(self.segment), most_faces)
        self.faces = np.asarray(self.mesh.faces)
        self._textures: dict[bool, bytes] = {}

    @property
    def is_empty(self) -> bool:
        """Whether there is no surface."""
        return not len(self.faces)

    @cached_property
    def colours(self) -> np.ndarray:
        """Colours (V, 3) uint8 sRGB, as in the result."""
        return vertex_colours(self.mesh)[:, :3]

    @cached_property
    def textured(self) -> trimesh.Trimesh | None:
        """Its triangles with a texture of the video's frames; None where there is none."""
        return textured_surface(self.run, self.segment, self.mesh)

    @cached_property
    def sure(self) -> np.ndarray:
        """How sure it is at its vertices, (V,), 0 to 1."""
        return certainty(self.mesh)

    def texture(self, *, pale: bool) -> bytes:
        """Return the texture as `unlit_textured_glb` wants it; pale : what is not sure has lost its colour."""
        if pale not in self._textures:
            assert self.textured is not None
            picture = texture_picture(self.textured)
            if pale:
                sure = at_split_vertices(self.sure, self.mesh, self.textured)
                picture = faded(picture, in_texture(sure, self.textured))
            self._textures[pale] = texture_before_tone_mapping(picture)
        return self._textures[pale]

    @cached_property
    def facing(self) -> np.ndarray:
        """Cosines (V,), 0 to 1, at which the nearest camera sees the vertices."""
        return facing_of(self.mesh, self._frames["T_world_camera"][:, :3, 3])

    @property
    def _frames(self) -> FrameTable:
        """The frames whose segment it is."""
        tracked = self.run.tracked
        own = tracked["segment"] == self.segment
        return tracked.only(own) if own.any() else tracked

    @cached_property
    def vertices(self) -> np.ndarray:
        """Its vertices (V, 3), mm."""
        return np.asarray(self.mesh.vertices)

    @cached_property
    def size_mm(self) -> float:
        """How large it is without its outermost parts, or how far the camera moves where there is none."""
        points = self.vertices if len(self.vertices) else self.run.tracked["T_world_camera"][:, :3, 3]
        low, high = np.percentile(points, [5, 95], axis=0)
        return float(np.linalg.norm(high - low)) or 1.0

    def pick(self, origin: np.ndarray, direction: np.ndarray) -> SurfacePick | None:
        """Return where a ray, origin and direction (3,), first meets the surface; or None."""
        if self.is_empty:
            return None
        met = meet_surface(self.mesh, np.asarray(origin, float), np.asarray(direction, float))
        if met is None:
            return None
        corners = self.vertices[self.faces[met.face]]
        weights = trimesh.triangles.points_to_barycentric(corners[None], met.position[None])[0]
        return SurfacePick(met.face, weights)

    def position(self, pick: SurfacePick) -> np.ndarray:
        """Return where a place is, (3,) mm."""
        return np.asarray(pick.weights @ self.vertices[self.faces[pick.face]])

    def normal(self, pick: SurfacePick) -> np.ndarray:
        """Return the direction (3,) that a place faces, of length 1, or 0 for a triangle without area."""
        first, second, third = self.vertices[self.faces[pick.face]]
        normal = np.cross(second - first, third - first)
        return np.asarray(normal / max(float(np.linalg.norm(normal)), 1e-12))


def facing_of(mesh: trimesh.Trimesh, cameras: np.ndarray) -> np.ndarray:
    """Return cosines (V,), 0 to 1, at which the nearest of cameras, positions (N, 3), sees the vertices of a mesh."""
    vertices = np.asarray(mesh.vertices)
    if not len(mesh.faces) or not len(cameras):
        return np.ones(len(vertices))
    ray = vertices - cameras[cKDTree(cameras).query(vertices)[1]]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
    return np.asarray(np.abs((np.asarray(mesh.vertex_normals) * ray).sum(1)))
