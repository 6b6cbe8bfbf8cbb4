"""Photometric and point-to-plane residuals of tracking, and their normal equations, in one pass over the pixels.

For a reference pixel p with depth, X = depth * ray(p) and X' = T_current_reference X, each channel c of the images has

    r_c(p) = C_c(project(X')) - (gain * L(p) * R_c(p) + bias),      L(p) = ((cos' / cos) (|X| / |X'|)^2)^gamma

(equation 5 of arXiv 2508.11282, whose p' is project(X'); gain, bias and L are ours, and so is the depth of the
reference in X). R, C are the reference and the current image; C is sampled bilinearly, and its gradient is the exact
derivative of that interpolation, so that Jacobians agree with finite differences. L is the change of brightness by the
lamp, which moves with the camera (cos: of incidence; gamma: of the image's tone curve). With the tangent plane m . X =
1 it is cos' / cos = (1 + m . R^T t) |X| / |X'|; m follows from the gradient of inverse depth. A locally normalised
channel is independent of illumination: it has neither gain nor bias nor L. Parameters of the normal equations, in this
order: rotation (3, rad) and translation (3, in units of `unit_mm`) of a perturbation exp(xi) T_current_reference, gain,
bias.

Where the current depth D is measured, a geometric residual is added: the distance from X' to the tangent plane of D
at project(X'), over `unit_mm` (point to plane: Chen and Medioni, 1992, with projective data association):

    r_d(p) = (D(project(X')) - z') / (|grad (D(project(X')) - z')| unit_mm)

The kernels use one thread: a pass takes a few milliseconds, and starting threads fifty times a frame costs more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.kernels import (
    Bool_1d,
    Float32_2d,
    Float32_3d,
    Float64_1d,
    Float64_2d,
    inner_kernel,
    kernel,
)

PARAMETERS = 8  # of an alignment: rotation, translation, gain and bias
_MAX_SURFACE_SPREAD = 0.1  # by hand: of four neighbouring depths on one surface, relative
_MAX_DEPTH_DIFFERENCE = 0.1  # by hand: of associated points, relative


class PyramidLevel(NamedTuple):
    """One image of one pyramid level, the input of the kernels.

    channels : (C, H, W) float32; `Loss` has the parameters of each.
    weight : (H, W) float32, 0 where a pixel must not be used; the current image's 0 or 1.
    slope : (H, W, 2) float32, 1/mm: derivative of inverse depth along the ray's x and y; 0 = parallel to the image,
    or unknown.
    depth_mm : (H, W) float32, NaN = unknown (the current's is read for the geometric residual only).
    intrinsics : (4,) float64 fx, fy, cx, cy in px of this level.
    """

    channels: Float32_3d
    weight: Float32_2d
    depth_mm: Float32_2d
    slope: Float32_3d
    intrinsics: Float64_1d


class Loss(NamedTuple):
    """Robust loss of each channel: 0.5 (r/s)^2 for |r| <= threshold * s, linear beyond (Huber).

    sigma : (C,) float64, robust standard deviation s of each channel's residuals. threshold : in units of s.
    share : (C,) float64, weight of each channel.
    lit : (C,) bool, whether gain, bias and the lamp apply to the channel. gamma : exponent of the lamp, 0 = no lamp.
    depth_sigma, depth_share : sigma and weight of the geometric residual; share 0: none.
    """

    sigma: Float64_1d
    threshold: float
    share: Float64_1d
    lit: Bool_1d
    gamma: float
    depth_sigma: float = 1.0
    depth_share: float = 0.0


class NormalEquations(NamedTuple):
    """Weighted means over the pixels that project into the current image.

    hessian : (8, 8) float64, mean of w J^T J. gradient : (8,) float64, mean of w J^T r.
    cost : mean loss. weight : sum of the pixels' weights.
    """

    hessian: np.ndarray
    gradient: np.ndarray
    cost: float
    weight: float


@inner_kernel
def _unprojected(depth_mm, K, row, column):  # type: ignore[no-untyped-def]
    """Point X of a reference pixel; K: intrinsics."""
    depth = float(depth_mm[row, column])
    return depth * (column - K[2]) / K[0], depth * (row - K[3]) / K[1], depth


@inner_kernel
def _projected(point, T, G, usable):  # type: ignore[no-untyped-def]
    """Return X', its projection (offset in its cell; the cell's column and row), and its weight (0 = outside)."""
    X, Y, Z = point
    x = T[0, 0] * X + T[0, 1] * Y + T[0, 2] * Z + T[0, 3]
    y = T[1, 0] * X + T[1, 1] * Y + T[1, 2] * Z + T[1, 3]
    z = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * Z + T[2, 3]
    # Also false where depth is NaN.
    if not z >= 1e-3 * Z > 0.0:
        return (x, y, z), (0.0, 0.0, 0, 0), 0.0
    u, v = G[0] * x / z + G[2], G[1] * y / z + G[3]
    h, w = usable.shape
    if not (0.0 <= u < w - 1 and 0.0 <= v < h - 1):
        return (x, y, z), (0.0, 0.0, 0, 0), 0.0
    i, j = int(u), int(v)
    weight = min(usable[j, i], usable[j, i + 1], usable[j + 1, i], usable[j + 1, i + 1])
    return (x, y, z), (u - i, v - j, i, j), float(weight)


@inner_kernel
def _bilinear(image, c, place):  # type: ignore[no-untyped-def]
    """Value of channel c and its exact derivatives along x and y."""
    a, b, i, j = place
    i00, i10 = float(image[c, j, i]), float(image[c, j, i + 1])
    i01, i11 = float(image[c, j + 1, i]), float(image[c, j + 1, i + 1])
    top, bottom = i00 + a * (i10 - i00), i01 + a * (i11 - i01)
    return top + b * (bottom - top), (1 - b) * (i10 - i00) + b * (i11 - i01), bottom - top


@inner_kernel
def _light(point, moved, slope, T, gamma):  # type: ignore[no-untyped-def]
    """Return L of a point X with slope (a, b) that is now at X', and -d ln L / dX' for translations."""
    (X, Y, Z), (x, y, z), (a, b) = point, moved, slope
    # The plane R m in the current camera, and 1 + m . R^T t.
    c = (1.0 - a * X - b * Y) / Z
    mx = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c
    my = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c
    mz = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c
    lift = 1.0 + mx * T[0, 3] + my * T[1, 3] + mz * T[2, 3]
    if not 0.3 < lift < 3.0:  # a plane seen from its edge or from behind: ignore its tilt
        mx, my, mz, lift = 0.0, 0.0, 0.0, 1.0
    square = x * x + y * y + z * z
    nearer = (X * X + Y * Y + Z * Z) / square
    lamp = (nearer * np.sqrt(nearer) * lift) ** gamma
    kx = gamma * (3.0 * x / square - mx / lift)
    ky = gamma * (3.0 * y / square - my / lift)
    return lamp, (kx, ky, gamma * (3.0 * z / square - mz / lift))


@inner_kernel
def _plane_distance(depth, moved, place, G):  # type: ignore[no-untyped-def]
    """Distance of X' from the tangent plane of the current depth (1, H, W), mm, its derivative; NaN across an edge."""
    (x, y, z), (_, _, i, j) = moved, place
    d00, d10 = float(depth[0, j, i]), float(depth[0, j, i + 1])
    d01, d11 = float(depth[0, j + 1, i]), float(depth[0, j + 1, i + 1])
    nearest, farthest = min(d00, d10, d01, d11), max(d00, d10, d01, d11)
    # Also false where any depth is NaN.
    if not (
        farthest - nearest < _MAX_SURFACE_SPREAD * nearest
        and abs(d00 + d11 + d10 + d01 - 4.0 * z) < 4.0 * _MAX_DEPTH_DIFFERENCE * z
    ):
        return np.nan, (0.0, 0.0, 0.0)
    D, du, dv = _bilinear(depth, 0, place)
    gx, gy = du * G[0] / z, dv * G[1] / z
    gz = -(gx * x + gy * y) / z - 1.0
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    return (D - z) / length, (gx / length, gy / length, gz / length)


