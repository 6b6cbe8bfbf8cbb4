"""WEMA: the paper's formula in closed form, its schedule, its lag, and what it does not touch."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.config import SmoothingSettings
from scopemap.engine.geometry.se3 import inverse, se3, se3_exp, so3_exp
from scopemap.engine.tracking.smoothing import OMEGA, WEIGHTS, Wema

ALPHA, BETA, GAMMA = WEIGHTS


def _wema(dynamic: bool = True) -> SmoothingSettings:
    return SmoothingSettings(method="wema", dynamic=dynamic)


def _at(position_mm: np.ndarray) -> np.ndarray:
    return se3(np.eye(3), np.asarray(position_mm, dtype=float))


def _smoothed(poses: list[np.ndarray], chosen: SmoothingSettings) -> list[np.ndarray]:
    smoother = Wema(chosen)
    return [smoother(pose) for pose in poses]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_translations_follow_the_formula(seed: int) -> None:
    x = np.random.default_rng(seed).normal(0, 10, (8, 3))
    found = _smoothed([_at(position) for position in x], _wema())
    for i in range(2, 8):
        s = 1 - np.exp(-i * OMEGA)
        expected = s * (ALPHA * x[i] + BETA * x[i - 1] + GAMMA * x[i - 2]) + (1 - s) * x[i]
        np.testing.assert_allclose(found[i], _at(expected), atol=1e-10)


def test_rotations_about_one_axis_follow_the_formula_in_their_angles() -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3
    angles = [0.1, 0.25, 0.2, 0.5, 0.45]
    found = _smoothed([se3(so3_exp(angle * axis), np.zeros(3)) for angle in angles], _wema(dynamic=False))
    for i in range(2, 5):
        expected = ALPHA * angles[i] + BETA * angles[i - 1] + GAMMA * angles[i - 2]
        np.testing.assert_allclose(found[i][:3, :3], so3_exp(expected * axis), atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_mean_does_not_depend_on_the_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = [se3_exp(rng.normal(0, [0.2] * 3 + [5.0] * 3)) for _ in range(5)]
    T_other_world = se3_exp(rng.normal(0, [1.0] * 3 + [100.0] * 3))
    here = _smoothed(poses, _wema())
    there = _smoothed([T_other_world @ pose for pose in poses], _wema())
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(T_other_world @ a, b, atol=1e-7)
        np.testing.assert_allclose(a[:3, :3] @ a[:3, :3].T, np.eye(3), atol=1e-10)


def test_after_a_loss_the_past_is_forgotten_and_s_goes_on() -> None:
    smoother = Wema(_wema())
    x = np.array([0.0, 1.0, 2.0, 50.0, 51.0, 53.0])
    found = []
    for i, position in enumerate(x):
        if i == 3:
            smoother.reset()
        found.append(smoother(_at([position, 0, 0]))[0, 3])
    np.testing.assert_array_equal(found[3:5], x[3:5])
    s = 1 - np.exp(-5 * OMEGA)
    assert found[5] == pytest.approx(s * (ALPHA * 53 + BETA * 51 + GAMMA * 50) + (1 - s) * 53, abs=1e-9)


def test_none_is_the_default_and_leaves_poses_alone() -> None:
    smoother = Wema(SmoothingSettings())
    T = se3_exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    for _ in range(4):
        np.testing.assert_array_equal(smoother(T), T)
    np.testing.assert_allclose(inverse(T) @ smoother(T), np.eye(4), atol=1e-12)
