"""Camera motion from 2D-3D correspondences: robust reprojection errors, minimised by dog-leg.

A relative error of depth moves a point along its epipolar line. The covariance of a reprojection error is therefore

    sigma^2 I + (s a)(s a)^T,    a = d(pixel) / d(ln depth),    s: relative standard deviation of depth,

and its inverse follows from Sherman and Morrison. Errors across the line count in full, so that rotations, which move
all points alike, are not biased by wrong depth. By the same covariance errors are significant, or not: where those of
neighbouring points agree and noise does not explain them, the tissue moves on its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.corners import Correspondences2D3D
from scopemap.engine.frame import REGIONS
from scopemap.engine.geometry.kernels import Float64_1d, Float64_2d, kernel
from scopemap.engine.geometry.least_squares import (
    RAYLEIGH_TO_SIGMA,
    DenseModel,
    Options,
    Problem,
    minimise,
    robust_sigma_2d,
)
from scopemap.engine.geometry.se3 import orthonormalised, se3_exp

_MIN_POINTS = 50  # by hand: fewer corners give no pose
_MIN_REGION_POINTS = 4  # by hand: of a region whose motion is measured
_SIGMA_PX = 0.5  # by hand: standard deviation of a matched corner
_MIN_SCALE = 0.1  # guard: of the robust standard deviation
_MAX_RESCALES = 20  # guard: of a scale that does not settle
_OPTIONS = Options()
_SAME_SCALE = 0.01  # by hand: a relative change that is none


def pose_from_correspondences(
    correspondences: Correspondences2D3D, camera: PinholeCamera, T_start: np.ndarray, depth_sigma_share: float
) -> np.ndarray | None:
    """Return T_current_reference (4, 4) of the least robust reprojection error, or None below 50 points in view.

    T_start : (4, 4), first guess. depth_sigma_share : relative standard deviation of the points' depth.
    Cauchy's kernel, whose scale is the robust deviation of the errors, estimated again until it stays.
    """
    points_mm, pixels = correspondences.points_mm, correspondences.pixels
    if len(points_mm) < _MIN_POINTS:
        return None
    unit_mm, T, last_scale = float(np.median(points_mm[:, 2])), T_start, np.inf
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    for _ in range(_MAX_RESCALES):
        projected, along, used = _projected(points_mm, camera, T)
        if used.sum() < _MIN_POINTS:
            return None
        along *= depth_sigma_share
        errors = projected - pixels
        information = 1 / (_SIGMA_PX**2 + (along**2).sum(1))
        square = ((errors**2).sum(1) - information * (errors * along).sum(1) ** 2) / _SIGMA_PX**2
        scale = robust_sigma_2d(np.sqrt(square[used]), _MIN_SCALE)
        if abs(scale - last_scale) < _SAME_SCALE * scale:
            break
        data = points_mm[used], pixels[used], along[used], intrinsics, 2 * scale, unit_mm
        T, last_scale = minimise(_problem(data, unit_mm), T, _OPTIONS).state, scale
    return orthonormalised(T) if np.isfinite(T).all() else None


def reprojection_error_px(correspondences: Correspondences2D3D, camera: PinholeCamera, T: np.ndarray) -> float:
    """Return the median reprojection error of T_current_reference (4, 4), px; points behind count as infinitely far."""
    projected, _, in_front = _projected(correspondences.points_mm, camera, T)
    errors = np.linalg.norm(projected - correspondences.pixels, axis=1)
    return float(np.median(np.where(in_front, errors, np.inf)))


def nonrigidity(
    correspondences: Correspondences2D3D, camera: PinholeCamera, T: np.ndarray, depth_sigma_share: float
) -> np.ndarray:
    """Return by how many standard deviations each region of the picture moves against a rigid scene, `REGIONS` float32.

    T : T_current_reference (4, 4). NaN in regions with fewer than 4 points. It is the length of the region's median
    reprojection error over its covariance, as above; the scatter of the region's errors adds to the matching's noise,
    since false matches scatter and tissue moves as one.
    """
    projected, along, in_front = _projected(correspondences.points_mm, camera, T)
    errors, along = correspondences.pixels - projected, along * depth_sigma_share
    rows, columns = REGIONS
    place = (correspondences.pixels + 0.5) / [camera.width, camera.height] * [columns, rows]
    column, row = np.clip(place.astype(int), 0, [columns - 1, rows - 1]).T
    region = np.where(in_front, row * columns + column, rows * columns)  # what is behind has a region of its own
    count, median = _medians(np.hstack([errors, along]), region, rows * columns + 1)
    error, line = median[:, :2], median[:, 2:]
    _, scatter = _medians(np.linalg.norm(errors - error[region], axis=1)[:, None], region, rows * columns + 1)
    variance = _SIGMA_PX**2 + (RAYLEIGH_TO_SIGMA * scatter[:, 0]) ** 2
    on_line, length = (error * line).sum(1), (line**2).sum(1)
    square = ((error**2).sum(1) - on_line**2 / (variance + length)) / variance
    found = np.where(count >= _MIN_REGION_POINTS, np.sqrt(np.maximum(square, 0.0)), np.nan)
    return found[:-1].reshape(REGIONS).astype(np.float32)


def _medians(values: np.ndarray, group: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the count (G,) and the medians (G, k) of the values (N, k) of each group (N,); NaN of none."""
    count, order = np.bincount(group, minlength=groups), np.argsort(group, kind="stable")
    place = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    padded = np.full((groups, max(int(count.max(initial=0)), 1), values.shape[1]), np.inf)
    padded[group[order], place] = values[order]
    padded.sort(1)
    each, last = np.arange(groups), np.maximum(count - 1, 0)
    middle = (padded[each, last // 2] + padded[each, (last + 1) // 2]) / 2
    return count, np.where(count[:, None] > 0, middle, np.nan)


def _problem(data: tuple[Any, ...], unit_mm: float) -> Problem[np.ndarray]:
    """Problem over T_current_reference; steps are in rad and, for the translation, in `unit_mm`."""
    count = max(len(data[0]), 1)

    def linearise(T: np.ndarray) -> DenseModel:
        hessian, gradient, cost = _normal_equations(T, *data)
        return DenseModel(cost / count, gradient / count, hessian / count)

    def retract(T: np.ndarray, step: np.ndarray) -> np.ndarray:
        return se3_exp(step * np.repeat([1.0, unit_mm], 3)) @ T

    return Problem(linearise, retract)


def _projected(
    points_mm: np.ndarray, camera: PinholeCamera, T: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Projected pixels (N, 2), their derivatives by ln depth (N, 2), and which points (N,) are in front."""
    rotated = points_mm @ T[:3, :3].T
    moved = rotated + T[:3, 3]
    in_front = moved[:, 2] > 1e-3 * np.linalg.norm(moved, axis=1)
    moved[~in_front] = [0.0, 0.0, 1.0]
    focal, xy = np.array([camera.fx, camera.fy]), moved[:, :2] / moved[:, 2:]
    along = focal * (rotated[:, :2] - xy * rotated[:, 2:]) / moved[:, 2:]
    return focal * xy + [camera.cx, camera.cy], along, in_front


@kernel
def _normal_equations(
    T: Float64_2d,
    points_mm: Float64_2d,
    pixels: Float64_2d,
    along: Float64_2d,
    intrinsics: Float64_1d,
    scale: float,
    unit_mm: float,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Summed hessian (6, 6), gradient (6,) and cost of Cauchy-weighted errors; infinite cost behind the camera."""
    fx, fy, cx, cy = intrinsics
    variance, width = _SIGMA_PX**2, scale**2
    hessian, gradient, J, cost = np.zeros((6, 6)), np.zeros(6), np.zeros((2, 6)), 0.0
    for n in range(len(points_mm)):
        X, Y, Z = points_mm[n, 0], points_mm[n, 1], points_mm[n, 2]
        x = T[0, 0] * X + T[0, 1] * Y + T[0, 2] * Z + T[0, 3]
        y = T[1, 0] * X + T[1, 1] * Y + T[1, 2] * Z + T[1, 3]
        z = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * Z + T[2, 3]
        if not z > 1e-3 * np.sqrt(x * x + y * y + z * z):
            return hessian, gradient, np.inf
        u, v = fx / z, fy / z
        e0, e1 = u * x + cx - pixels[n, 0], v * y + cy - pixels[n, 1]
        a0, a1 = along[n, 0], along[n, 1]
        shrink = 1.0 / (variance + a0 * a0 + a1 * a1)
        on_line = a0 * e0 + a1 * e1
        ratio = (e0 * e0 + e1 * e1 - shrink * on_line * on_line) / (variance * width)
        cost += 0.5 * width * np.log1p(ratio)
        weight = 1.0 / ((1.0 + ratio) * variance)
        # Of a perturbation exp(xi) T: rotation, then translation.
        J[0, 0], J[0, 1], J[0, 2] = -u * x * y / z, u * (z + x * x / z), -u * y
        J[1, 0], J[1, 1], J[1, 2] = -v * (z + y * y / z), v * x * y / z, v * x
        J[0, 3], J[0, 5], J[1, 4], J[1, 5] = u * unit_mm, -u * x / z * unit_mm, v * unit_mm, -v * y / z * unit_mm
        for i in range(6):
            line_i = a0 * J[0, i] + a1 * J[1, i]
            gradient[i] += weight * (J[0, i] * e0 + J[1, i] * e1 - shrink * on_line * line_i)
            for j in range(6):
                line_j = a0 * J[0, j] + a1 * J[1, j]
                hessian[i, j] += weight * (J[0, i] * J[0, j] + J[1, i] * J[1, j] - shrink * line_i * line_j)
    return hessian, gradient, cost
