"""The surface of a result as the window draws it and as clicks meet it: few triangles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
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
_AMBIENT = 0.55
"""Of the light in relief, from everywhere; the rest is that of a lamp at the camera."""


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
        self._textures: dict[tuple[bool, bool], bytes] = {}

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

    def texture(self, *, pale: bool, relief: bool) -> bytes:
        """Return the texture as `unlit_textured_glb` wants it.

        pale : what is not sure has lost its colour. relief : it is darker where it does not face a camera; in the
        picture, since what is multiplied before the page's tone mapping changes colours.
        """
        if (pale, relief) not in self._textures:
            assert self.textured is not None
            picture = texture_picture(self.textured)
            if pale:
                picture = faded(picture, self._in_texture(self.sure))
            if relief:
                light = self._in_texture(light_of(self.facing))
                dark = [cv2.multiply(picture[..., channel], light, dtype=cv2.CV_8U) for channel in range(3)]
                picture = np.dstack(dark)
            self._textures[pale, relief] = texture_before_tone_mapping(picture)
        return self._textures[pale, relief]

    def _in_texture(self, values: np.ndarray) -> np.ndarray:
        """Return values (V,), 0..1, at its vertices as a picture of its texture, (H, W) float32."""
        assert self.textured is not None
        shares = in_texture(at_split_vertices(values, self.mesh, self.textured), self.textured)
        return np.asarray(shares, np.float32)

    @cached_property
    def facing(self) -> np.ndarray:
        """Cosines (V,), 0 to 1, at which the nearest camera sees the vertices."""
        return facing_of(self.mesh, self.frames["T_world_camera"][:, :3, 3])

    @property
    def frames(self) -> FrameTable:
        """The tracked frames of its segment; all of the submap where frames have none."""
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


def light_of(facing: np.ndarray) -> np.ndarray:
    """Return the light (V,), 0..1, in relief, on vertices that face a camera so, by `facing_of`, (V,)."""
    return _AMBIENT + (1 - _AMBIENT) * facing


def facing_of(mesh: trimesh.Trimesh, cameras: np.ndarray) -> np.ndarray:
    """Return cosines (V,), 0 to 1, at which the nearest of cameras, positions (N, 3), sees the vertices of a mesh."""
    vertices = np.asarray(mesh.vertices)
    if not len(mesh.faces) or not len(cameras):
        return np.ones(len(vertices))
    ray = vertices - cameras[cKDTree(cameras).query(vertices)[1]]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-9)
    return np.asarray(np.abs((np.asarray(mesh.vertex_normals) * ray).sum(1)))
