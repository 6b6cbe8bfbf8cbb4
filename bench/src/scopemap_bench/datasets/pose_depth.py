"""Whether poses and depth belong together: the depth of a frame, moved by the poses, against the depth of a later one.

The same is done with the motion that other conventions would give: a wrong convention shows by fitting far better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.geometry.se3 import inverse, transform

LAGS = (10, 30, 90)
LEAST_OVERLAP = 0.2
_KEPT_EVERY = 5
_MOST_POINTS = 20_000
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_LEFT_HANDED = np.diag([1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Convention:
    """One way to read a pair of poses.

    code : of the finding. looks_like : what the poses look like that fit by it. T_b_a : the motion (4, 4) from camera a
    to camera b of the stored poses (T_a, T_b).
    """

    code: str
    looks_like: str
    T_b_a: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _motion(T_world_a: np.ndarray, T_world_b: np.ndarray, factor: float = 1.0) -> np.ndarray:
    """Return the motion of camera-to-world poses, its translation times `factor`."""
    T_b_a = inverse(T_world_b) @ T_world_a
    T_b_a[:3, 3] *= factor
    return T_b_a


def _in_axes(axes: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda T_world_a, T_world_b: axes @ _motion(T_world_a, T_world_b) @ axes


OTHERS = (
    Convention("poses-inverted", "world-to-camera", lambda a, b: b @ inverse(a)),
    Convention("poses-opengl", "those of a camera with y up and z to the back (OpenGL)", _in_axes(_OPENGL)),
    Convention("poses-mirrored", "left-handed (y up, as in Unity)", _in_axes(_LEFT_HANDED)),
    Convention("pose-depth-unit", "metres (or the depth like micrometres)", lambda a, b: _motion(a, b, 1e3)),
    Convention("pose-depth-unit", "micrometres (or the depth like metres)", lambda a, b: _motion(a, b, 1e-3)),
)


@dataclass(frozen=True)
class Agreement:
    """How well depth fits depth through the poses, over pairs of frames that are about `lag` apart.

    lag : number of frames in between, of those with pose and depth; pairs at the beginning are closer.
    pairs : number of pairs of frames that were compared.
    given : median over pairs of the median relative error with the poses as given; infinite where they see no surface
        in common.
    at_rest : the same as if nothing moved; poses that fit no better explain nothing.
    others : the same for each of `OTHERS`.
    """

    lag: int
    pairs: int
    given: float
    at_rest: float
    others: tuple[float, ...]


class PoseDepthTest:
    """Takes frames in order and compares each with some before it; a bounded number of them is held.

    camera : of the depth maps.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera
        self._step = max(1, int(np.ceil(np.sqrt(camera.width * camera.height / _MOST_POINTS))))
        self._rays = camera.rays[:: self._step, :: self._step].astype(np.float64)
        self._kept: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._errors: dict[int, list[list[float]]] = {lag: [] for lag in LAGS}
        self._count = 0

    def add(self, depth_mm: np.ndarray, T_world_camera: np.ndarray) -> None:
        """Take the depth (H, W), mm, NaN = unknown, and the rigid pose (4, 4) of the next frame."""
        now = self._count
        keep = now % _KEPT_EVERY == 0
        for lag in LAGS:
            # A slow camera needs the long lags; few pairs of these suffice.
            if now and (lag == LAGS[0] or (keep and now >= lag)):
                depth_a_mm, T_world_a = self._kept[max(now - lag, 0) // _KEPT_EVERY * _KEPT_EVERY]
                points = self._rays * depth_a_mm[:: self._step, :: self._step, None]
                motions = [_motion(T_world_a, T_world_camera), np.eye(4)]
                motions += [convention.T_b_a(T_world_a, T_world_camera) for convention in OTHERS]
                self._errors[lag].append([self._error(transform(T_b_a, points), depth_mm) for T_b_a in motions])
        if keep:
            self._kept[now] = (depth_mm, T_world_camera)
            self._kept.pop(now - max(LAGS), None)
        self._count += 1

    @property
    def near_errors(self) -> list[float]:
        """Error as given of each frame but the first against one about 10 before it, as in `Agreement`."""
        return [errors[0] for errors in self._errors[LAGS[0]]]

    @property
    def agreements(self) -> tuple[Agreement, ...]:
        """What was found so far, by lag; nothing of lags that no pair has."""
        medians = {lag: np.median(errors, axis=0).tolist() for lag, errors in self._errors.items() if errors}
        return tuple(Agreement(lag, len(self._errors[lag]), m[0], m[1], tuple(m[2:])) for lag, m in medians.items())

    def _error(self, points: np.ndarray, depth_mm: np.ndarray) -> float:
        """Return the median relative error along the axis of points (h, w, 3), infinite without enough overlap."""
        u, v = np.moveaxis(self._camera.project(points), -1, 0)
        # OpenCV's fixed-point coordinates hold neither NaN nor what is far outside.
        u, v = (np.clip(np.nan_to_num(w, nan=-9.0), -9.0, 16_000.0).astype(np.float32) for w in (u, v))
        there_mm = cv2.remap(depth_mm, u, v, cv2.INTER_LINEAR, borderValue=float("nan"))
        seen = (there_mm > 0) & np.isfinite(there_mm) & (points[..., 2] > 0)
        if seen.sum() < LEAST_OVERLAP * max(np.isfinite(points[..., 2]).sum(), 1):
            return float("inf")
        return float(np.median(np.abs(points[..., 2][seen] / there_mm[seen] - 1)))
