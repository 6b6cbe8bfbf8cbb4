"""The dog-leg against its own definition, closed forms and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from scopemap.engine.geometry.least_squares import DenseModel, Options, Problem, dogleg_step, minimise


def _model(seed: int, size: int = 6) -> DenseModel:
    random = np.random.default_rng(seed)
    J = random.normal(size=(20, size)) * np.exp(random.normal(size=size))
    r = random.normal(size=20)
    return DenseModel(0.5 * r @ r, J.T @ r, J.T @ J)


def _value(model: DenseModel, step: np.ndarray) -> float:
    return model.cost + model.gradient @ step + 0.5 * step @ model.hessian @ step


def _rosenbrock() -> Problem[np.ndarray]:
    def residuals(x: np.ndarray) -> np.ndarray:
        return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def linearise(x: np.ndarray) -> DenseModel:
        J, r = np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]), residuals(x)
        return DenseModel(0.5 * float(r @ r), J.T @ r, J.T @ J)

    return Problem(linearise, lambda x, step: x + step)


@given(st.integers(0, 10_000), st.floats(1e-4, 10))
@settings(max_examples=25, deadline=None)
def test_step_stays_in_the_ball_and_lowers_the_model(seed: int, radius: float) -> None:
    model = _model(seed)
    step = dogleg_step(model, model.gauss_newton_step(), radius)
    assert np.linalg.norm(step) <= radius * (1 + 1e-9)
    assert _value(model, step) < model.cost


@pytest.mark.parametrize("seed", range(5))
def test_three_cases(seed: int) -> None:
    model = _model(seed)
    newton = model.gauss_newton_step()
    np.testing.assert_allclose(model.hessian @ newton, -model.gradient, rtol=1e-8, atol=1e-8)
    length = np.linalg.norm(newton)
    np.testing.assert_allclose(dogleg_step(model, newton, 1.01 * length), newton)
    descent = -model.gradient / np.linalg.norm(model.gradient)
    cauchy = minimize_scalar(lambda h: _value(model, h * descent)).x
    np.testing.assert_allclose(dogleg_step(model, newton, 0.5 * cauchy), 0.5 * cauchy * descent, rtol=1e-6)
    between = 0.5 * (cauchy + length)
    step = dogleg_step(model, newton, between)
    # On the straight way from the Cauchy point to the Gauss-Newton step, where it leaves the ball.
    assert np.linalg.norm(step) == pytest.approx(between)
    share = (step - cauchy * descent) @ (newton - cauchy * descent) / np.sum((newton - cauchy * descent) ** 2)
    assert 0 < share < 1
    np.testing.assert_allclose(step, cauchy * descent + share * (newton - cauchy * descent), rtol=1e-5, atol=1e-9)


def test_unseen_direction_stays_at_zero() -> None:
    model = _model(1)
    hessian, gradient = model.hessian.copy(), model.gradient.copy()
    hessian[2, :] = hessian[:, 2] = gradient[2] = 0.0
    assert DenseModel(1.0, gradient, hessian).gauss_newton_step()[2] == pytest.approx(0.0, abs=1e-12)


def test_rosenbrock_from_afar() -> None:
    options = Options(radius=0.5, max_iterations=200, min_step=1e-12, min_decrease=0)
    solution = minimise(_rosenbrock(), np.array([-1.9, 2.0]), options)
    np.testing.assert_allclose(solution.state, [1, 1], atol=1e-6)
    assert solution.converged


def test_cost_never_rises_where_gauss_newton_overshoots() -> None:
    start, problem = np.array([-1.9, 2.0]), _rosenbrock()
    one = Options(radius=0.5, max_iterations=1)
    assert minimise(problem, start, one).cost <= problem.linearise(start).cost
    plain = minimise(problem, start, Options(max_iterations=1, gauss_newton=True))
    assert problem.linearise(plain.state).cost > problem.linearise(start).cost
