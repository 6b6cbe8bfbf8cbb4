"""Lenses with distortion: OpenCV radial-tangential, Kannala-Brandt fisheye, FOV, Scaramuzza omnidirectional.

Each is one increasing radial function, plus OpenCV's tangential terms. The field of a lens ends where its radial
function stops increasing or rays no longer point forward; beyond it `project` and `unproject` return NaN.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.polynomial import Polynomial

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera

# Rays are written with z = 1, so a field must end before 90 deg: here at 88.9 deg.
_WIDEST_RAD = float(np.arctan(50.0))
_ANGLES_RAD = np.linspace(0, _WIDEST_RAD, 1024)  # where inversions look: every tenth of a degree, by hand
_MAX_STEPS = 60  # guard: of an inversion that does not end
_SMALL_STEP = 1e-9  # guard: of the grid, to see whether a function increases

_Function = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class _RadialLens(CameraModel, ABC):
    """A lens that moves points of the plane z = 1 and then sees them through the pinhole camera `plane`."""

    plane: PinholeCamera

    @property
    def central(self) -> PinholeCamera:
        return self.plane

    @property
    def width(self) -> int:
        return self.plane.width

    @property
    def height(self) -> int:
        return self.plane.height

    @abstractmethod
    def _radial(self, angle: np.ndarray) -> np.ndarray:
        """Return the distance from the axis on the lens' plane of rays at `angle` from it, rad."""

    @property
    def field_rad(self) -> float:
        """Largest angle from the axis, rad, within the field."""
        return float(self._grid[-1])

    @cached_property
    def _grid(self) -> np.ndarray:
        return _while_increasing(self._radial, _ANGLES_RAD)

    def _distorted(self, xy: np.ndarray) -> np.ndarray:
        """Return where the lens moves points (..., 2) of the plane z = 1, NaN beyond its field."""
        angle = np.arctan(np.linalg.norm(xy, axis=-1))
        return _with_radius(xy, self._radial(np.where(angle <= self.field_rad, angle, np.nan)))

    def _undistorted(self, xy: np.ndarray) -> np.ndarray:
        """Return the inverse of `_distorted`."""
        return _with_radius(xy, np.tan(_invert_increasing(self._radial, self._grid, np.linalg.norm(xy, axis=-1))))

    def project(self, points: np.ndarray) -> np.ndarray:
        xy = self._distorted(_on_plane(points))
        return xy * np.array([self.plane.fx, self.plane.fy]) + np.array([self.plane.cx, self.plane.cy])

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        return _ray(self._undistorted(self.plane.unproject(pixels)[..., :2]))

    def resized(self, width: int, height: int) -> Self:
        return replace(self, plane=self.plane.resized(width, height))

    def cropped(self, x: int, y: int, width: int, height: int) -> Self:
        return replace(self, plane=self.plane.cropped(x, y, width, height))


@dataclass(frozen=True)
class OpenCvCamera(_RadialLens):
    """OpenCV's radial-tangential lens, `cv2.projectPoints` (Brown 1966): k1 k2 p1 p2 [k3 [k4 k5 k6]]."""

    distortion: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.distortion) not in (4, 5, 8):
            raise ValueError(f"OpenCvCamera.distortion: expected 4, 5 or 8 numbers, got {len(self.distortion)}")

    def _radial(self, angle: np.ndarray) -> np.ndarray:
        k1, k2, _, _, k3, k4, k5, k6 = (*self.distortion, *[0.0] * (8 - len(self.distortion)))
        r = np.tan(angle)
        return r * Polynomial([1, k1, k2, k3])(r * r) / Polynomial([1, k4, k5, k6])(r * r)

    def _tangential(self, xy: np.ndarray) -> np.ndarray:
        p1, p2 = self.distortion[2:4]
        x, y = xy[..., 0], xy[..., 1]
        s = x * x + y * y
        return np.stack([2 * p1 * x * y + p2 * (s + 2 * x * x), p1 * (s + 2 * y * y) + 2 * p2 * x * y], -1)

    def _distorted(self, xy: np.ndarray) -> np.ndarray:
        return super()._distorted(xy) + self._tangential(xy)

    def _undistorted(self, xy: np.ndarray) -> np.ndarray:
        shift = np.zeros_like(xy)
        for _ in range(_MAX_STEPS):
            found = super()._undistorted(xy - shift)
            previous, shift = shift, self._tangential(found)
            if not np.any(np.abs(shift - previous) > 1e-14):
                break
        return found


