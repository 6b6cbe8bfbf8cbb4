"""Powell's dog-leg: a trust-region step between steepest descent and Gauss-Newton.

METHOD section WEMA-RTDL, three cases: the Gauss-Newton step if it fits into the ball of radius rho; else the steepest
descent step cut to rho if the Cauchy point h*p_sd, h = |p_sd|^2 / |J p_sd|^2, lies outside; else the point where the
way from the Cauchy point to the Gauss-Newton step leaves the ball. (The paper misprints the second condition, which
must compare h*|p_sd| with rho.) Radius update: Nocedal and Wright, "Numerical Optimization", algorithm 4.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

State = TypeVar("State")


class Quadratic(NamedTuple):
    """Cost at a point with its first derivative (n,) and its Gauss-Newton second derivative (n, n)."""

    cost: float
    gradient: np.ndarray
    hessian: np.ndarray


@dataclass(frozen=True)
class Problem(Generic[State]):
    """What is minimised, on whatever group its states live.

    `linearise` gives the quadratic model around a state, of infinite cost where the state is impossible; `retract`
    moves a state by a step (n,).
    """

    linearise: Callable[[State], Quadratic]
    retract: Callable[[State, np.ndarray], State]


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


def gauss_newton_step(model: Quadratic) -> np.ndarray:
    """Return the step (n,) to the minimum of the model; directions that it does not see stay at zero."""
    curvature = np.diag(model.hessian)
    scale = np.sqrt(np.where(curvature > 0, curvature, 1.0))
    scaled = model.hessian / np.outer(scale, scale)
    return -np.linalg.lstsq(scaled, model.gradient / scale, rcond=1e-10)[0] / scale


def dogleg_step(model: Quadratic, radius: float) -> np.ndarray:
    """Return the dog-leg step (n,) of length <= `radius`."""
    newton = gauss_newton_step(model)
    if np.linalg.norm(newton) <= radius:
        return newton
    descent = -model.gradient
    length = float(np.linalg.norm(descent))
    curvature = float(descent @ model.hessian @ descent)
    h = length**2 / curvature if curvature > 0 else np.inf
    if h * length >= radius:
        return descent * (radius / length)
    cauchy = h * descent
    way = newton - cauchy
    # |cauchy + s way| = radius, the root in 0..1.
    a, b, c = way @ way, cauchy @ way, cauchy @ cauchy - radius**2
    return cauchy + way * ((-b + np.sqrt(b * b - a * c)) / a)


def minimise(problem: Problem[State], start: State, options: Options) -> Solution[State]:
    """Search from `start`; the cost of the solution is never above the cost of `start` (except for Gauss-Newton)."""
    state, radius = start, options.radius
    model = problem.linearise(state)
    for iteration in range(1, options.max_iterations + 1):
        step = gauss_newton_step(model) if options.gauss_newton else dogleg_step(model, radius)
        length = float(np.linalg.norm(step))
        if length < options.min_step or not np.isfinite(length):
            return Solution(state, model.cost, iteration, bool(np.isfinite(length)))
        candidate = problem.retract(state, step)
        # Most steps are taken: linearising at once is cheaper than asking for the cost first.
        ahead = problem.linearise(candidate)
        if options.gauss_newton:
            state, model = candidate, ahead
            continue
        predicted = -float(model.gradient @ step + 0.5 * step @ model.hessian @ step)
        ratio = (model.cost - ahead.cost) / max(predicted, 1e-300)
        if ratio < 0.25:
            radius = 0.25 * length
        elif ratio > 0.75 and length > 0.99 * radius:
            radius = 2.0 * radius
        if ahead.cost < model.cost:
            small = model.cost - ahead.cost < options.min_decrease * model.cost
            state, model = candidate, ahead
            if small:
                return Solution(state, model.cost, iteration, True)
    return Solution(state, model.cost, options.max_iterations, False)