@kernel
def depth_residuals(
    reference: PyramidLevel, current: PyramidLevel, T_current_reference: Float64_2d, unit_mm: float
) -> np.ndarray:
    """Return the geometric residual (H, W) float32 on the reference's grid, NaN where there is none."""
    # Outside the loop: numba counts references of arrays that are read from a tuple.
    depth_mm, weights, K, T = reference.depth_mm, reference.weight, reference.intrinsics, T_current_reference
    current_mm, usable, G = np.expand_dims(current.depth_mm, 0), current.weight, current.intrinsics
    h, w = weights.shape
    out = np.full((h, w), np.nan, np.float32)
    for row in range(h):
        for column in range(w):
            if weights[row, column] > 0.0:
                moved, place, there = _projected(_unprojected(depth_mm, K, row, column), T, G, usable)
                if there > 0.0:
                    out[row, column] = _plane_distance(current_mm, moved, place, G)[0] / unit_mm
    return out


@kernel
def residual_images(
    reference: PyramidLevel, current: PyramidLevel, T_current_reference: Float64_2d, affine: Float64_1d, loss: Loss
) -> np.ndarray:
    """Return residuals (C, H, W) float32 on the reference's grid, NaN where a pixel is not used."""
    depth_mm, weights, K, T = reference.depth_mm, reference.weight, reference.intrinsics, T_current_reference
    shown, slope, lit, gamma = reference.channels, reference.slope, loss.lit, loss.gamma
    image, usable, G = current.channels, current.weight, current.intrinsics
    channels, h, w = shown.shape
    out = np.full((channels, h, w), np.nan, np.float32)
    for row in range(h):
        for column in range(w):
            if not weights[row, column] > 0.0:
                continue
            point = _unprojected(depth_mm, K, row, column)
            moved, place, there = _projected(point, T, G, usable)
            if not there > 0.0:
                continue
            lamp, _ = _light(point, moved, (slope[row, column, 0], slope[row, column, 1]), T, gamma)
            for c in range(channels):
                expected = float(shown[c, row, column])
                if lit[c]:
                    expected = affine[0] * lamp * expected + affine[1]
                out[c, row, column] = _bilinear(image, c, place)[0] - expected
    return out


