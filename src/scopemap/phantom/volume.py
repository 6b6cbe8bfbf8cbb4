"""Volume: a scene's shape as one smooth function on a grid.

The shape is the zero set of a uniform cubic B-spline with coefficients on a grid, positive in the free space and
negative in tissue. The spline itself is the definition of the surface, not an approximation of one, so depth and mesh
can be exact. Two of its properties make marching safe: in a cell it stays within the range of the 4x4x4
coefficients around it (convex hull), and its slope within that of their differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from scopemap.errors import check_shape
from scopemap.phantom.spline import evaluate


@dataclass(frozen=True)
class Volume:
    """Shape of the free space.

    Attributes
    ----------
    coefficients : (X, Y, Z) float32, mm: about the distance to the tissue where positive, below 0 in tissue.
    origin_mm : (3,) float64, world position of coefficient (0, 0, 0); the grid's axes are those of the world.
    voxel_mm : grid spacing.
    """

    coefficients: np.ndarray
    origin_mm: np.ndarray
    voxel_mm: float

    @cached_property
    def skip(self) -> np.ndarray:
        """(X, Y, Z) uint8: the surface is at least `skip - 1` voxels away from any point of the cell."""
        lowest = ndimage.minimum_filter(self.coefficients, size=4, origin=-1, mode="nearest")
        return np.minimum(ndimage.distance_transform_cdt(lowest > 0, "chessboard"), 255).astype(np.uint8)

    @cached_property
    def steepest(self) -> np.ndarray:
        """(X, Y, Z) uint8: bound of the slope (mm per voxel, in units of `slope_unit`) within a voxel of the cell."""
        return np.ceil(self._slope_bound / self.slope_unit).astype(np.uint8)

    @cached_property
    def slope_unit(self) -> float:
        """Unit of `steepest`, mm per voxel."""
        return max(float(self._slope_bound.max()), 1e-6) / 255 * (1 + 1e-6)

    @cached_property
    def _slope_bound(self) -> np.ndarray:
        squared = np.zeros(self.coefficients.shape, np.float32)
        for axis in range(3):
            last = self.coefficients.take([-1], axis)
            slope = np.abs(np.diff(self.coefficients, axis=axis, append=last))
            squared += ndimage.maximum_filter(slope, size=6, origin=-1, mode="nearest") ** 2
        return np.sqrt(squared)

    def values_at(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the shape function (N,) in mm and its gradient (N, 3) at points (N, 3); NaN outside the grid."""
        check_shape("points_mm", points_mm, (None, 3))
        grid = np.ascontiguousarray((points_mm - self.origin_mm) / self.voxel_mm, dtype=np.float64)
        out = np.full((len(grid), 4), np.nan)
        evaluate(self.coefficients, grid, out)
        return out[:, 0], out[:, 1:] / self.voxel_mm

    def distances_at(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the distance (N,) in mm, to first order, from points (N, 3) near the surface: value over slope."""
        value, gradient = self.values_at(points_mm)
        return value / np.linalg.norm(gradient, axis=1)