@dataclass(frozen=True)
class FisheyeCamera(_RadialLens):
    """Kannala-Brandt fisheye (IEEE PAMI 28(8), 2006, eq. 6): the angle t becomes t (1 + k1 t^2 + ... + k4 t^8)."""

    distortion: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.distortion) != 4:
            raise ValueError(f"FisheyeCamera.distortion: expected 4 numbers, got {len(self.distortion)}")

    def _radial(self, angle: np.ndarray) -> np.ndarray:
        return angle * Polynomial([1, *self.distortion])(angle**2)


@dataclass(frozen=True)
class FovCamera(_RadialLens):
    """Lens of one parameter (Devernay and Faugeras, Machine Vision and Applications 13, 2001, section 3.2).

    The distance r from the axis on the plane z = 1 becomes atan(2 r tan(omega / 2)) / omega.

    plane : scales (fx, fy) that take the distorted plane to pixels. omega : the lens' angle of view in the model, rad,
    0 < omega < pi.
    """

    omega: float

    def __post_init__(self) -> None:
        if not 0 < self.omega < np.pi:
            raise ValueError(f"FovCamera.omega: expected an angle between 0 and pi, got {self.omega:g}")

    @property
    def central(self) -> PinholeCamera:
        """The pinhole camera that agrees with this one near its principal point."""
        slope = float(2 * np.tan(self.omega / 2) / self.omega)
        return replace(self.plane, fx=self.plane.fx * slope, fy=self.plane.fy * slope)

    def _radial(self, angle: np.ndarray) -> np.ndarray:
        return np.arctan(2 * np.tan(angle) * np.tan(self.omega / 2)) / self.omega


