"""The photometric residual and its normal equations, fused: one pass over the pixels, nothing per pixel is stored.

For a reference pixel p with depth, X = depth * ray(p) and X' = T_current_reference X, each channel c of the images has

    r_c(p) = C_c(project(X')) - (gain * L(p) * R_c(p) + bias),      L(p) = (|X| / |X'|)^falloff_c

R, C are the reference and the current image; C is sampled bilinearly, and its gradient is the exact derivative of that
interpolation, so that Jacobians agree with finite differences. L predicts how the lamp, which moves with the camera,
dims a point. A locally normalised channel is blind to light: it has neither gain nor bias nor fall-off. Parameters of
the normal equations, in this order: rotation (3, rad) and translation (3, in units of `translation_unit_mm`) of a
perturbation exp(xi) T_current_reference, gain, bias.

One thread on purpose: a level is a few milliseconds of work, the other core has the networks and the fusion to do, and
on a busy machine waking threads some fifty times a frame costs more than it saves (BENCHMARK.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

PARAMETERS = 8
_PAIRS = PARAMETERS * (PARAMETERS + 1) // 2
_SUMS = _PAIRS + PARAMETERS + 2  # upper triangle, gradient, cost, weight


class View(NamedTuple):
    """One image of one pyramid level as the kernels want it.

    Attributes
    ----------
    channels : (C, H, W) float32, raw grey values or locally normalised ones.
    weight : (H, W) float32, 0 where a pixel must not be used.
    depth_mm : (H, W) float32, NaN = unknown (only the reference's is read).
    intrinsics : (4,) float64 fx, fy, cx, cy in px of this level.
    """

    channels: np.ndarray
    weight: np.ndarray
    depth_mm: np.ndarray
    intrinsics: np.ndarray


class Loss(NamedTuple):
    """How residuals of each channel count: 0.5 (r/s)^2 for |r| <= threshold * s, linear beyond (Huber).

    Attributes
    ----------
    sigma : (C,) float64, robust standard deviation s of each channel's residuals. threshold : in units of s.
    lit : (C,) bool, whether gain, bias and the lamp apply to the channel. falloff : exponent of the lamp, 0 = none.
    """

    sigma: np.ndarray
    threshold: float
    lit: np.ndarray
    falloff: float


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
    """Where a reference pixel lands: X', pixel, cell (column, row), |X|^2; the last entry is its weight, 0 = unusable."""
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
            lamp = (square / (x * x + y * y + z * z)) ** (0.5 * loss.falloff)
            for c in range(channels):
                value, _, _ = _bilinear(current.channels[c], a, b, i, j)
                expected = float(reference.channels[c, row, column])
                if loss.lit[c]:
                    expected = affine[0] * lamp * expected + affine[1]
                out[c, row, column] = value - expected
    return out


@njit(cache=True, nogil=True, inline="always")
def _add(sums, J, r, weight):  # type: ignore[no-untyped-def]
    """Add one residual's share to the upper triangle and the gradient."""
    n = 0
    for k in range(PARAMETERS):
        wj = weight * J[k]
        sums[_PAIRS + k] += wj * r
        for m in range(k, PARAMETERS):
            sums[n] += wj * J[m]
            n += 1


@njit(cache=True, nogil=True)
def _accumulate(reference, current, T, affine, loss, unit_mm, linear):  # type: ignore[no-untyped-def]
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
            lamp = (square / distance) ** (0.5 * loss.falloff)
            for c in range(channels):
                value, du, dv = _bilinear(current.channels[c], a, b, i, j)
                shown = float(reference.channels[c, row, column])
                k = 0.0
                if loss.lit[c]:
                    shown *= lamp
                    r = value - affine[0] * shown - affine[1]
                    k = affine[0] * shown * loss.falloff / distance  # -dL/dX' is along X': it turns nothing
                    J[6], J[7] = -shown, -1.0
                else:
                    r = value - shown
                    J[6], J[7] = 0.0, 0.0
                size, s = abs(r), loss.sigma[c]
                information = weight / (s * s)
                if size <= loss.threshold * s:
                    sums[_SUMS - 2] += 0.5 * information * r * r
                else:
                    sums[_SUMS - 2] += information * loss.threshold * s * (size - 0.5 * loss.threshold * s)
                    information *= loss.threshold * s / size
                if linear:
                    gx, gy = du * fx, dv * fy
                    gz = -(gx * x + gy * y) / z
                    J[0], J[1], J[2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
                    J[3], J[4], J[5] = unit_mm * (gx + k * x), unit_mm * (gy + k * y), unit_mm * (gz + k * z)
                    _add(sums, J, r, information)
    return sums


def normal_equations(
    reference: View, current: View, T_current_reference: np.ndarray, affine: np.ndarray, loss: Loss, unit_mm: float
) -> NormalEquations:
    """Linearise the loss around a motion (4, 4) and an affine brightness change (gain, bias); translation in `unit_mm`."""
    sums = _accumulate(reference, current, T_current_reference, affine, loss, unit_mm, True)
    weight = float(sums[-1])
    sums /= max(weight, 1e-9)
    hessian = np.zeros((PARAMETERS, PARAMETERS))
    upper = np.triu_indices(PARAMETERS)
    hessian[upper] = sums[:_PAIRS]
    hessian[upper[::-1]] = sums[:_PAIRS]
    return NormalEquations(hessian, sums[_PAIRS : _PAIRS + PARAMETERS], float(sums[-2]), weight)


def mean_cost(
    reference: View, current: View, T_current_reference: np.ndarray, affine: np.ndarray, loss: Loss
) -> tuple[float, float]:
    """Return the mean loss and the weight of the pixels used, without derivatives."""
    cost, weight = _accumulate(reference, current, T_current_reference, affine, loss, 1.0, False)[-2:]
    return float(cost / max(weight, 1e-9)), float(weight)
