"""Robust nonlinear least squares: one trust-region minimiser, robust kernels and robust scale estimates.

Powell's dog-leg, equations 7 to 9 of arXiv 2508.11282: the Gauss-Newton step (7) if within radius rho; else the
steepest descent step (8) cut to rho if h |p_sd| > rho, h = |p_sd|^2 / |J p_sd|^2 (the paper compares |p_sd|); else
where the line from the Cauchy point to the Gauss-Newton step leaves the ball (9). Radius: Nocedal and Wright,
"Numerical Optimization", algorithm 4.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

MAD_TO_SIGMA = 1.4826
"""Standard deviation over the median absolute value of a normal variable."""

RAYLEIGH_TO_SIGMA = 1 / 1.1774
"""Standard deviation, per axis, over the median length of a normal vector in the plane."""

State = TypeVar("State")


def robust_sigma(residuals: np.ndarray, least: float = 0.0) -> float:
    """Return the standard deviation of residuals of any shape, from their median absolute value; `least` of none."""
    return max(float(MAD_TO_SIGMA * np.median(np.abs(residuals))), least) if residuals.size else least


def robust_sigma_2d(lengths: np.ndarray, least: float = 0.0) -> float:
    """Return the standard deviation, per axis, of vectors in the plane from their lengths; `least` of none."""
    return max(float(RAYLEIGH_TO_SIGMA * np.median(lengths)), least) if lengths.size else least


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
class Problem(Generic[State]):
    """What is minimised, on whatever group its states are.

    `linearise` gives the model around a state; `retract` moves a state by a step (n,). `accept`, if given, changes a
    state that was stepped to, such as the scale of its robust kernel, after which the cost is another one.
    """

    linearise: Callable[[State], Model]
    retract: Callable[[State, np.ndarray], State]
    accept: Callable[[State], State] | None = None


@dataclass(frozen=True)
class Options:
    """When to stop. Steps and radius are in the problem's own units; `gauss_newton` takes every full step."""

    radius: float = 0.1
    max_iterations: int = 30
    min_step: float = 1e-5
    min_decrease: float = 1e-4
    gauss_newton: bool = False


@dataclass(frozen=True)
class Solution(Generic[State]):
    """Where the search ended: `converged` means a step or a relative decrease below the tolerance."""

    state: State
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


def minimise(problem: Problem[State], start: State, options: Options) -> Solution[State]:
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
        predicted = -float(model.gradient @ step + 0.5 * model.curvature(step))
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