@dataclass(frozen=True)
class OmnidirectionalCamera:
    """Scaramuzza's polynomial lens in the form that MATLAB and C3VD use (IROS 2006, eq. 5-8).

    With (u'', v'') = inverse of [[c, d], [e, 1]] times (u - cx, v - cy), and rho the length of that, the ray is
    (u'', v'', a0 + a1 rho + a2 rho^2 + ...).

    polynomial : a0 > 0, a1 (0 in practice), a2, ... in px. stretch : c, d, e.
    cx, cy : principal point, px (top-left pixel centre is 0, 0; MATLAB's values are larger by 1).
    """

    polynomial: tuple[float, ...]
    cx: float
    cy: float
    width: int
    height: int
    stretch: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.polynomial or self.polynomial[0] <= 0:
            raise ValueError(f"OmnidirectionalCamera.polynomial: a0 must be positive, got {self.polynomial}")

    @property
    def central(self) -> PinholeCamera:
        """The pinhole camera that agrees with this one near its principal point."""
        a0, c = self.polynomial[0], self.stretch[0]
        return PinholeCamera(a0 * c, a0, self.cx, self.cy, self.width, self.height)

    @property
    def _stretch_matrix(self) -> np.ndarray:
        c, d, e = self.stretch
        return np.array([[c, d], [e, 1.0]])

    @cached_property
    def _grid(self) -> np.ndarray:
        """Ascending rho, px, while the angle from the axis grows and the rays point forward."""
        return _while_increasing(self._angle, self.polynomial[0] * np.tan(_ANGLES_RAD), most=_WIDEST_RAD)

    def _angle(self, rho: np.ndarray) -> np.ndarray:
        return np.arctan2(rho, Polynomial(self.polynomial)(rho))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (..., 2) of points (..., 3); NaN behind the camera and beyond the field of the lens."""
        xy = _on_plane(points)
        rho = _invert_increasing(self._angle, self._grid, np.arctan(np.linalg.norm(xy, axis=-1)))
        return _with_radius(xy, rho) @ self._stretch_matrix.T + np.array([self.cx, self.cy])

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Return rays (..., 3) with z = 1 through pixels (..., 2); NaN beyond the field of the lens."""
        offset = np.asarray(pixels, dtype=np.float64) - np.array([self.cx, self.cy])
        offset = offset @ np.linalg.inv(self._stretch_matrix).T
        rho = np.linalg.norm(offset, axis=-1)
        z = np.where(rho <= self._grid[-1], Polynomial(self.polynomial)(rho), np.nan)
        return _ray(offset / z[..., None])

    def resized(self, width: int, height: int) -> OmnidirectionalCamera:
        """Return the camera of the same view at another size; pixel centres stay pixel centres."""
        sx, sy = width / self.width, height / self.height
        c, d, e = self.stretch
        # rho is measured in rows, so that the matrix keeps its 1 when columns and rows shrink differently.
        polynomial = tuple(a * sy ** (1 - power) for power, a in enumerate(self.polynomial))
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return OmnidirectionalCamera(polynomial, cx, cy, width, height, (c * sx / sy, d * sx / sy, e))

    def cropped(self, x: int, y: int, width: int, height: int) -> OmnidirectionalCamera:
        """Return the camera of the part (width, height) of the image whose top-left pixel is (x, y)."""
        return replace(self, cx=self.cx - x, cy=self.cy - y, width=width, height=height)


def _on_plane(points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, dtype=np.float64)
    return points[..., :2] / np.where(points[..., 2:] > 0, points[..., 2:], np.nan)


def _ray(xy: np.ndarray) -> np.ndarray:
    return np.concatenate([xy, np.where(np.isfinite(xy[..., :1]), 1.0, np.nan)], -1)


def _with_radius(xy: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return `xy` (..., 2) moved along its direction to `radius` (...); the origin stays, NaN spreads."""
    length = np.linalg.norm(xy, axis=-1)
    scale = np.divide(radius, length, out=np.where(np.isfinite(radius), 1.0, np.nan), where=length > 0)
    return xy * scale[..., None]


def _while_increasing(function: _Function, grid: np.ndarray, most: float = np.inf) -> np.ndarray:
    """Return the part of `grid` over which `function` increases up to `most`, its end moved to where it stops."""
    with np.errstate(divide="ignore", invalid="ignore"):
        value = function(grid)
        stops = np.flatnonzero(~((np.diff(value) > 0) & (value[1:] <= most)))
        if not stops.size:
            return grid
        # A maximum may be in the interval before the first decrease.
        first = max(int(stops[0]) - 1, 0)
        low, high = grid[first], grid[first + 2]
        for _ in range(_MAX_STEPS):
            middle = 0.5 * (low + high)
            here, ahead = function(middle + np.array([0, _SMALL_STEP * grid[-1]]))
            low, high = (middle, high) if value[first] < here < ahead <= most else (low, middle)
    return np.append(grid[: first + 1], low)


def _invert_increasing(function: _Function, grid: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return x with function(x) = values (any shape), NaN outside the range of `function` over `grid` (ascending)."""
    # Its import takes as long as that of scipy's other parts; pinhole cameras need none of it.
    from scipy.optimize.elementwise import find_root

    table = function(grid)
    inside = (values >= table[0]) & (values <= table[-1])
    values = np.where(inside, values, table[0])
    cell = np.clip(np.searchsorted(table, values, side="right") - 1, 0, len(grid) - 2)
    found = find_root(lambda x, value: function(x) - value, (grid[cell], grid[cell + 1]), args=(values,))
    return np.where(inside, found.x, np.nan)
