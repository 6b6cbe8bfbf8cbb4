"""Camera models: points to pixels and back.

OpenCV axes (x right, y down, z forward) and pixel centres (the top-left pixel's centre is (0, 0)). A model projects
points of any unit and unprojects to rays with z = 1. Lenses that bend straight lines are in `lenses.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np


class CameraModel(Protocol):
    """What every camera model can do: pinhole, OpenCV, fisheye, field of view, omnidirectional."""

    @property
    def width(self) -> int:
        """Width of the image, px."""

    @property
    def height(self) -> int:
        """Height of the image, px."""

    @property
    def central(self) -> PinholeCamera:
        """The pinhole camera that agrees with this one near its principal point."""

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (..., 2) of points (..., 3); NaN for points outside the field of the model."""

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Return rays (..., 3) with z = 1 through pixels (..., 2); NaN for pixels outside the field of the model."""

    def resized(self, width: int, height: int) -> CameraModel:
        """Return the camera of the same view at another size; pixel centres stay pixel centres."""

    def cropped(self, x: int, y: int, width: int, height: int) -> CameraModel:
        """Return the camera of the part (width, height) of the image whose top-left pixel is (x, y)."""


def source_pixel(pixels: np.ndarray, working: PinholeCamera, source: CameraModel) -> np.ndarray:
    """Return where pixels (..., 2) of the rectified, working image are in the source's image, px; NaN beyond its field.

    A run's folder holds both cameras: `camera.yaml` is `working`, `source_camera.yaml` is `source`.
    """
    return source.project(working.unproject(pixels))


@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole camera: focal lengths and principal point in px, image size in px."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def central(self) -> PinholeCamera:
        """The camera itself: a pinhole agrees with itself everywhere."""
        return self

    @property
    def matrix(self) -> np.ndarray:
        """The (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def rays(self) -> np.ndarray:
        """(H, W, 3) float32 rays with z = 1, one per pixel."""
        return _rays(self)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (..., 2) of points (..., 3); NaN for points not in front of the camera."""
        points = np.asarray(points, dtype=np.float64)
        z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
        return np.stack([self.fx * points[..., 0] / z + self.cx, self.fy * points[..., 1] / z + self.cy], -1)

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Return rays (..., 3) with z = 1 through pixels (..., 2)."""
        pixels = np.asarray(pixels, dtype=np.float64)
        x, y = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], -1)

    def resized(self, width: int, height: int) -> PinholeCamera:
        """Return the camera of the same view at another size; pixel centres stay pixel centres."""
        sx, sy = width / self.width, height / self.height
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return PinholeCamera(self.fx * sx, self.fy * sy, cx, cy, width, height)

    def cropped(self, x: int, y: int, width: int, height: int) -> PinholeCamera:
        """Return the camera of the part (width, height) of the image whose top-left pixel is (x, y)."""
        return replace(self, cx=self.cx - x, cy=self.cy - y, width=width, height=height)


@lru_cache(maxsize=16)
def _rays(camera: PinholeCamera) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.unproject(np.stack([u, v], -1)).astype(np.float32)
