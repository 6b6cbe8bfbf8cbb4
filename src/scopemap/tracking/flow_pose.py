"""The motion that optical flow asks for: points of the frame before, seen again, against where they would be.

Photometric tracking is precise where it starts close by. Tissue that rushes past at tens of pixels a frame is beyond
its reach, and it settles somewhere without a word; flow bridges such gaps, if coarsely. So flow has the last word where
a photometric pose contradicts it (`pose_by_flow`).

Where depth is predicted, shading that moves with the lamp pulls the photometric pose along, a little on every frame.
Corners of the keyframe hold on to the tissue: followed by flow, they set its pose right (`refined_by_corners`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.frame import Correspondences2D3D
from scopemap.geometry.least_squares import RAYLEIGH_TO_SIGMA
from scopemap.geometry.se3 import orthonormalised, se3_exp

_LEAST_POINTS = 50
_STEPS = 30
_SMALL_STEP = 1e-5
_LEAST_SIGMA_PX = 0.1
_CORNER_SIGMA_PX = 0.5
_LEAST_SPREAD = 0.01


@dataclass(frozen=True)
class FlowPose:
    """What flow says of the motion since the frame before.

    Attributes
    ----------
    T_current_previous : (4, 4). error_px : median distance of the points from where they are seen, px; large where no
    motion explains most of them.
    """

    T_current_previous: np.ndarray
    error_px: float


def pose_by_flow(seen: Correspondences2D3D, camera: PinholeCamera) -> FlowPose | None:
    """Return the motion that brings the points to where they are seen, or None where they are too few to tell.

    Gauss-Newton from standing still, with Cauchy weights whose scale is the robust deviation of the errors at each
    step: what moves by itself, and what flow got wrong, fades out.
    """
    if len(seen.points_mm) < _LEAST_POINTS:
        return None
    T, unit_mm = np.eye(4), float(np.median(seen.points_mm[:, 2]))
    for _ in range(_STEPS):
        errors, jacobians, ahead = _linearised(seen, camera, T, unit_mm)
        if ahead.sum() < _LEAST_POINTS:
            return None
        square = (errors**2).sum(1)
        weight = np.where(ahead, 1 / (1 + square / (2 * _sigma_px(square[ahead])) ** 2), 0.0)
        T, length = _moved(T, jacobians, jacobians * weight[:, None, None], errors, unit_mm)
        if not np.isfinite(T).all():
            return None
        if length < _SMALL_STEP:
            break
    return FlowPose(T, flow_error_px(seen, camera, T))


def refined_by_corners(
    seen: Correspondences2D3D, camera: PinholeCamera, T_current_host: np.ndarray, depth_share: float
) -> np.ndarray | None:
    """Return the motion (4, 4), close to the one given, that a keyframe's corners ask for; None where they are too few.

    An error of depth moves a point along its epipolar line alone: there a corner counts less by the variance that a
    relative error of `depth_share` adds, across it fully. So turns, which move everything alike, are held by all
    corners, and wrong depth does not bend them. Cauchy weights, as above.
    """
    if len(seen.points_mm) < _LEAST_POINTS:
        return None
    T, unit_mm = T_current_host, float(np.median(seen.points_mm[:, 2]))
    for _ in range(_STEPS):
        errors, jacobians, ahead = _linearised(seen, camera, T, unit_mm)
        if ahead.sum() < _LEAST_POINTS:
            return None
        # d(pixel) / d(ln depth): the point moves along its ray, turned to the current camera.
        along = np.einsum("nij,nj->ni", jacobians[:, :, 3:] / unit_mm, seen.points_mm @ T[:3, :3].T)
        covariance = _CORNER_SIGMA_PX**2 * np.eye(2) + depth_share**2 * along[:, :, None] * along[:, None, :]
        information = np.linalg.inv(covariance)
        square = np.einsum("ni,nij,nj->n", errors, information, errors)
        spread = max(RAYLEIGH_TO_SIGMA**2 * float(np.median(square[ahead])), _LEAST_SPREAD)
        weight = np.where(ahead, 1 / (1 + square / (4 * spread)), 0.0)
        weighted = np.einsum("n,nij,njk->nik", weight, information, jacobians)
        T, length = _moved(T, jacobians, weighted, errors, unit_mm)
        if not np.isfinite(T).all():
            return None
        if length < _SMALL_STEP:
            break
    return orthonormalised(T)


def flow_error_px(seen: Correspondences2D3D, camera: PinholeCamera, T_current_previous: np.ndarray) -> float:
    """Return the median distance of the points, moved by a motion (4, 4), from where flow sees them, px."""
    errors, _, ahead = _linearised(seen, camera, T_current_previous, 1.0)
    return float(np.median(np.where(ahead, np.linalg.norm(errors, axis=1), np.inf)))


def _moved(
    T: np.ndarray, jacobians: np.ndarray, weighted: np.ndarray, errors: np.ndarray, unit_mm: float
) -> tuple[np.ndarray, float]:
    """Return the motion after a Gauss-Newton step, and the step's length; `weighted` (N, 2, 6) are W J."""
    hessian = np.einsum("nij,nik->jk", jacobians, weighted)
    step = -np.linalg.lstsq(hessian, np.einsum("nij,ni->j", weighted, errors), rcond=1e-12)[0]
    return se3_exp(step * np.repeat([1.0, unit_mm], 3)) @ T, float(np.linalg.norm(step))


def _sigma_px(square: np.ndarray) -> float:
    return max(RAYLEIGH_TO_SIGMA * float(np.sqrt(np.median(square))), _LEAST_SIGMA_PX)


def _linearised(
    seen: Correspondences2D3D, camera: PinholeCamera, T: np.ndarray, unit_mm: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (N, 2) px, derivatives (N, 2, 6) by a twist in rad and `unit_mm`, and which points (N,) are ahead."""
    moved = seen.points_mm @ T[:3, :3].T + T[:3, 3]
    ahead = moved[:, 2] > 1e-3 * np.linalg.norm(moved, axis=1)
    x, y, z = moved[:, 0], moved[:, 1], np.where(ahead, moved[:, 2], 1.0)
    u, v, zero = camera.fx / z, camera.fy / z, np.zeros(len(z))
    by_point = np.stack([np.stack([u, zero, -u * x / z], -1), np.stack([zero, v, -v * y / z], -1)], 1)
    projected = np.stack([u * x + camera.cx, v * y + camera.cy], 1)
    # d(exp(w) X)/dw = -hat(X), and a row vector times -hat(X) is the cross product X x row.
    jacobians = np.concatenate([np.cross(moved[:, None], by_point), unit_mm * by_point], -1)
    return projected - seen.pixels, jacobians, ahead
