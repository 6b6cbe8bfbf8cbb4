"""Robust nonlinear least squares: one trust-region minimiser, robust kernels and robust scale estimates.

Powell's dog-leg, equations 7 to 9 of arXiv 2508.11282: the Gauss-Newton step (7) if within radius rho; else the
steepest descent step (8) cut to rho if h |p_sd| > rho, h = |p_sd|^2 / |J p_sd|^2 (the paper compares |p_sd|); else
where the line from the Cauchy point to the Gauss-Newton step leaves the ball (9). Radius: Nocedal and Wright,
"Numerical Optimization", algorithm 4.1. `ReducedModel` eliminates points (Lourakis and Argyros, ICCV 2005; Triggs et
al., "Bundle Adjustment", 2000, 6.1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from scopemap.engine.geometry.kernels import Float64_1d, Float64_2d, Float64_3d, Int32_2d, Int64_1d, kernel

MAD_TO_SIGMA = 1.4826
"""Standard deviation over the median absolute value of a normal variable."""

RAYLEIGH_TO_SIGMA = 1 / 1.1774
"""Standard deviation, per axis, over the median length of a normal vector in the plane."""

_State = TypeVar("_State")


def robust_sigma(residuals: np.ndarray, least: float = 0.0) -> float:
    """Return the standard deviation of residuals of any shape, from their median absolute value; `least` of none."""
    return max(float(MAD_TO_SIGMA * np.median(np.abs(residuals))), least) if residuals.size else least


def robust_sigma_2d(lengths: np.ndarray, least: float = 0.0) -> float:
    """Return the standard deviation, per axis, of vectors in the plane from their lengths; `least` of none."""
    return max(float(RAYLEIGH_TO_SIGMA * np.median(lengths)), least) if lengths.size else least


def dots(vectors: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the scalar products (N,) of vectors (N, 2); numpy takes five times as long to sum over two columns."""
    products: np.ndarray = vectors[:, 0] * others[:, 0] + vectors[:, 1] * others[:, 1]
    return products


