"""The residuals of tracking and their normal equations, fused: one pass over the pixels, nothing per pixel is stored.

For a reference pixel p with depth, X = depth * ray(p) and X' = T_current_reference X, each channel c of the images has

    r_c(p) = C_c(project(X')) - (gain * L(p) * R_c(p) + bias),      L(p) = ((cos' / cos) (|X| / |X'|)^2)^gamma

R, C are the reference and the current image; C is sampled bilinearly, and its gradient is the exact derivative of that
interpolation, so that Jacobians agree with finite differences. L predicts how a point dims as the lamp, which moves
with the camera, moves away and aside (cos: of incidence; gamma: of the image's tone curve). With the tangent plane
m . X = 1 it is cos' / cos = (1 + m . R^T t) |X| / |X'|, and m is read off the gradient of inverse depth. A locally
normalised channel is blind to light: it has neither gain nor bias nor fall-off. Parameters of the normal equations, in
this order: rotation (3, rad) and translation (3, in units of `unit_mm`) of a perturbation exp(xi) T_current_reference,
gain, bias.

Where the current depth D is measured, too, a geometric residual joins them, the distance from X' to the tangent plane
of D where it lands, over `unit_mm` (point to plane: Chen and Medioni, 1992, with projective data association):

    r_d(p) = (D(project(X')) - z') / (|grad (D(project(X')) - z')| unit_mm)

One thread on purpose: a pass is a few milliseconds of work at most, the other core has the networks to do, and waking
threads some fifty times a frame was many times slower than one thread on a busy machine.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

PARAMETERS = 8
_PAIRS = PARAMETERS * (PARAMETERS + 1) // 2
_SUMS = _PAIRS + PARAMETERS + 2  # upper triangle, gradient, cost, weight
_ONE_SURFACE = 0.1  # relative spread of four neighbouring depths that is still one surface
_SAME_PLACE = 0.1  # relative difference of depths that may be the same tissue


class View(NamedTuple):
    """One image of one pyramid level as the kernels want it.

    Attributes
    ----------
    channels : (C, H, W) float32, of which `Loss` says how each is compared.
    weight : (H, W) float32, 0 where a pixel must not be used; the current image's 0 or 1.
    slope : (H, W, 2) float32, 1/mm: derivative of inverse depth along the ray's x and y; 0 = parallel to the image,
    or unknown.
    depth_mm : (H, W) float32, NaN = unknown (the current's is read for the geometric residual only).
    intrinsics : (4,) float64 fx, fy, cx, cy in px of this level.
    """

    channels: np.ndarray
    weight: np.ndarray
    depth_mm: np.ndarray
    slope: np.ndarray
    intrinsics: np.ndarray


class Loss(NamedTuple):
    """How residuals of each channel count: 0.5 (r/s)^2 for |r| <= threshold * s, linear beyond (Huber).

    Attributes
    ----------
    sigma : (C,) float64, robust standard deviation s of each channel's residuals. threshold : in units of s.
    share : (C,) float64, how much each channel counts.
    lit : (C,) bool, whether gain, bias and the lamp apply to the channel. gamma : exponent of the lamp, 0 = no lamp.
    depth_sigma, depth_share : the same of the geometric residual; share 0: none.
    """

    sigma: np.ndarray
    threshold: float
    share: np.ndarray
    lit: np.ndarray
    gamma: float
    depth_sigma: float = 1.0
    depth_share: float = 0.0


class NormalEquations(NamedTuple):
    """Weighted means over the pixels that project into the current image.

    Attributes
    ----------
    hessian : (8, 8) float64, mean of w J^T J. gradient : (8,) float64, mean of w J^T r.
    cost : mean loss. weight : sum of the pixels' weights.
    """

    hessian: np.ndarray
    gradient: np.ndarray
    cost: float
    weight: float


@njit(cache=True, nogil=True, inline="always")
def _land(reference, current, T, row, column):  # type: ignore[no-untyped-def]
    """Where a reference pixel lands: X', place in its cell, cell (column, row), |X|^2, weight (0 = unusable)."""
    nothing = (0.0, 0.0, 1.0, 0.0, 0.0, 0, 0, 1.0, 0.0)
    depth, weight = float(reference.depth_mm[row, column]), float(reference.weight[row, column])
    if weight <= 0.0 or not depth > 0.0:
        return nothing
    K = reference.intrinsics
    X, Y = depth * (column - K[2]) / K[0], depth * (row - K[3]) / K[1]
    x = T[0, 0] * X + T[0, 1] * Y + T[0, 2] * depth + T[0, 3]
    y = T[1, 0] * X + T[1, 1] * Y + T[1, 2] * depth + T[1, 3]
    z = T[2, 0] * X + T[2, 1] * Y + T[2, 2] * depth + T[2, 3]
    if z < 1e-3 * depth:
        return nothing
    G = current.intrinsics
    u, v = G[0] * x / z + G[2], G[1] * y / z + G[3]
    h, w = current.weight.shape
    if not (0.0 <= u < w - 1 and 0.0 <= v < h - 1):
        return nothing
    i, j = int(u), int(v)
    usable = min(current.weight[j, i], current.weight[j, i + 1], current.weight[j + 1, i], current.weight[j + 1, i + 1])
    return x, y, z, u - i, v - j, i, j, X * X + Y * Y + depth * depth, weight * usable


@njit(cache=True, nogil=True, inline="always")
def _bilinear(image, a, b, i, j):  # type: ignore[no-untyped-def]
    """Value at (i + a, j + b) and its exact derivatives along x and y."""
    i00, i10 = float(image[j, i]), float(image[j, i + 1])
    i01, i11 = float(image[j + 1, i]), float(image[j + 1, i + 1])
    top, bottom = i00 + a * (i10 - i00), i01 + a * (i11 - i01)
    return top + b * (bottom - top), (1 - b) * (i10 - i00) + b * (i11 - i01), bottom - top


@njit(cache=True, nogil=True, inline="always")
def _tilt(reference, T, row, column):  # type: ignore[no-untyped-def]
    """Plane m of a reference pixel, turned to the current camera, and 1 + m . R^T t: the lamp's lift off the plane."""
    K = reference.intrinsics
    a, b = float(reference.slope[row, column, 0]), float(reference.slope[row, column, 1])
    c = 1.0 / float(reference.depth_mm[row, column]) - a * (column - K[2]) / K[0] - b * (row - K[3]) / K[1]
    mx = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c
    my = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c
    mz = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c
    lift = 1.0 + mx * T[0, 3] + my * T[1, 3] + mz * T[2, 3]
    if 0.3 < lift < 3.0:
        return mx, my, mz, lift
    return 0.0, 0.0, 0.0, 1.0  # a plane seen from its edge or from behind: its tilt says nothing


@njit(cache=True, nogil=True, inline="always")
def _gap(current, moved, place):  # type: ignore[no-untyped-def]
    """Distance of X' from the tangent plane of the current depth, mm, and its derivative by X'; NaN across an edge.

    moved : X'. place : where it lands, in its cell and the cell (column, row).
    """
    (x, y, z), (a, b, i, j), depth = moved, place, current.depth_mm
    d00, d10, d01, d11 = float(depth[j, i]), float(depth[j, i + 1]), float(depth[j + 1, i]), float(depth[j + 1, i + 1])
    nearest, farthest = min(d00, d10, d01, d11), max(d00, d10, d01, d11)
    # The comparison fails where any of them is unknown.
    if not (
        farthest - nearest < _ONE_SURFACE * nearest and abs(d00 + d11 + d10 + d01 - 4.0 * z) < 4.0 * _SAME_PLACE * z
    ):
        return np.nan, 0.0, 0.0, 0.0
    D, du, dv = _bilinear(depth, a, b, i, j)
    gx, gy = du * current.intrinsics[0] / z, dv * current.intrinsics[1] / z
    gz = -(gx * x + gy * y) / z - 1.0
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    return (D - z) / length, gx / length, gy / length, gz / length


@njit(cache=True, nogil=True)
def depth_residuals(reference, current, T_current_reference, unit_mm):  # type: ignore[no-untyped-def]
    """Return the geometric residual (H, W) float32 on the reference's grid, NaN where there is none."""
    h, w = reference.weight.shape
    out = np.full((h, w), np.nan, np.float32)
    for row in range(h):
        for column in range(w):
            x, y, z, a, b, i, j, _, weight = _land(reference, current, T_current_reference, row, column)
            if weight > 0.0:
                out[row, column] = _gap(current, (x, y, z), (a, b, i, j))[0] / unit_mm
    return out


@njit(cache=True, nogil=True)
def residual_images(reference, current, T_current_reference, affine, loss):  # type: ignore[no-untyped-def]
    """Return residuals (C, H, W) float32 on the reference's grid, NaN where a pixel is not used."""
    channels, h, w = reference.channels.shape
    out = np.full((channels, h, w), np.nan, np.float32)
    for row in range(h):
        for column in range(w):
            x, y, z, a, b, i, j, square, weight = _land(reference, current, T_current_reference, row, column)
            if weight <= 0.0:
                continue
            _, _, _, lift = _tilt(reference, T_current_reference, row, column)
            lamp = ((square / (x * x + y * y + z * z)) ** 1.5 * lift) ** loss.gamma
            for c in range(channels):
                value, _, _ = _bilinear(current.channels[c], a, b, i, j)
                expected = float(reference.channels[c, row, column])
                if loss.lit[c]:
                    expected = affine[0] * lamp * expected + affine[1]
                out[c, row, column] = value - expected
    return out


@njit(cache=True, nogil=True, inline="always")
def _huber(r, s, threshold, weight):  # type: ignore[no-untyped-def]
    """Cost and information of a residual."""
    size, information = abs(r), weight / (s * s)
    if size <= threshold * s:
        return 0.5 * information * r * r, information
    return information * threshold * s * (size - 0.5 * threshold * s), information * threshold * s / size


@njit(cache=True, nogil=True, inline="always")
def _add(sums, J, r, weight, free):  # type: ignore[no-untyped-def]
    """Add one residual's share to the upper triangle and the gradient; derivatives from `free` on are zero."""
    for k in range(free):
        wj = weight * J[k]
        sums[_PAIRS + k] += wj * r
        first = k * PARAMETERS - k * (k - 1) // 2 - k
        for m in range(k, free):
            sums[first + m] += wj * J[m]


@njit(cache=True, nogil=True)
def _accumulate(reference, current, T, affine, loss, unit_mm):  # type: ignore[no-untyped-def]
    """Sums over all pixels, `_SUMS` long."""
    channels, h, w = reference.channels.shape
    sums, J = np.zeros(_SUMS), np.zeros(PARAMETERS)
    for row in range(h):
        for column in range(w):
            x, y, z, a, b, i, j, square, weight = _land(reference, current, T, row, column)
            if weight <= 0.0:
                continue
            sums[_SUMS - 1] += weight
            fx, fy = current.intrinsics[0] / z, current.intrinsics[1] / z
            distance = x * x + y * y + z * z
            mx, my, mz, lift = _tilt(reference, T, row, column)
            lamp = ((square / distance) ** 1.5 * lift) ** loss.gamma
            if loss.depth_share > 0.0:
                gap, nx, ny, nz = _gap(current, (x, y, z), (a, b, i, j))
                if np.isfinite(gap):
                    r, s = gap / unit_mm, loss.depth_sigma
                    cost, information = _huber(r, s, loss.threshold, loss.depth_share * weight)
                    sums[_SUMS - 2] += cost
                    turn = 1.0 / unit_mm
                    J[0], J[1], J[2] = turn * (y * nz - z * ny), turn * (z * nx - x * nz), turn * (x * ny - y * nx)
                    J[3], J[4], J[5] = nx, ny, nz
                    _add(sums, J, r, information, PARAMETERS - 2)
            # -d ln(lamp) / dX', for translations; the lamp sits in the camera's centre: turning changes nothing.
            kx = loss.gamma * (3.0 * x / distance - mx / lift)
            ky = loss.gamma * (3.0 * y / distance - my / lift)
            kz = loss.gamma * (3.0 * z / distance - mz / lift)
            for c in range(channels):
                if loss.share[c] <= 0.0:
                    continue
                value, du, dv = _bilinear(current.channels[c], a, b, i, j)
                shown = float(reference.channels[c, row, column])
                k, free = 0.0, PARAMETERS - 2
                if loss.lit[c]:
                    shown *= lamp
                    r = value - affine[0] * shown - affine[1]
                    k, free = affine[0] * shown, PARAMETERS
                    J[6], J[7] = -shown, -1.0
                else:
                    r = value - shown
                cost, information = _huber(r, loss.sigma[c], loss.threshold, loss.share[c] * weight)
                sums[_SUMS - 2] += cost
                gx, gy = du * fx, dv * fy
                gz = -(gx * x + gy * y) / z
                J[0], J[1], J[2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
                J[3], J[4], J[5] = unit_mm * (gx + k * kx), unit_mm * (gy + k * ky), unit_mm * (gz + k * kz)
                _add(sums, J, r, information, free)
    return sums


def normal_equations(
    reference: View, current: View, T_current_reference: np.ndarray, affine: np.ndarray, loss: Loss, unit_mm: float
) -> NormalEquations:
    """Linearise the loss around a motion (4, 4) and a brightness change (gain, bias); translation in `unit_mm`."""
    sums = _accumulate(reference, current, T_current_reference, affine, loss, unit_mm)
    weight = float(sums[-1])
    sums /= max(weight, 1e-9)
    hessian = np.zeros((PARAMETERS, PARAMETERS))
    upper = np.triu_indices(PARAMETERS)
    hessian[upper] = sums[:_PAIRS]
    hessian[upper[::-1]] = sums[:_PAIRS]
    return NormalEquations(hessian, sums[_PAIRS : _PAIRS + PARAMETERS], float(sums[-2]), weight)
