"""Kernels of multi-view depth: projection into another frame, flow split along epipolar lines, combined estimates.

Arrays are (H, W) float32 unless stated otherwise; T (4, 4) takes a point of the frame, mm, to the other's camera.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.kernels import (
    Bool_1d,
    Bool_2d,
    Float32_2d,
    Float32_3d,
    Float64_2d,
    Float64_3d,
    Int64_1d,
    inner_kernel,
    kernel,
)
from scopemap.engine.geometry.median import median

VIEW_SIGMA = 0.03  # by hand
"""Standard deviation of ln depth from one neighbour that all pixels share: errors of poses."""

_MAX_FLOW_PX = 20.0  # by hand: more is a wrong match
_MAX_PROPAGATED = 0.25  # by hand: larger differences between a frame's depth and its keyframe's are an occlusion
_CAUCHY = 2.0  # by hand: residuals of that many standard deviations get half the weight
_ITERATIONS = 4  # by hand: reweightings
_LEAST_MM = 1e-3  # guard: division by z
_OUTSIDE_PX = -1e4  # a place outside of every picture


class Intrinsics(NamedTuple):
    """Focal lengths and principal point of a pinhole camera, px."""

    fx: float
    fy: float
    cx: float
    cy: float


class Projection(NamedTuple):
    """Pixels of a frame seen by another: position there, px; its change per unit of ln depth, px; whether usable."""

    x: Float32_2d
    y: Float32_2d
    slope_x: Float32_2d
    slope_y: Float32_2d
    usable: Float32_2d


@inner_kernel
def _seen_from(T: np.ndarray, depth: float, ray_x: float, ray_y: float) -> tuple[float, float, float]:
    """Return the point at `depth` along a ray (x, y, 1), turned into the other camera, without its translation."""
    x = depth * (T[0, 0] * ray_x + T[0, 1] * ray_y + T[0, 2])
    y = depth * (T[1, 0] * ray_x + T[1, 1] * ray_y + T[1, 2])
    return x, y, depth * (T[2, 0] * ray_x + T[2, 1] * ray_y + T[2, 2])


@kernel
def project(depth_mm: Float32_2d, known: Bool_2d, T: Float64_2d, camera: Intrinsics) -> Projection:
    """Project a frame's pixels into another; usable: known depth, seen at least 1 px inside, at `known` pixels."""
    height, width = depth_mm.shape
    planes = np.zeros((5, height, width), np.float32)
    places = np.empty((2, width))
    for row in range(height):
        # Without branches, so that it is compiled to vector instructions.
        for col in range(width):
            depth = float(depth_mm[row, col])
            mx, my, mz = _seen_from(T, depth, (col - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
            z = mz + T[2, 3]
            x, y = (mx + T[0, 3]) / z, (my + T[1, 3]) / z
            seen = (depth > 0) & (z > _LEAST_MM)
            u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
            places[0, col], places[1, col] = u if seen else _OUTSIDE_PX, v if seen else _OUTSIDE_PX
            planes[0, row, col], planes[1, row, col] = u if seen else _OUTSIDE_PX, v if seen else _OUTSIDE_PX
            planes[2, row, col] = camera.fx * (mx - x * mz) / z if seen else 0.0
            planes[3, row, col] = camera.fy * (my - y * mz) / z if seen else 0.0
        for col in range(width):
            u, v = places[0, col], places[1, col]
            if 1 <= u <= width - 2 and 1 <= v <= height - 2 and known[int(v + 0.5), int(u + 0.5)]:
                planes[4, row, col] = 1.0
    return Projection(planes[0], planes[1], planes[2], planes[3], planes[4])


@inner_kernel
def _bilinear(image: np.ndarray, i: int, j: int, s: float, t: float) -> float:
    """Return the image between rows i and i + 1, columns j and j + 1, at shares t and s."""
    above = (1 - s) * image[i, j] + s * image[i, j + 1]
    return (1 - t) * above + t * ((1 - s) * image[i + 1, j] + s * image[i + 1, j + 1])


@kernel
def epipolar_error(flow: Float32_3d, seen: Projection) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split the flow (H, W, 2), px, to a neighbour warped by `seen`.

    Returns ln factor of depth, squared change of position per unit of it (0 = unknown), squared offset across, px.
    """
    height, width = seen.usable.shape
    planes = np.zeros((3, height, width), np.float32)
    log_factor, squared, across = planes[0], planes[1], planes[2]
    # Outside the loop: numba counts references of arrays that are read from a tuple.
    x, y, slope_x, slope_y, usable = seen.x, seen.y, seen.slope_x, seen.slope_y, seen.usable
    for row in range(height):
        for col in range(width):
            du, dv = flow[row, col, 0], flow[row, col, 1]
            u, v = col + du, row + dv
            inside = 0 <= u < width - 1 and 0 <= v < height - 1
            if usable[row, col] == 0 or not inside or max(abs(du), abs(dv)) > _MAX_FLOW_PX:
                continue
            i, j = int(v), int(u)
            if usable[i, j] + usable[i, j + 1] + usable[i + 1, j] + usable[i + 1, j + 1] < 4:
                continue
            dx = _bilinear(x, i, j, u - j, v - i) - x[row, col]
            dy = _bilinear(y, i, j, u - j, v - i) - y[row, col]
            gx, gy = slope_x[row, col], slope_y[row, col]
            length = gx * gx + gy * gy
            if length > 0:
                log_factor[row, col] = (gx * dx + gy * dy) / length
                across[row, col] = (gx * dy - gy * dx) ** 2 / length
                squared[row, col] = length
    return log_factor, squared, across


@kernel
def combine(log_factor: Float32_3d, information: Float32_3d) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Combine (N, H, W) estimates by Cauchy's M-estimator.

    Returns ln factor, information, the variance of one estimate, and 1 where that is known.
    """
    count, height, width = log_factor.shape
    planes = np.zeros((4, height, width), np.float32)
    mean, total, scatter, compared = planes[0], planes[1], planes[2], planes[3]
    values, weights, sums = np.empty(width), np.empty(width), np.empty(width)
    for row in range(height):
        # By row, and without branches, so that it is compiled to vector instructions.
        for col in range(width):
            values[col] = 0.0
        for step in range(_ITERATIONS + 1):
            for col in range(width):
                weights[col] = sums[col] = 0.0
            for n in range(count):
                for col in range(width):
                    log, w = log_factor[n, row, col], float(information[n, row, col])
                    w /= 1 + (w if step > 0 else 0.0) * (log - values[col]) ** 2 / _CAUCHY**2
                    weights[col] += w
                    sums[col] += w * log
            for col in range(width):
                values[col] = sums[col] / weights[col] if weights[col] > 0 else 0.0
        for col in range(width):
            value, sum_weight, spread, views = values[col], 0.0, 0.0, 0.0
            for n in range(count):
                w = information[n, row, col]
                views += w > 0
                sum_weight += w
                spread += w * min((log_factor[n, row, col] - value) ** 2, 1.0)
            mean[row, col], total[row, col] = value, weights[col]
            if views > 1:
                scatter[row, col], compared[row, col] = spread / sum_weight * views / (views - 1), 1.0
    return mean, total, scatter, compared


@kernel
def add_comparison(
    total: Float32_3d,
    depth_mm: Float32_2d,
    T: Float64_2d,
    camera: Intrinsics,
    at_mm: Float32_2d,
    at_sigma: Float32_2d,
    weight: float,
) -> None:
    """Compare a frame's depth with the one that another frame has there, at every n-th pixel of a row and a column.

    Adds information times ln of the factor between them, and information, to `total` (2, rows, columns), unless the
    factor tells of an occlusion. at_mm, at_sigma : depth of the other frame, and standard deviation of its ln.
    weight : what its information counts, 0..1.
    """
    step = -(-depth_mm.shape[0] // total.shape[1])
    height, width = at_mm.shape
    for i in range(total.shape[1]):
        for j in range(total.shape[2]):
            row, col = step * i, step * j
            depth = depth_mm[row, col]
            if not depth > 0:
                continue
            x, y, z = _seen_from(T, depth, (col - camera.cx) / camera.fx, (row - camera.cy) / camera.fy)
            z += T[2, 3]
            if z <= _LEAST_MM:
                continue
            u, v = camera.fx * (x + T[0, 3]) / z + camera.cx, camera.fy * (y + T[1, 3]) / z + camera.cy
            if not (1 <= u <= width - 2 and 1 <= v <= height - 2):
                continue
            r, c = int(v), int(u)
            log_factor = np.log(_bilinear(at_mm, r, c, u - c, v - r) / z)
            if abs(log_factor) < _MAX_PROPAGATED:
                information = weight / (_bilinear(at_sigma, r, c, u - c, v - r) ** 2 + VIEW_SIGMA**2)
                total[0, i, j] += information * log_factor
                total[1, i, j] += information


@kernel
def parallax_px(points: Float32_2d, far: Bool_1d, T: Float64_3d, camera: Intrinsics, size: Int64_1d) -> np.ndarray:
    """Return the median parallax, px per unit of ln depth, of points (n, 3) in each other camera, and of the far ones.

    far : (n,) bool. T : (m, 4, 4) to these cameras. size : width and height, px. (m, 2); 0 where a camera sees less
    than half of the points.
    """
    found, slope, slope_far = np.zeros((len(T), 2)), np.empty(len(points)), np.empty(len(points))
    far_points = 0
    for n in range(len(points)):
        far_points += far[n]
    for k in range(len(T)):
        seen, seen_far = 0, 0
        for n in range(len(points)):
            z = points[n, 2]
            mx, my, mz = _seen_from(T[k], z, points[n, 0] / z, points[n, 1] / z)
            depth = mz + T[k, 2, 3]
            if depth <= _LEAST_MM:
                continue
            x, y = (mx + T[k, 0, 3]) / depth, (my + T[k, 1, 3]) / depth
            u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
            if not (0 <= u < size[0] and 0 <= v < size[1]):
                continue
            slope[seen] = np.hypot(camera.fx * (mx - x * mz), camera.fy * (my - y * mz)) / depth
            if far[n]:
                slope_far[seen_far] = slope[seen]
                seen_far += 1
            seen += 1
        if 2 * seen > len(points):
            found[k, 0] = median(slope[:seen])
        if 2 * seen_far > far_points:
            found[k, 1] = median(slope_far[:seen_far])
    return found
