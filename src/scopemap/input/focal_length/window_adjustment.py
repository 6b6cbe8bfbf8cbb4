"""Bundle adjustment of one window: poses of partners, depths of the host's corners and, if unknown, the lens.

The sum of rho(|projected - observed| / s) + rho((u - expected) / sigma) is minimised over poses and ln depths u, rho
Cauchy's kernel, s the robust standard deviation of the reprojection errors; with it the lens, held to what is expected
of it. Gauss-Newton with Schur complement (Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, 6.1), damped
where a step raises the cost. The least of what `mapping.bundle_adjustment` does, in one kernel: hundreds are solved
before the first frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.kernels import Float64_1d, Float64_2d, Float64_3d, inner_kernel, kernel
from scopemap.engine.geometry.least_squares import RAYLEIGH_TO_SIGMA
from scopemap.engine.geometry.median import median

_MIN_SIGMA_PX = 0.03
_CAUCHY2 = 2.0**2  # squared residual, in variances, that gets half the weight
_BEHIND = 100.0  # squared residual, in variances, of a point behind the camera
_LEAST_Z = 1e-3
_LEAST_SLOPE = 0.1
_STEPS = 6  # of Newton's method that bends a lens
_FARTHEST = 10.0  # half widths, beyond which it would diverge
# Focal length, depth and motion share a long valley of the cost: more damping would end the search on its way.
_LEAST_DAMPING = 1e-5
_MORE = 10.0
_LESS = 0.3
_SMALL_RAD = 1e-6
_RIDGE = 1e-9  # of the diagonal
_TINY = 1e-300  # where that is zero
_INVERSE_DEPTH_STEP = (0.1, 10.0)  # factor of the inverse depth in one step


class Start(NamedTuple):
    """Poses (K, 3, 4) of partners, unit: that of depth; ln depths (N,) of the corners; lens (2,): ln f, bend b.

    A lens sees x where a straight one sees x (1 + b |x|^2 / w^2), w half the image width.
    """

    T: Float64_3d
    log_depth: Float64_1d
    lens: Float64_1d


class Scene(NamedTuple):
    """What is adjusted to.

    start (N, 2), seen (N, K, 2) : as in `Window`, px from the principal point. expected, sigma : (N,) ln depth and its
    standard deviation. half_width_px : half the image width. lens, lens_sigma : (2,) expected, and its deviation; 0:
    the lens is known, and straight.
    """

    start: Float64_2d
    seen: Float64_3d
    expected: Float64_1d
    sigma: Float64_1d
    half_width_px: float
    lens: Float64_1d
    lens_sigma: Float64_1d


class WindowSolution(NamedTuple):
    """Where the adjustment ended.

    state : as `Start`. error : (N, K, 2) px, NaN where not observed, infinite behind a camera. sigma_px : their robust
    standard deviation. A, scores, E, h, g : second derivatives by poses and lens (C, C), of which the lower half, first
    ones point by point (N, C), mixed ones (N, C); of the points, second and first (N,).
    """

    state: Start
    error: np.ndarray
    sigma_px: float
    A: np.ndarray
    scores: np.ndarray
    E: np.ndarray
    h: np.ndarray
    g: np.ndarray

    def reduced(self) -> np.ndarray:
        """Return the matrix (C, C) without the points, of which the lower half."""
        matrix: np.ndarray = self.A - self.E.T @ (self.E / self.h[:, None])
        return matrix


def at_rest(scene: Scene) -> Start:
    """Return the start without motion, at the expected depths and lens."""
    return Start(np.tile(np.eye(3, 4), (scene.seen.shape[1], 1, 1)), scene.expected.copy(), scene.lens.copy())


@kernel
def adjusted(scene: Scene, begin: Start, most: int, min_decrease: float) -> WindowSolution:
    """Return what is found from a start in `most` iterations, or until one lowers the cost by less than a share."""
    damping, found = 0.0, _linearised(scene, begin, _errors(scene, begin))
    cost = _cost(scene, begin, found.error, found.sigma_px)
    for _ in range(most):
        ahead = _stepped(scene, found, damping)
        error = _errors(scene, ahead)
        decrease = cost - _cost(scene, ahead, error, found.sigma_px)
        if decrease > 0:
            is_small, damping = decrease < min_decrease * cost, _LESS * damping
            found = _linearised(scene, ahead, error)
            cost = _cost(scene, ahead, error, found.sigma_px)
            if is_small:
                break
        else:
            damping = max(_MORE * damping, _LEAST_DAMPING)
    return found


@inner_kernel
def _errors(scene: Scene, state: Start) -> np.ndarray:
    """Return the reprojection errors (N, K, 2), px; NaN where not observed, infinite behind a camera."""
    # Outside the loop: numba counts references of arrays that are read from a tuple.
    start, seen, T, log_depth = scene.start, scene.seen, state.T, state.log_depth
    focal, b, w2 = np.exp(state.lens[0]), state.lens[1], scene.half_width_px**2
    error = np.empty_like(seen)
    for n in range(seen.shape[0]):
        x, y = start[n, 0], start[n, 1]
        bent, depth = 1 + b * (x * x + y * y) / w2, np.exp(log_depth[n])
        x, y = depth * bent * x / focal, depth * bent * y / focal
        for k in range(seen.shape[1]):
            X, Y, Z = _moved(T, k, x, y, depth)
            if np.isnan(seen[n, k, 0]):
                error[n, k, 0], error[n, k, 1] = np.nan, np.nan
            elif _LEAST_Z * np.sqrt(X * X + Y * Y + Z * Z) >= Z:
                error[n, k, 0], error[n, k, 1] = np.inf, np.inf
            else:
                u, v = focal * X / Z, focal * Y / Z
                factor = _bend(np.sqrt((u * u + v * v) / w2), b)
                error[n, k, 0], error[n, k, 1] = factor * u - seen[n, k, 0], factor * v - seen[n, k, 1]
    return error


@inner_kernel
def _moved(T: np.ndarray, k: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    X = T[k, 0, 0] * x + T[k, 0, 1] * y + T[k, 0, 2] * z + T[k, 0, 3]
    Y = T[k, 1, 0] * x + T[k, 1, 1] * y + T[k, 1, 2] * z + T[k, 1, 3]
    return X, Y, T[k, 2, 0] * x + T[k, 2, 1] * y + T[k, 2, 2] * z + T[k, 2, 3]


@inner_kernel
def _bend(wanted: float, b: float) -> float:
    """Return the factor of a radius, half widths, that the lens bends a straight one by: Newton's method."""
    if b == 0 or wanted == 0:
        return 1.0
    wanted = min(wanted, _FARTHEST)
    radius = wanted
    for _ in range(_STEPS):
        slope = max(1 + 3 * b * radius**2, _LEAST_SLOPE)
        radius = min(max(radius - (radius * (1 + b * radius**2) - wanted) / slope, 0.0), _FARTHEST)
    return radius / wanted


