"""Differences of two depth maps of one scene: at the same pixel, along the flow, and after the camera's motion.

Pure functions of one pair of frames; `consistency` applies them to a sequence.

- OPW and rTC: Khan et al., "Temporally consistent online depth estimation in dynamic scenes", WACV 2023, in the form of
  facebookresearch/TemporallyConsistentDepth, `eval/metrics.py`.
- TAE: Chen et al., "Video Depth Anything", arXiv 2501.12375, in the form of its `benchmark/eval/eval_tae.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape
from scopemap.geometry.se3 import inverse
from scopemap.geometry.warp import moved_depth

_RTC_RATIO = 1.01


@dataclass(frozen=True)
class DepthChange:
    """Difference of consecutive depths: the mean over pairs of each pair's mean over pixels; NaN where there are none.

    Attributes
    ----------
    pairs : pairs of frames with a pixel that counts.
    mean_mm : mean |a - b|; relative : mean |a - b| / b, b of the current frame.
    rtc : share of pixels, 0..1, with max(a/b, b/a) strictly below 1.01; higher is better.
    """

    pairs: int
    mean_mm: float
    relative: float
    rtc: float


def depth_change(other_mm: np.ndarray, current_mm: np.ndarray, counted: np.ndarray | None = None) -> DepthChange:
    """Compare two depth maps (H, W), mm, NaN = unknown, where both are positive and `counted` (H, W) bool is True."""
    check_shape("other_mm", other_mm, np.shape(current_mm))
    both = (other_mm > 0) & (current_mm > 0)
    if counted is not None:
        both &= counted
    if not both.any():
        return DepthChange(0, *[float("nan")] * 3)
    a, b = other_mm[both].astype(np.float64), current_mm[both].astype(np.float64)
    apart = np.abs(a - b)
    near = np.maximum(a, b) < _RTC_RATIO * np.minimum(a, b)
    return DepthChange(1, float(np.mean(apart)), float(np.mean(apart / b)), float(np.mean(near)))


def mean_change(changes: Sequence[DepthChange]) -> DepthChange:
    """Return the mean over pairs of frames; pairs without a pixel are left out."""
    kept = np.array([astuple(change) for change in changes if change.pairs > 0])
    if not len(kept):
        return DepthChange(0, *[float("nan")] * 3)
    return DepthChange(int(kept[:, 0].sum()), *map(float, kept[:, 1:].mean(axis=0)))


def seen_from(depth_mm: np.ndarray, camera: PinholeCamera, T_other_camera: np.ndarray) -> np.ndarray:
    """Return, at each pixel of (H, W), the depth mm of its point in the other camera; NaN unknown or behind."""
    return moved_depth(depth_mm, np.zeros((*depth_mm.shape, 2), dtype=np.float32), camera, T_other_camera)


def projected_depth(depth_mm: np.ndarray, camera: PinholeCamera, T_other_camera: np.ndarray) -> np.ndarray:
    """Return the depth map (H, W) float32, mm, that the other camera sees of this one's points; NaN where none falls.

    As in TAE's code: positions are rounded to pixels, the last point written to a pixel stays, whichever is nearer, and
    points count as inside by their column and row alone; a pixel that a point behind the camera took is empty.
    """
    # Rows of (3, H W): contiguous coordinates are several times faster than points side by side.
    rays = np.ascontiguousarray(camera.rays.reshape(-1, 3).T)
    T = T_other_camera.astype(np.float32)
    x, y, z = (T[:3, :3] @ rays) * depth_mm.astype(np.float32).ravel() + T[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.rint(np.float32(camera.fx) * x / z + np.float32(camera.cx))
        v = np.rint(np.float32(camera.fy) * y / z + np.float32(camera.cy))
        inside = (depth_mm.ravel() > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    splat = np.zeros(depth_mm.shape, dtype=np.float32)
    splat[v[inside].astype(np.int32), u[inside].astype(np.int32)] = z[inside]
    return np.where(splat > 0, splat, np.float32(np.nan))


def alignment_errors(
    depth_previous_mm: np.ndarray, depth_current_mm: np.ndarray, camera: PinholeCamera, T_current_previous: np.ndarray
) -> tuple[float, float]:
    """Return TAE's two errors of a pair, forth and back: mean |projected - d| / d, d of the frame projected into.

    NaN where no pixel can be compared (the public code counts 0 there, which favours methods without depth). TAE is 100
    times the mean of these over both directions and all pairs. The public protocol first fits scale and shift to the
    truth and clips depth to the data set's range; pass such depth to get its figure.

    Parameters
    ----------
    depth_previous_mm, depth_current_mm : (H, W), NaN = unknown or masked; such pixels are neither moved nor compared.
    camera : of both frames.
    T_current_previous : (4, 4), takes points of the previous camera to the current one.
    """
    check_shape("depth_previous_mm", depth_previous_mm, (camera.height, camera.width))
    check_shape("depth_current_mm", depth_current_mm, (camera.height, camera.width))
    forth = depth_change(projected_depth(depth_previous_mm, camera, T_current_previous), depth_current_mm)
    back = depth_change(projected_depth(depth_current_mm, camera, inverse(T_current_previous)), depth_previous_mm)
    return forth.relative, back.relative
