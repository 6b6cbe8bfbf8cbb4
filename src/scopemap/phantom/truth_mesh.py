"""The true surface as triangles: marching cubes on the shape, every vertex then moved onto it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import trimesh
from scipy import ndimage
from skimage.measure import marching_cubes

from scopemap.errors import InputError
from scopemap.phantom.volume import Volume

_NEWTON_STEPS = 4
_SEEN_MARGIN_VOXELS = 2
_RIM_VOXELS = 4


@dataclass
class SeenVoxels:
    """The voxels of the volume's surface that the cameras have seen, frame by frame."""

    volume: Volume
    voxels: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.voxels = np.zeros(self.volume.coefficients.shape, bool)

    def add(self, rest_mm: np.ndarray) -> None:
        """Mark the voxels of rest points (H, W, 3); NaN points are ignored."""
        points = rest_mm.reshape(-1, 3)
        cells = ((points[np.isfinite(points[:, 0])] - self.volume.origin_mm) / self.volume.voxel_mm).astype(int)
        self.voxels[tuple(cells.T)] = True

    def mesh(self) -> trimesh.Trimesh:
        """Return the true surface at rest where it was seen, with a rim of 2 voxels."""
        return surface_mesh(self.volume, ndimage.binary_dilation(self.voxels, iterations=_SEEN_MARGIN_VOXELS))


def surface_mesh(volume: Volume, where: np.ndarray) -> trimesh.Trimesh:
    """Return the surface inside the voxels `where` (X, Y, Z) bool, world mm, vertices on it to 1e-4 mm.

    Faces are counter-clockwise seen from the camera.

    Raises `InputError` where there is no surface in these voxels.
    """
    where = where & _defined(where.shape)
    values = volume.coefficients
    for axis in range(3):
        values = ndimage.convolve1d(values, np.array([1, 4, 1]) / 6, axis=axis, mode="nearest")
    if not where.any() or values[where].min() > 0 or values[where].max() < 0:
        raise InputError("no tissue is in sight of the camera path: nothing to make a true mesh of")
    vertices, faces, _, _ = marching_cubes(values, 0.0, mask=where, gradient_direction="descent")
    points = vertices.astype(np.float64) * volume.voxel_mm + volume.origin_mm
    for _ in range(_NEWTON_STEPS):
        value, gradient = volume.values_at(points)
        shift = -(value / (gradient**2).sum(1))[:, None] * gradient
        points = points + np.clip(np.nan_to_num(shift), -0.5 * volume.voxel_mm, 0.5 * volume.voxel_mm)
    return trimesh.Trimesh(points, faces.astype(np.int64), process=False)


def _defined(shape: tuple[int, ...]) -> np.ndarray:
    """Voxels (X, Y, Z) bool whose neighbourhood is inside the spline's domain."""
    inside = np.zeros(shape, bool)
    inside[(slice(_RIM_VOXELS, -_RIM_VOXELS),) * 3] = True
    return inside