@inner_kernel
def _robust_sigma(error: np.ndarray) -> float:
    lengths, count = np.empty(error.size // 2), 0
    for n in range(error.shape[0]):
        for k in range(error.shape[1]):
            if np.isfinite(error[n, k, 0]):
                lengths[count] = np.sqrt(error[n, k, 0] ** 2 + error[n, k, 1] ** 2)
                count += 1
    return max(RAYLEIGH_TO_SIGMA * median(lengths[:count]), _MIN_SIGMA_PX) if count else _MIN_SIGMA_PX


@inner_kernel
def _cost(scene: Scene, state: Start, error: np.ndarray, sigma_px: float) -> float:
    cost, log_depth, expected, sigma = 0.0, state.log_depth, scene.expected, scene.sigma
    for n in range(error.shape[0]):
        off = (log_depth[n] - expected[n]) / sigma[n]
        cost += np.log1p(off * off / _CAUCHY2)
        for k in range(error.shape[1]):
            if not np.isnan(error[n, k, 0]):
                square = (error[n, k, 0] ** 2 + error[n, k, 1] ** 2) / sigma_px**2
                cost += np.log1p((square if np.isfinite(square) else _BEHIND) / _CAUCHY2)
    cost *= 0.5 * _CAUCHY2
    if scene.lens_sigma[0] > 0:
        focal_off = (state.lens[0] - scene.lens[0]) / scene.lens_sigma[0]
        bend_off = (state.lens[1] - scene.lens[1]) / scene.lens_sigma[1]
        cost += 0.5 * (focal_off * focal_off + bend_off * bend_off)
    return cost


@inner_kernel
def _linearised(scene: Scene, state: Start, error: np.ndarray) -> WindowSolution:
    """Return the normal equations at a state; A with the prior of the lens."""
    points, partners, sigma_px = error.shape[0], error.shape[1], _robust_sigma(error)
    start, seen, T, log_depth = scene.start, scene.seen, state.T, state.log_depth
    expected, sigma, lens_sigma = scene.expected, scene.sigma, scene.lens_sigma
    count = 6 if lens_sigma[0] == 0 else 8
    size = 6 * partners + count - 6
    A, scores, E = np.zeros((size, size)), np.zeros((points, size)), np.zeros((points, size))
    h, g, row = np.zeros(points), np.zeros(points), np.zeros((2, 8))
    focal, b, w2 = np.exp(state.lens[0]), state.lens[1], scene.half_width_px**2
    for n in range(points):
        x, y = start[n, 0], start[n, 1]
        square = (x * x + y * y) / w2
        bent, depth = (1 + b * square) / focal, np.exp(log_depth[n])
        host_x, host_y = depth * bent * x, depth * bent * y
        for k in range(partners):
            ex, ey = error[n, k, 0], error[n, k, 1]
            if not np.isfinite(ex):
                continue
            X, Y, Z = _moved(T, k, host_x, host_y, depth)
            u, v, px, py = focal * X / Z, focal * Y / Z, ex + seen[n, k, 0], ey + seen[n, k, 1]
            # The inverse of the derivative of p (1 + b |p|^2 / w^2).
            bend = b * (px * px + py * py) / w2
            one = max(1 + bend, _LEAST_SLOPE)
            outer = 2 * b / w2 / max(one + 2 * bend, _LEAST_SLOPE)
            for axis in range(2):
                p = px if axis == 0 else py
                dx, dy = ((axis == 0) - outer * p * px) / one, ((axis == 1) - outer * p * py) / one
                ax, ay, az = dx * focal / Z, dy * focal / Z, -(dx * u + dy * v) / Z
                row[axis, 0], row[axis, 1], row[axis, 2] = Y * az - Z * ay, Z * ax - X * az, X * ay - Y * ax
                row[axis, 3], row[axis, 4], row[axis, 5] = ax, ay, az
                hx = ax * T[k, 0, 0] + ay * T[k, 1, 0] + az * T[k, 2, 0]
                hy = ax * T[k, 0, 1] + ay * T[k, 1, 1] + az * T[k, 2, 1]
                row[axis, 6] = dx * u + dy * v - hx * host_x - hy * host_y
                row[axis, 7] = (hx * x + hy * y) * depth * square / focal
                row[axis, 7] -= (dx * px + dy * py) * (px * px + py * py) / w2
            weight = 1 / (1 + (ex * ex + ey * ey) / sigma_px**2 / _CAUCHY2) / sigma_px**2
            x0, y0, z0 = X - T[k, 0, 3], Y - T[k, 1, 3], Z - T[k, 2, 3]
            deep0 = weight * (row[0, 3] * x0 + row[0, 4] * y0 + row[0, 5] * z0)
            deep1 = weight * (row[1, 3] * x0 + row[1, 4] * y0 + row[1, 5] * z0)
            h[n] += (deep0 * deep0 + deep1 * deep1) / weight
            g[n] += ex * deep0 + ey * deep1
            for i in range(count):
                to, by0, by1 = 6 * k + i if i < 6 else 6 * partners + i - 6, row[0, i], row[1, i]
                E[n, to] += deep0 * by0 + deep1 * by1
                by0, by1 = weight * by0, weight * by1
                scores[n, to] += ex * by0 + ey * by1
                # Poses of two partners have no derivative in common.
                for j in range(i + 1):
                    A[to, 6 * k + j if j < 6 else 6 * partners + j - 6] += by0 * row[0, j] + by1 * row[1, j]
        off = (log_depth[n] - expected[n]) / sigma[n]
        held = 1 / (1 + off * off / _CAUCHY2) / sigma[n] ** 2
        h[n] += held
        g[n] += held * off * sigma[n]
    for i in range(6 * partners, size):
        A[i, i] += 1 / lens_sigma[i - 6 * partners] ** 2
    return WindowSolution(state, error, sigma_px, A, scores, E, h, g)


@inner_kernel
def _stepped(scene: Scene, found: WindowSolution, damping: float) -> Start:
    """Return the state after a damped Gauss-Newton step; points move in inverse depth, which parallax is linear in."""
    state, A, E, g, h, scores = found.state, found.A, found.E, found.g, found.h, found.scores
    size, partners, T = A.shape[0], state.T.shape[0], state.T
    matrix, step, turned = np.empty_like(A), np.zeros(size), np.empty_like(T)
    depths, lens, expected, lens_sigma = np.empty_like(h), np.empty_like(state.lens), scene.lens, scene.lens_sigma
    for i in range(size):
        for j in range(i):
            matrix[i, j] = A[i, j]
        matrix[i, i] = A[i, i] + ((damping + _RIDGE) * A[i, i] + _TINY)
    for i in range(size - 6 * partners):
        step[6 * partners + i] = (expected[i] - state.lens[i]) / lens_sigma[i] ** 2
    for n in range(h.shape[0]):
        for i in range(size):
            shrunk = E[n, i] / (h[n] * (1 + damping))
            step[i] += shrunk * g[n] - scores[n, i]
            for j in range(i + 1):
                matrix[i, j] -= shrunk * E[n, j]
    _solve(matrix, step)
    for n in range(h.shape[0]):
        along = g[n]
        for i in range(size):
            along += E[n, i] * step[i]
        factor = max(1 + along / (h[n] * (1 + damping)), _INVERSE_DEPTH_STEP[0])
        depths[n] = state.log_depth[n] - np.log(min(factor, _INVERSE_DEPTH_STEP[1]))
    for k in range(partners):
        _turn(step, k, T, turned)
    for i in range(2):
        lens[i] = state.lens[i] + (step[6 * partners + i] if size > 6 * partners else 0.0)
    return Start(turned, depths, lens)


@inner_kernel
def _solve(matrix: np.ndarray, wanted: np.ndarray) -> None:
    """Put the solution in place of `wanted` (C,), by Cholesky's factors of a matrix (C, C), of which the lower half."""
    size = len(wanted)
    for j in range(size):
        for k in range(j):
            for i in range(j, size):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
        root = np.sqrt(max(matrix[j, j], _TINY))
        for i in range(j, size):
            matrix[i, j] /= root
        for k in range(j):
            wanted[j] -= matrix[j, k] * wanted[k]
        wanted[j] /= matrix[j, j]
    for j in range(size - 1, -1, -1):
        for k in range(j + 1, size):
            wanted[j] -= matrix[k, j] * wanted[k]
        wanted[j] /= matrix[j, j]


@inner_kernel
def _turn(step: np.ndarray, k: int, T: np.ndarray, turned: np.ndarray) -> None:
    """Put pose k (3, 4), turned by a rotation vector and then moved, into `turned`: Rodrigues' formula.

    step : (C,), from 6 k on the rotation vector and the motion. T, turned : poses (K, 3, 4).
    """
    x, y, z = step[6 * k], step[6 * k + 1], step[6 * k + 2]
    angle = np.sqrt(x * x + y * y + z * z)
    along, across = (1.0, 0.5) if angle < _SMALL_RAD else (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2)
    for c in range(4):
        p, q, r = T[k, 0, c], T[k, 1, c], T[k, 2, c]
        a, b, d = y * r - z * q, z * p - x * r, x * q - y * p
        turned[k, 0, c] = p + along * a + across * (y * d - z * b)
        turned[k, 1, c] = q + along * b + across * (z * a - x * d)
        turned[k, 2, c] = r + along * d + across * (x * b - y * a)
    for i in range(3):
        turned[k, i, 3] += step[6 * k + 3 + i]
