"""The centreline of a hollow space, and where points are around it: distance along it, and direction about it.

A shortest path through the cells of the space, between the two that are farthest apart, where a step costs the more the
nearer it is to the wall (penalised distance, Bitter et al., IEEE TVCG 7, 2001), smoothed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

_MOST_CELLS = 60_000  # by hand: of the graph; larger spaces are thinned
_NEAR_WALL_COST = 50.0  # by hand: of a step at the wall
_NEAR_WALL_SHARE = 0.25  # by hand: share of the radius over which it falls off


@dataclass(frozen=True)
class Centreline:
    """points_mm : (P, 3) float64, world, `step_mm` apart. up : (3,), the direction of 12 o'clock at its first point.

    radius_mm : median distance of the line to the wall. 12 o'clock is carried along the line without turning about it.
    """

    points_mm: np.ndarray
    step_mm: float
    radius_mm: float
    up: np.ndarray

    @cached_property
    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions (P, 3) of 12 and of 3 o'clock, looking along the line."""
        tangents = np.gradient(self.points_mm, axis=0)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        ups, up = [], self.up
        for tangent in tangents:
            up = up - tangent * (up @ tangent)
            up = up / max(float(np.linalg.norm(up)), 1e-9)
            ups.append(up)
        return np.array(ups), np.cross(tangents, np.array(ups))

    def place(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the number (N,) of the nearest point of the line, and the clock direction (N,), 0 to 12 hours."""
        nearest = cKDTree(self.points_mm).query(points_mm)[1]
        up, right = (axis[nearest] for axis in self.axes)
        offset = points_mm - self.points_mm[nearest]
        return nearest, clock((offset * right).sum(1), (offset * up).sum(1))

    def towards(self, poses: np.ndarray, up: np.ndarray) -> Centreline:
        """Return the line in the order in which cameras with poses (M, 4, 4) near it look along it; up : its 12."""
        nearest = cKDTree(self.points_mm).query(poses[:, :3, 3])[1]
        forward = (np.gradient(self.points_mm, axis=0)[nearest] * poses[:, :3, 2]).sum() >= 0
        return Centreline(self.points_mm if forward else self.points_mm[::-1], self.step_mm, self.radius_mm, up)


def clock(right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the direction of offsets to the right and up as a clock's, 0 to 12 hours."""
    return np.asarray(np.degrees(np.arctan2(right, up)) % 360 / 30)


def centreline(inside: np.ndarray, corner_mm: np.ndarray, cell_mm: float) -> Centreline:
    """Return the centreline of one space, the cells `inside` (l, m, n) bool of a grid that begins at a corner.

    Its direction is arbitrary, as is its 12 o'clock.
    """
    thin = max(1, int(np.ceil((np.count_nonzero(inside) / _MOST_CELLS) ** (1 / 3))))
    cells = inside[::thin, ::thin, ::thin]
    step_mm = cell_mm * thin
    wall_mm = distance_transform_edt(cells)[cells] * step_mm
    where = np.argwhere(cells)
    first, second, length_mm = _steps(cells, where, step_mm)
    near = 0.5 * (wall_mm[first] + wall_mm[second]) / (_NEAR_WALL_SHARE * np.percentile(wall_mm, 95))
    shape = (len(where), len(where))
    plain = coo_matrix((length_mm, (first, second)), shape).tocsr()
    penalised = coo_matrix((length_mm * (1 + _NEAR_WALL_COST * np.exp(-near)), (first, second)), shape).tocsr()
    start = _farthest(plain, _farthest(plain, int(np.argmax(wall_mm))))
    end = _farthest(plain, start)
    before = dijkstra(penalised, directed=False, indices=start, return_predecessors=True)[1]
    path = [end]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    points = corner_mm + (where[path] * thin + 0.5) * cell_mm
    radius_mm = float(np.median(wall_mm[path]))
    points = _even(gaussian_filter1d(_even(points, step_mm), radius_mm / step_mm, axis=0, mode="nearest"), step_mm)
    return Centreline(points, step_mm, radius_mm, np.array([0.0, -1.0, 0.0]))


def _steps(cells: np.ndarray, where: np.ndarray, step_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs of neighbours among cells (N, 3), by number, and their distances, mm; each pair once."""
    number = np.full(np.array(cells.shape) + 2, -1)
    number[1:-1, 1:-1, 1:-1][cells] = np.arange(len(where))
    first, second, length = [], [], []
    for offset in np.ndindex(3, 3, 3):
        if offset > (1, 1, 1):
            other = number[tuple((where + offset).T)]
            pairs = np.flatnonzero(other >= 0)
            first.append(pairs)
            second.append(other[pairs])
            length.append(np.full(len(pairs), step_mm * np.linalg.norm(np.subtract(offset, 1))))
    return np.concatenate(first), np.concatenate(second), np.concatenate(length)


def _farthest(graph: coo_matrix, start: int) -> int:
    """Return the number of the cell that is farthest from another one, through the space."""
    distance = dijkstra(graph, directed=False, indices=start)
    return int(np.argmax(np.where(np.isfinite(distance), distance, -1)))


def _even(points: np.ndarray, step: float) -> np.ndarray:
    """Return points (M, 3) on the line through some (N, 3), a step apart along it."""
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    places = np.arange(0, along[-1] + 1e-9, step)
    return np.stack([np.interp(places, along, column) for column in points.T], -1)