def cauchy(square: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Cauchy's cost and weight of squared residuals, near zero 0.5 * square; at `scale` the weight is a half."""
    ratio = square / scale**2
    return 0.5 * scale**2 * np.log1p(ratio), 1 / (1 + ratio)


def huber_weight(residuals: np.ndarray, threshold: float) -> np.ndarray:
    """Return the weights of absolute residuals under Huber's kernel: 1 up to `threshold`, then threshold / residual."""
    return np.minimum(1.0, threshold / np.maximum(residuals, 1e-300))


class Model(Protocol):
    """Quadratic model of a cost around a state; the cost is infinite where the state is impossible."""

    @property
    def cost(self) -> float:
        """At the state."""

    @property
    def gradient(self) -> np.ndarray:
        """First derivative (n,)."""

    def gauss_newton_step(self) -> np.ndarray:
        """Return the step (n,) to the minimum."""

    def curvature(self, step: np.ndarray) -> float:
        """Return step^T H step."""


class DenseModel(NamedTuple):
    """Model of few unknowns: cost, gradient (n,) and Gauss-Newton hessian (n, n)."""

    cost: float
    gradient: np.ndarray
    hessian: np.ndarray

    def gauss_newton_step(self) -> np.ndarray:
        """Return the step (n,) to the minimum; directions without curvature stay at zero."""
        diagonal = np.diag(self.hessian)
        scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        scaled = self.hessian / np.outer(scale, scale)
        return -np.linalg.lstsq(scaled, self.gradient / scale, rcond=1e-10)[0] / scale

    def curvature(self, step: np.ndarray) -> float:
        """Return step^T H step."""
        return float(step @ self.hessian @ step)


@dataclass(frozen=True)
class Problem(Generic[_State]):
    """What is minimised, on whatever group its states are.

    `linearise` gives the model around a state; `retract` moves a state by a step (n,). `accept`, if given, changes a
    state that was stepped to, such as the scale of its robust kernel, after which the cost is another one.
    """

    linearise: Callable[[_State], Model]
    retract: Callable[[_State, np.ndarray], _State]
    accept: Callable[[_State], _State] | None = None


@dataclass(frozen=True)
class Options:
    """When to stop. Steps and radius are in the problem's own units; `gauss_newton` takes every full step."""

    radius: float = 0.1
    max_iterations: int = 30
    min_step: float = 1e-5
    min_decrease: float = 1e-4
    gauss_newton: bool = False


@dataclass(frozen=True)
class Solution(Generic[_State]):
    """Where the search ended: `converged` means a step or a relative decrease below the tolerance."""

    state: _State
    cost: float
    iterations: int
    converged: bool


def dogleg_step(model: Model, newton: np.ndarray, radius: float) -> np.ndarray:
    """Return the dog-leg step (n,) of length <= `radius`; newton : the model's Gauss-Newton step (n,)."""
    if np.linalg.norm(newton) <= radius:
        return newton
    descent = -model.gradient
    length = float(np.linalg.norm(descent))
    curvature = model.curvature(descent)
    h = length**2 / curvature if curvature > 0 else np.inf
    if h * length >= radius:
        return descent * (radius / length)
    cauchy_point = h * descent
    onwards = newton - cauchy_point
    # |cauchy_point + s onwards| = radius, the root in 0..1.
    a, b, c = onwards @ onwards, cauchy_point @ onwards, cauchy_point @ cauchy_point - radius**2
    return cauchy_point + onwards * ((-b + np.sqrt(b * b - a * c)) / a)


def minimise(problem: Problem[_State], start: _State, options: Options) -> Solution[_State]:
    """Search from `start`; the cost of the solution is never above the cost of `start` (except for Gauss-Newton)."""
    state, radius = start, options.radius
    model, newton = problem.linearise(state), None
    for iteration in range(1, options.max_iterations + 1):
        # After a rejected step it is the same.
        newton = model.gauss_newton_step() if newton is None else newton
        step = newton if options.gauss_newton else dogleg_step(model, newton, radius)
        length = float(np.linalg.norm(step))
        if length < options.min_step or not np.isfinite(length):
            return Solution(state, model.cost, iteration, bool(np.isfinite(length)))
        candidate = problem.retract(state, step)
        # Most steps are taken: linearising at once is cheaper than asking for the cost first.
        ahead = problem.linearise(candidate)
        if options.gauss_newton:
            state, model, newton = candidate, ahead, None
            continue
        slope = float(model.gradient @ step)
        # The whole step to the minimum has H step = -g.
        predicted = -0.5 * slope if step is newton else -(slope + 0.5 * model.curvature(step))
        ratio = (model.cost - ahead.cost) / max(predicted, 1e-300)
        if ratio < 0.25:
            radius = 0.25 * length
        elif ratio > 0.75 and length > 0.99 * radius:
            radius = 2.0 * radius
        if ahead.cost < model.cost:
            small = model.cost - ahead.cost < options.min_decrease * model.cost
            state, model, newton = candidate, ahead, None
            if problem.accept is not None:
                state = problem.accept(candidate)
                model = problem.linearise(state)
            if small:
                return Solution(state, model.cost, iteration, True)
    return Solution(state, model.cost, options.max_iterations, False)


_RIDGE = 1e-9  # guard: of the diagonal


class Linear(NamedTuple):
    """Derivatives and weights of n observations.

    columns : free unknowns (n, U) that an observation touches beside its point; -1: one that is held. by : (n, 2, U),
    px.
    """

    columns: Int32_2d
    by: Float64_3d
    by_depth: Float64_2d  # (n, 2)
    error: Float64_2d  # (n, 2) px
    weight: Float64_1d  # (n,)


class Prior(NamedTuple):
    """Normal equations of C terms, each of m different unknowns alone.

    columns : (C, m) numbers of the unknowns. A, b : second (C, m, m) and first (C, m) derivatives.
    """

    columns: np.ndarray
    A: np.ndarray
    b: np.ndarray


class _Normal(NamedTuple):
    """Normal equations.

    matrix : lower half of the second derivative (F, F) by the free unknowns, the points eliminated; `_factor` is put in
    its place. gradient : first
    derivative (F,). by_points : what eliminating the points adds to its negative (F,). h, g : second and first
    derivatives (P,) by the points.
    """

    matrix: Float64_2d
    gradient: Float64_1d
    by_points: Float64_1d
    h: Float64_1d
    g: Float64_1d


@dataclass(frozen=True)
class ReducedModel:
    """Model of the cost around a state; steps are the unknowns, then ln depth of the points.

    first : first observation of each point, and their number (P + 1,). parts : of the points. linear : returns the
    derivatives of the observations of a part, those of several found again where a step is tried, since all would fill
    memory. priors : returns those of the unknowns. off, held : (P,) error of each point's ln depth against the
    estimate, and its weight. scale : (P,) unknown of its host's ln scale, which moves the estimate. free : (F,) numbers
    of the unknowns that may change. unknowns : their number.
    """

    first: np.ndarray
    parts: Sequence[slice]
    cost: float
    linear: Callable[[slice], Linear]
    priors: Callable[[], Sequence[Prior]]
    off: np.ndarray
    held: np.ndarray
    scale: np.ndarray
    free: np.ndarray
    unknowns: int

    @cached_property
    def _priors(self) -> Sequence[Prior]:
        return self.priors()

    @cached_property
    def _of_first(self) -> Linear:
        return self.linear(self.parts[0])

    def _linear(self, some: slice) -> Linear:
        return self._of_first if len(self.parts) == 1 else self.linear(some)

    @cached_property
    def _normal(self) -> _Normal:
        free, points, first = len(self.free), len(self.off), self.first
        normal = _Normal(np.zeros((free, free)), *np.zeros((2, free)), *np.zeros((2, points)))
        place = np.full(self.unknowns, -1)
        place[self.free] = np.arange(free)
        for some in self.parts:
            own = _Normal(*normal[:3], normal.h[some], normal.g[some])
            start = first[some.start : some.stop + 1] - first[some.start]
            _add_points(own, start, self.scale[some], self.off[some], self.held[some], self._linear(some))
        for prior in self._priors:
            row, column = np.broadcast_arrays(place[prior.columns][:, :, None], place[prior.columns][:, None])
            kept = (row >= 0) & (column >= 0)
            np.add.at(normal.matrix, (row[kept], column[kept]), prior.A[kept])
            own = place[prior.columns]
            np.add.at(normal.gradient, own[own >= 0], prior.b[own >= 0])
        normal.matrix[np.diag_indices(free)] *= 1 + _RIDGE
        return normal

    @cached_property
    def _factor(self) -> tuple[np.ndarray, bool]:
        """Cholesky's factor of the normal matrix, in its place: that of 300 keyframes has 35 MB."""
        # LAPACK reads by columns: the lower half is the upper one there.
        factor: tuple[np.ndarray, bool] = cho_factor(self._normal.matrix.T, overwrite_a=True, check_finite=False)
        return factor

    @property
    def last_sigma(self) -> float:
        """Standard deviation of the last free unknown, from the last element of the inverse normal matrix.

        Of A = L L^T that is 1 / l_nn^2. Raises `LinAlgError` where A is singular.
        """
        return float(1 / abs(self._factor[0][-1, -1]))

    @cached_property
    def gradient(self) -> np.ndarray:
        """First derivative (unknowns + P,); 0 for those that are held."""
        return self._step(self._normal.gradient, self._normal.g)

    def _step(self, free: np.ndarray, points: np.ndarray) -> np.ndarray:
        step = np.zeros(self.unknowns + len(points))
        step[self.free], step[self.unknowns :] = free, points
        return step

    def _points(self, some: slice) -> np.ndarray:
        """Return the number of the point of each observation of a part."""
        return np.repeat(np.arange(some.start, some.stop), np.diff(self.first[some.start : some.stop + 1]))

    def _changes(self, free: np.ndarray) -> Iterator[tuple[slice, Linear, np.ndarray]]:
        """Yield each part with what a step of the free unknowns, with 0 after them, changes, px."""
        for some in self.parts:
            linear = self._linear(some)
            yield some, linear, np.einsum("nau,nu->na", linear.by, free[linear.columns])

    def gauss_newton_step(self) -> np.ndarray:
        """Return the step to the minimum."""
        normal = self._normal
        solved = cho_solve(self._factor, normal.by_points - normal.gradient, check_finite=False)
        free = np.append(solved, 0.0)
        shift = normal.g - self.held * free[self.scale]
        for some, linear, change in self._changes(free):
            slope = linear.weight * dots(linear.by_depth, change)
            shift[some] += np.bincount(self._points(some) - some.start, slope, some.stop - some.start)
        return self._step(solved, -shift / normal.h)

    def curvature(self, step: np.ndarray) -> float:
        """Return step^T H step."""
        points, free = step[self.unknowns :], np.append(step[self.free], 0.0)
        total = float(self.held @ (points - free[self.scale]) ** 2)
        for some, linear, change in self._changes(free):
            change = change + linear.by_depth * points[self._points(some)][:, None]
            total += float(linear.weight @ dots(change, change))
        return total + sum(sum(_squares(step[prior.columns], prior.A)) for prior in self._priors)


def _squares(steps: np.ndarray, A: np.ndarray) -> list[float]:
    """Return s^T A s of each of some steps (C, m) with their matrices (C, m, m)."""
    found: list[float] = (steps[:, None] @ A @ steps[..., None]).ravel().tolist()
    return found


@kernel
def _add_points(
    normal: _Normal, start: Int64_1d, scale: Int64_1d, off: Float64_1d, held: Float64_1d, linear: Linear
) -> None:
    """Add the observations of points, and what holds them, without the points.

    start : first observation of each point and their number (P + 1,). scale : (P,) free unknown of its host's ln
    scale, or -1.
    """
    size, most = len(normal.gradient), linear.columns.shape[1]
    # A point touches few unknowns: what eliminates it is summed among these.
    columns, b, E = np.empty(size, np.int64), np.zeros(size), np.zeros(size)
    is_touched, touched, one, other = np.zeros(size, np.bool_), np.empty(most, np.int64), np.empty(most), np.empty(most)
    matrix = normal.matrix
    for p in range(len(scale)):
        count, h, g = 0, held[p], held[p] * off[p]
        if scale[p] >= 0:
            columns[0], is_touched[scale[p]], count = scale[p], True, 1
            matrix[scale[p], scale[p]] += held[p]
            b[scale[p]], E[scale[p]] = -held[p] * off[p], -held[p]
        for k in range(start[p], start[p + 1]):
            weight, used = linear.weight[k], 0
            depth_x, depth_y = linear.by_depth[k, 0], linear.by_depth[k, 1]
            error_x, error_y = linear.error[k, 0], linear.error[k, 1]
            h += weight * (depth_x * depth_x + depth_y * depth_y)
            g += weight * (depth_x * error_x + depth_y * error_y)
            for i in range(most):
                x, y, column = linear.by[k, 0, i], linear.by[k, 1, i], linear.columns[k, i]
                if column < 0 or (x == 0 and y == 0):
                    continue
                if not is_touched[column]:
                    # In order, so that the matrix is walked row by row.
                    place, is_touched[column] = count, True
                    while place > 0 and columns[place - 1] > column:
                        columns[place] = columns[place - 1]
                        place -= 1
                    columns[place] = column
                    count += 1
                b[column] += weight * (x * error_x + y * error_y)
                E[column] += weight * (x * depth_x + y * depth_y)
                matrix[column, column] += weight * (x * x + y * y)
                for j in range(used):
                    before, value = touched[j], one[j] * x + other[j] * y
                    if before == column:
                        matrix[column, column] += 2 * value
                    else:
                        matrix[max(column, before), min(column, before)] += value
                touched[used], one[used], other[used] = column, weight * x, weight * y
                used += 1
        normal.h[p], normal.g[p] = h, g
        for i in range(count):
            row = columns[i]
            by_depth = E[row] / h
            normal.gradient[row] += b[row]
            normal.by_points[row] += by_depth * g
            for j in range(i + 1):
                matrix[row, columns[j]] -= by_depth * E[columns[j]]
        for i in range(count):
            is_touched[columns[i]], b[columns[i]], E[columns[i]] = False, 0.0, 0.0
