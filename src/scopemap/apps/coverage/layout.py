"""The examined part of a space, and where its points are on the map: along a centreline, or by directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.engine.errors import InputError
from scopemap.engine.fusion.watertight import SEEN_CELLS, ClosedSpace, closed_space
from scopemap.engine.geometry.centreline import Centreline, centreline, clock
from scopemap.result.result import Result

CLOCK_BINS = 36
LUMEN_RADII = 3.0
"""Length of the examined part, over its radius, from which a space is a lumen."""
_RING_DEG = 4.0
_RINGS = 45
_HALF = 0.5
_END_RADII = 0.25
_ACROSS = 0.5  # by hand: cosine of the normal to the centreline from which a face at its end is no wall
_FARTHEST_SEEN = 0.95  # share of what was seen in a clock direction of a cavity, up to whose angle it was examined


@dataclass(frozen=True)
class Lumen:
    """Rows are distances along a centreline. radius_mm : median distance of the line to the wall."""

    line: Centreline
    kind: Literal["lumen"] = "lumen"

    @property
    def step(self) -> float:
        """Height of a row, mm."""
        return self.line.step_mm

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return len(self.line.points_mm)

    @property
    def radius_mm(self) -> float:
        """The radius of the lumen."""
        return self.line.radius_mm

    def place(self, points_mm: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return row (N,) and clock (N,) of points (N, 3) with normals, and whether each belongs to the wall."""
        row, hours = self.line.place(points_mm)
        return row, hours, np.ones(len(row), bool)

    def examined(self, area: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Return the bins (S, 36) bool of the examined part: from the first to the last row half of which was seen.

        A quarter of the radius at both ends does not count, since the surface closes there.
        """
        rows = np.flatnonzero(seen.sum(1) > _HALF * area.sum(1))
        inside = np.zeros(area.shape, bool)
        if len(rows):
            end = max(1, round(_END_RADII * self.radius_mm / self.step))
            inside[max(rows[0], end) : min(rows[-1] + 1, len(area) - end)] = True
        return inside


@dataclass(frozen=True)
class Cavity:
    """Rows are angles from the mean direction of view, degrees.

    centre_mm : (3,), the median position of the camera. axes : (3, 3), right, up and ahead. radius_mm : median distance
    of what was seen.
    """

    centre_mm: np.ndarray
    axes: np.ndarray
    radius_mm: float
    kind: Literal["cavity"] = "cavity"
    step: float = _RING_DEG
    rows: int = _RINGS

    def place(self, points_mm: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return row (N,) and clock (N,) of points (N, 3) with normals, and whether each faces the centre."""
        offset = points_mm - self.centre_mm
        right, up, ahead = (offset @ self.axes.T).T
        angle = np.degrees(np.arctan2(np.hypot(right, up), ahead))
        row = np.minimum((angle / _RING_DEG).astype(int), _RINGS - 1)
        return row, clock(right, up), (offset * normals).sum(1) < 0

    def examined(self, area: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Return the bins (S, 36) bool of the examined part: in each clock direction, up to the farthest seen."""
        return np.asarray((np.cumsum(seen, axis=0) <= _FARTHEST_SEEN * seen.sum(0)) & (seen.sum(0) > 0))


Layout = Lumen | Cavity


@dataclass(frozen=True, eq=False)
class ExaminedSpace:
    """The closed surface of a run and the part of it that was examined.

    present : (F,) whether the run's own surface is at a face. area : (F,) that counts, 0 of what is not the wall. row,
    hours : (F,) place of the faces, rows from that where the examined part begins. inside : (S, 36) bins of that part.
    first : its first row of the layout.
    """

    surface: trimesh.Trimesh
    present: np.ndarray
    area: np.ndarray
    layout: Layout
    row: np.ndarray
    hours: np.ndarray
    inside: np.ndarray
    first: int


def examined_space(run: Result) -> ExaminedSpace:
    """Return what of the space of a run was examined; raises `InputError` where nothing was seen enough."""
    space = closed_space(run.mesh, run.config.fusion.voxel_mm or 0.0)
    surface = trimesh.Trimesh(*space.surface(), process=False)
    layout = layout_of(space, np.asarray(run.mesh.vertices), run.frames.only(run.frames.tracked)["T_world_camera"])
    present = cKDTree(run.mesh.vertices).query(surface.triangles_center)[0] <= SEEN_CELLS * space.cell_mm
    if isinstance(layout, Lumen):
        wall = ~lids(surface, present, layout.line)
        surface.update_faces(wall)
        present = present[wall]
    row, hours, wall = layout.place(surface.triangles_center, surface.face_normals)
    area = surface.area_faces * (wall | present)
    inside = layout.examined(*(binned(row, hours, weights, layout.rows) for weights in (area, area * present)))
    if not inside.any():
        raise InputError(f"{run.path}: no part of the space was seen enough to say what was not")
    rows = np.flatnonzero(inside.any(1))
    first = int(rows[0]) if layout.kind == "lumen" else 0
    return ExaminedSpace(surface, present, area, layout, row - first, hours, inside[first : rows[-1] + 1], first)


def lids(surface: trimesh.Trimesh, present: np.ndarray, line: Centreline) -> np.ndarray:
    """Return which faces (F,) of a closed lumen are lids over its open ends: they are no wall.

    They are connected with the place where the centreline ends, by faces that were not seen, and lie across it.
    present : (F,) bool, whether the run's own surface is there.
    """
    row, _ = line.place(surface.triangles_center)
    tangents = np.gradient(line.points_mm, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.abs((surface.face_normals * tangents[row]).sum(1)) > _ACROSS
    closing = ~present & across
    pairs = surface.face_adjacency[closing[surface.face_adjacency].all(axis=1)]
    found = np.zeros(len(present), bool)
    for part in trimesh.graph.connected_components(pairs, nodes=np.flatnonzero(closing), min_len=1):
        found[part] = bool(np.isin(row[part], (0, len(line.points_mm) - 1)).any())
    return found


def layout_of(space: ClosedSpace, points_mm: np.ndarray, poses: np.ndarray) -> Layout:
    """Return the layout of a closed space, by points (N, 3) of the run's surface and the camera's poses (M, 4, 4).

    It is a lumen where the surface surrounds the free space, and where what was seen of it extends over three radii of
    its centreline or more; else a cavity. 12 o'clock is up in the first picture; a lumen is followed in the direction
    of view.
    """
    up = -poses[0, :3, 1]
    if not space.tissue:
        line = centreline(space.field > 0, space.corner_mm, space.cell_mm).towards(poses, up)
        low, high = np.percentile(line.place(points_mm)[0], [1, 99])
        if (high - low) * line.step_mm >= LUMEN_RADII * line.radius_mm:
            return Lumen(line)
    centre, ahead = np.median(poses[:, :3, 3], axis=0), poses[:, :3, 2].mean(0)
    ahead = ahead / np.linalg.norm(ahead)
    up = up - ahead * (up @ ahead)
    up = up / np.linalg.norm(up)
    axes = np.stack([np.cross(ahead, up), up, ahead])
    return Cavity(centre, axes, float(np.median(np.linalg.norm(points_mm - centre, axis=1))))


def binned(row: np.ndarray, hours: np.ndarray, weights: np.ndarray, rows: int) -> np.ndarray:
    """Return the sums (rows, 36) of weights (N,) by row and clock."""
    return np.bincount(row * CLOCK_BINS + column_of(hours), weights, rows * CLOCK_BINS).reshape(rows, CLOCK_BINS)


def column_of(hours: np.ndarray) -> np.ndarray:
    """Return the column of the map of clock directions."""
    return np.minimum((hours * (CLOCK_BINS / 12)).astype(int), CLOCK_BINS - 1)
