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
from numba import njit

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

    T: np.ndarray
    log_depth: np.ndarray
    lens: np.ndarray


class Scene(NamedTuple):
    """What is adjusted to.

    start (N, 2), seen (N, K, 2) : as in `Window`, px from the principal point. expected, sigma : (N,) ln depth and its
    standard deviation. half_width_px : half the image width. lens, lens_sigma : (2,) expected, and its deviation; 0:
    the lens is known, and straight.
    """

    start: np.ndarray
    seen: np.ndarray
    expected: np.ndarray
    sigma: np.ndarray
    half_width_px: float
    lens: np.ndarray
    lens_sigma: np.ndarray


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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _errors(scene: Scene, state: Start) -> np.ndarray:
    """Return the reprojection errors (N, K, 2), px; NaN where not observed, infinite behind a camera."""
    focal, b, w2 = np.exp(state.lens[0]), state.lens[1], scene.half_width_px**2
    error = np.full(scene.seen.shape, np.nan)
    for n in range(len(scene.start)):
        x, y = scene.start[n]
        bent, depth = 1 + b * (x * x + y * y) / w2, np.exp(state.log_depth[n])
        x, y = depth * bent * x / focal, depth * bent * y / focal
        for k in range(scene.seen.shape[1]):
            if np.isnan(scene.seen[n, k, 0]):
                continue
            X, Y, Z = _moved(state.T[k], x, y, depth)
            if _LEAST_Z * np.sqrt(X * X + Y * Y + Z * Z) >= Z:
                error[n, k] = np.inf
                continue
            u, v = focal * X / Z, focal * Y / Z
            factor = _bend(np.sqrt((u * u + v * v) / w2), b)
            error[n, k, 0], error[n, k, 1] = factor * u - scene.seen[n, k, 0], factor * v - scene.seen[n, k, 1]
    return error


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _moved(T: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    X = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    Y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    return X, Y, T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _robust_sigma(error: np.ndarray) -> float:
    lengths, count = np.empty(error.size // 2), 0
    for n in range(error.shape[0]):
        for k in range(error.shape[1]):
            if np.isfinite(error[n, k, 0]):
                lengths[count] = np.sqrt(error[n, k, 0] ** 2 + error[n, k, 1] ** 2)
                count += 1
    return max(RAYLEIGH_TO_SIGMA * median(lengths[:count]), _MIN_SIGMA_PX) if count else _MIN_SIGMA_PX


@njit(cache=True, nogil=True, error_model="numpy")
def _cost(scene: Scene, state: Start, error: np.ndarray, sigma_px: float) -> float:
    cost = 0.0
    for n in range(error.shape[0]):
        off = (state.log_depth[n] - scene.expected[n]) / scene.sigma[n]
        cost += np.log1p(off * off / _CAUCHY2)
        for k in range(error.shape[1]):
            if not np.isnan(error[n, k, 0]):
                square = (error[n, k, 0] ** 2 + error[n, k, 1] ** 2) / sigma_px**2
                cost += np.log1p((square if np.isfinite(square) else _BEHIND) / _CAUCHY2)
    cost *= 0.5 * _CAUCHY2
    if scene.lens_sigma[0] > 0:
        cost += 0.5 * (((state.lens - scene.lens) / scene.lens_sigma) ** 2).sum()
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def _linearised(scene: Scene, state: Start, error: np.ndarray) -> WindowSolution:
    """Return the normal equations at a state; A with the prior of the lens."""
    points, partners, sigma_px = error.shape[0], error.shape[1], _robust_sigma(error)
    known = scene.lens_sigma[0] == 0
    size = 6 * partners + (0 if known else 2)
    A, scores, E = np.zeros((size, size)), np.zeros((points, size)), np.zeros((points, size))
    h, g, row, by_point = np.zeros(points), np.zeros(points), np.zeros((2, 8)), np.zeros((2, 3))
    focal, b, w2 = np.exp(state.lens[0]), state.lens[1], scene.half_width_px**2
    count = 6 if known else 8
    for n in range(points):
        x, y = scene.start[n]
        square = (x * x + y * y) / w2
        bent, depth = (1 + b * square) / focal, np.exp(state.log_depth[n])
        host = np.array([depth * bent * x, depth * bent * y, depth])
        for k in range(partners):
            if not np.isfinite(error[n, k, 0]):
                continue
            T, ex, ey = state.T[k], error[n, k, 0], error[n, k, 1]
            X, Y, Z = _moved(T, host[0], host[1], host[2])
            u, v, px, py = focal * X / Z, focal * Y / Z, ex + scene.seen[n, k, 0], ey + scene.seen[n, k, 1]
            # The inverse of the derivative of p (1 + b |p|^2 / w^2).
            bend = b * (px * px + py * py) / w2
            one = max(1 + bend, _LEAST_SLOPE)
            outer = 2 * b / w2 / max(one + 2 * bend, _LEAST_SLOPE)
            for axis in range(2):
                p = px if axis == 0 else py
                dx, dy = ((axis == 0) - outer * p * px) / one, ((axis == 1) - outer * p * py) / one
                by_point[axis, 0], by_point[axis, 1] = dx * focal / Z, dy * focal / Z
                by_point[axis, 2] = -(dx * u + dy * v) / Z
                ax, ay, az = by_point[axis]
                row[axis, 0], row[axis, 1], row[axis, 2] = Y * az - Z * ay, Z * ax - X * az, X * ay - Y * ax
                row[axis, 3], row[axis, 4], row[axis, 5] = ax, ay, az
                if not known:
                    hx, hy = ax * T[0, 0] + ay * T[1, 0] + az * T[2, 0], ax * T[0, 1] + ay * T[1, 1] + az * T[2, 1]
                    row[axis, 6] = dx * u + dy * v - hx * host[0] - hy * host[1]
                    row[axis, 7] = (hx * x + hy * y) * depth * square / focal
                    row[axis, 7] -= (dx * px + dy * py) * (px * px + py * py) / w2
            weight = 1 / (1 + (ex * ex + ey * ey) / sigma_px**2 / _CAUCHY2) / sigma_px**2
            x0, y0, z0 = X - T[0, 3], Y - T[1, 3], Z - T[2, 3]
            deep0 = weight * (by_point[0, 0] * x0 + by_point[0, 1] * y0 + by_point[0, 2] * z0)
            deep1 = weight * (by_point[1, 0] * x0 + by_point[1, 1] * y0 + by_point[1, 2] * z0)
            h[n] += (deep0 * deep0 + deep1 * deep1) / weight
            g[n] += ex * deep0 + ey * deep1
            for i in range(count):
                to, by0, by1 = 6 * k + i if i < 6 else 6 * partners + i - 6, row[0, i], row[1, i]
                E[n, to] += deep0 * by0 + deep1 * by1
                by0, by1 = weight * by0, weight * by1
                scores[n, to] += ex * by0 + ey * by1
                # Poses of two partners have no derivative in common.
                for j in range(min(i + 1, 6)):
                    A[to, 6 * k + j] += by0 * row[0, j] + by1 * row[1, j]
                for j in range(6, i + 1):
                    A[to, 6 * partners + j - 6] += by0 * row[0, j] + by1 * row[1, j]
        off = (state.log_depth[n] - scene.expected[n]) / scene.sigma[n]
        held = 1 / (1 + off * off / _CAUCHY2) / scene.sigma[n] ** 2
        h[n] += held
        g[n] += held * off * scene.sigma[n]
    for i in range(size - 6 * partners):
        A[6 * partners + i, 6 * partners + i] += 1 / scene.lens_sigma[i] ** 2
    return WindowSolution(state, error, sigma_px, A, scores, E, h, g)


@njit(cache=True, nogil=True, error_model="numpy")
def _stepped(scene: Scene, found: WindowSolution, damping: float) -> Start:
    """Return the state after a damped Gauss-Newton step; points move in inverse depth, which parallax is linear in."""
    state, A, E, g, h = found.state, found.A, found.E, found.g, found.h
    size, partners = len(A), len(state.T)
    matrix, step, depths = A.copy(), np.zeros(size), state.log_depth.copy()
    for i in range(6 * partners, size):
        step[i] = (scene.lens[i - 6 * partners] - state.lens[i - 6 * partners]) / scene.lens_sigma[
            i - 6 * partners
        ] ** 2
    for i in range(size):
        matrix[i, i] += (damping + _RIDGE) * A[i, i] + _TINY
    for n in range(len(h)):
        for i in range(size):
            shrunk = E[n, i] / (h[n] * (1 + damping))
            step[i] += shrunk * g[n] - found.scores[n, i]
            for j in range(i + 1):
                matrix[i, j] -= shrunk * E[n, j]
    _solve(matrix, step)
    for n in range(len(h)):
        along = g[n]
        for i in range(size):
            along += E[n, i] * step[i]
        depths[n] -= np.log(
            min(max(1 + along / (h[n] * (1 + damping)), _INVERSE_DEPTH_STEP[0]), _INVERSE_DEPTH_STEP[1])
        )
    T, lens = np.empty_like(state.T), state.lens.copy()
    for k in range(partners):
        _turn(step[6 * k : 6 * k + 6], state.T[k], T[k])
    for i in range(6 * partners, size):
        lens[i - 6 * partners] += step[i]
    return Start(T, depths, lens)


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _turn(twist: np.ndarray, T: np.ndarray, turned: np.ndarray) -> None:
    """Put a pose (3, 4), turned by a rotation vector and then moved, in place of `turned`: Rodrigues' formula."""
    x, y, z = twist[0], twist[1], twist[2]
    angle = np.sqrt(x * x + y * y + z * z)
    along, across = (1.0, 0.5) if angle < _SMALL_RAD else (np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2)
    for c in range(4):
        a, b, d = y * T[2, c] - z * T[1, c], z * T[0, c] - x * T[2, c], x * T[1, c] - y * T[0, c]
        turned[0, c] = T[0, c] + along * a + across * (y * d - z * b)
        turned[1, c] = T[1, c] + along * b + across * (z * a - x * d)
        turned[2, c] = T[2, c] + along * d + across * (x * b - y * a)
    for i in range(3):
        turned[i, 3] += twist[3 + i]