@kernel
def compared_pixels(
    reference: PyramidLevel, current: PyramidLevel, T_current_reference: Float64_2d
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the last channel's expected values, residuals (N,) float32, and the number of usable pixels."""
    depth_mm, weights, K, T = reference.depth_mm, reference.weight, reference.intrinsics, T_current_reference
    image, usable, G = current.channels[-1:], current.weight, current.intrinsics
    shown = reference.channels[-1]
    h, w = weights.shape
    expected, residuals = np.empty(h * w, np.float32), np.empty(h * w, np.float32)
    count = usable_count = 0
    for row in range(h):
        for column in range(w):
            if not (weights[row, column] > 0.0 and np.isfinite(depth_mm[row, column])):
                continue
            usable_count += 1
            _, place, there = _projected(_unprojected(depth_mm, K, row, column), T, G, usable)
            if there > 0.0:
                expected[count] = shown[row, column]
                residuals[count] = _bilinear(image, 0, place)[0] - expected[count]
                count += 1
    return expected[:count], residuals[:count], usable_count


@inner_kernel
def _huber(r, s, threshold, weight):  # type: ignore[no-untyped-def]
    """Cost and information of a residual."""
    size, information = abs(r), weight / (s * s)
    if size <= threshold * s:
        return 0.5 * information * r * r, information
    return information * threshold * s * (size - 0.5 * threshold * s), information * threshold * s / size


@inner_kernel
def _rotation_derivative(moved, g):  # type: ignore[no-untyped-def]
    """Derivative by rotation, x' cross g, from the derivative g by X'."""
    (x, y, z), (gx, gy, gz) = moved, g
    return y * gz - z * gy, z * gx - x * gz, x * gy - y * gx


@inner_kernel(fastmath={"reassoc", "contract"})
def _add(hessian, gradient, J, r, information, count):  # type: ignore[no-untyped-def]
    """Add the first `count` residuals r (N,) with derivatives J (8, N); fastmath vectorises the sums."""
    for k in range(PARAMETERS):
        total = 0.0
        for n in range(count):
            total += information[n] * J[k, n] * r[n]
        gradient[k] += total
        for m in range(k, PARAMETERS):
            total = 0.0
            for n in range(count):
                total += information[n] * J[k, n] * J[m, n]
            hessian[k, m] += total


@kernel
def _accumulate(
    reference: PyramidLevel, current: PyramidLevel, T: Float64_2d, affine: Float64_1d, loss: Loss, unit_mm: float
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Sums over all pixels: upper triangle of the hessian (8, 8), gradient (8,), cost, weight."""
    depth_mm, weights, K = reference.depth_mm, reference.weight, reference.intrinsics
    shown, slope, lit, gamma = reference.channels, reference.slope, loss.lit, loss.gamma
    image, usable, G = current.channels, current.weight, current.intrinsics
    current_mm, sigma, share = np.expand_dims(current.depth_mm, 0), loss.sigma, loss.share
    channels, h, w = shown.shape
    hessian, gradient = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    total_cost = total_weight = 0.0
    # The residuals of a row of pixels.
    size = (channels + 1) * w
    J, r, information = np.zeros((PARAMETERS, size)), np.zeros(size), np.zeros(size)
    for row in range(h):
        n = 0
        for column in range(w):
            if not weights[row, column] > 0.0:
                continue
            point = _unprojected(depth_mm, K, row, column)
            moved, place, there = _projected(point, T, G, usable)
            weight = there * float(weights[row, column])
            if not weight > 0.0:
                continue
            total_weight += weight
            x, y, z = moved
            if loss.depth_share > 0.0:
                gap, normal = _plane_distance(current_mm, moved, place, G)
                if np.isfinite(gap):
                    r[n] = gap / unit_mm
                    cost, information[n] = _huber(r[n], loss.depth_sigma, loss.threshold, loss.depth_share * weight)
                    total_cost += cost
                    J[0, n], J[1, n], J[2, n] = _rotation_derivative((x / unit_mm, y / unit_mm, z / unit_mm), normal)
                    J[3, n], J[4, n], J[5, n] = normal
                    J[6, n], J[7, n] = 0.0, 0.0
                    n += 1
            lamp, dims = _light(point, moved, (slope[row, column, 0], slope[row, column, 1]), T, gamma)
            for c in range(channels):
                if share[c] <= 0.0:
                    continue
                value, du, dv = _bilinear(image, c, place)
                expected, k = float(shown[c, row, column]), 0.0
                r[n], J[6, n], J[7, n] = value - expected, 0.0, 0.0
                if lit[c]:
                    expected *= lamp
                    k = affine[0] * expected
                    r[n], J[6, n], J[7, n] = value - k - affine[1], -expected, -1.0
                cost, information[n] = _huber(r[n], sigma[c], loss.threshold, share[c] * weight)
                total_cost += cost
                gx, gy = du * G[0] / z, dv * G[1] / z
                gz = -(gx * x + gy * y) / z
                J[0, n], J[1, n], J[2, n] = _rotation_derivative(moved, (gx, gy, gz))
                J[3, n], J[4, n] = unit_mm * (gx + k * dims[0]), unit_mm * (gy + k * dims[1])
                J[5, n] = unit_mm * (gz + k * dims[2])
                n += 1
        _add(hessian, gradient, J, r, information, n)
    return hessian, gradient, total_cost, total_weight


def normal_equations(
    reference: PyramidLevel,
    current: PyramidLevel,
    T_current_reference: np.ndarray,
    affine: np.ndarray,
    loss: Loss,
    unit_mm: float,
) -> NormalEquations:
    """Linearise the loss around a motion (4, 4) and a brightness change (gain, bias); translation in `unit_mm`."""
    hessian, gradient, cost, weight = _accumulate(reference, current, T_current_reference, affine, loss, unit_mm)
    count = max(weight, 1e-9)
    hessian += np.triu(hessian, 1).T
    return NormalEquations(hessian / count, gradient / count, cost / count, weight)
