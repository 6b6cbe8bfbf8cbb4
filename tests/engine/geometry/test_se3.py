"""Rigid motions against scipy: exponential, logarithm, inverse, mean, nearest rotation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, orthogonal_procrustes
from scipy.spatial.transform import Rotation

from scopemap.engine.geometry.se3 import (
    hat,
    inverse,
    mean_near,
    orthonormalised,
    rotation_angle_rad,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
    transform,
)

few = settings(max_examples=25, deadline=None)
axes = st.integers(0, 2**32 - 1).map(lambda seed: _unit(np.random.default_rng(seed).normal(size=3)))
# Near 0, across both switches to a series, in the middle, and short of pi.
angles = st.one_of(
    st.sampled_from([0.0, 1e-12, 0.99e-7, 1.01e-7, 0.99e-5, 1.01e-5, 1e-3, np.pi - 1e-3, np.pi - 1e-5]),
    st.floats(0.0, np.pi - 1e-5),
)
translations = st.tuples(*[st.floats(-200, 200)] * 3).map(np.array)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _generator(twist: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = hat(twist[:3]), twist[3:]
    return matrix


@few
@given(axes, angles, translations)
def test_se3_exp_is_the_matrix_exponential(axis: np.ndarray, angle: float, v: np.ndarray) -> None:
    twist = np.concatenate([angle * axis, v])
    np.testing.assert_allclose(se3_exp(twist), expm(_generator(twist)), atol=1e-8)


@few
@given(axes, angles, translations)
def test_log_undoes_exp(axis: np.ndarray, angle: float, v: np.ndarray) -> None:
    twist = np.concatenate([angle * axis, v])
    back = se3_log(se3_exp(twist))
    np.testing.assert_allclose(back[:3], twist[:3], atol=1e-9)
    np.testing.assert_allclose(back[3:], v, atol=1e-6)


@few
@given(axes, st.sampled_from([0.0, 1e-9, 1e-7, 9e-7, 1.1e-6, 1e-4]), st.sampled_from([-1.0, 1.0]))
def test_log_around_pi_gives_the_same_rotation(axis: np.ndarray, short_of_pi: float, side: float) -> None:
    R = Rotation.from_rotvec((np.pi - side * short_of_pi) * axis).as_matrix()
    vector = so3_log(R)
    assert np.linalg.norm(vector) == pytest.approx(np.pi - short_of_pi, abs=1e-9)
    np.testing.assert_allclose(so3_exp(vector), R, atol=1e-7)


@few
@given(st.lists(st.tuples(axes, st.floats(0, np.pi)), min_size=1, max_size=4))
def test_rotation_angle_of_a_stack(turns: list[tuple[np.ndarray, float]]) -> None:
    rotations = np.stack([Rotation.from_rotvec(angle * axis).as_matrix() for axis, angle in turns])
    np.testing.assert_allclose(rotation_angle_rad(rotations), [angle for _, angle in turns], atol=1e-7)
    assert rotation_angle_rad(rotations[0]).shape == ()


@few
@given(axes, angles, translations, translations)
def test_inverse_and_transform(axis: np.ndarray, angle: float, v: np.ndarray, point: np.ndarray) -> None:
    T = se3_exp(np.concatenate([angle * axis, v]))
    np.testing.assert_allclose(inverse(T), np.linalg.inv(T), atol=1e-9)
    stack = np.stack([T, np.eye(4), T @ T])
    np.testing.assert_allclose(inverse(stack) @ stack, np.broadcast_to(np.eye(4), (3, 4, 4)), atol=1e-9)
    grid = np.broadcast_to(point, (2, 5, 3))
    np.testing.assert_allclose(transform(T, grid)[1, 3], (T @ [*point, 1])[:3], atol=1e-9)
    np.testing.assert_allclose(transform(inverse(T), transform(T, point)), point, atol=1e-8)


@few
@given(axes, st.floats(0, 1), translations, st.floats(0, 1))
def test_mean_of_base_and_another_lies_on_the_geodesic(axis: np.ndarray, angle: float, v: np.ndarray, w: float) -> None:
    base = se3_exp(np.array([0.4, -0.1, 0.2, 5.0, -3.0, 8.0]))
    twist = np.concatenate([angle * axis, v])
    mean = mean_near(base, [base @ se3_exp(twist), base], [w, 1 - w])
    np.testing.assert_allclose(mean, base @ se3_exp(w * twist), atol=1e-7)


@few
@given(axes, st.floats(0, 3), st.integers(0, 2**32 - 1))
def test_orthonormalised_is_the_nearest_rotation(axis: np.ndarray, angle: float, seed: int) -> None:
    noisy = np.eye(4)
    noisy[:3, :3] = so3_exp(angle * axis) + np.random.default_rng(seed).normal(0, 0.02, (3, 3))
    noisy[:3, 3] = [7, 8, 9]
    clean = orthonormalised(noisy)
    np.testing.assert_allclose(clean[:3, :3], orthogonal_procrustes(np.eye(3), noisy[:3, :3])[0], atol=1e-12)
    assert np.linalg.det(clean[:3, :3]) == pytest.approx(1)
    np.testing.assert_array_equal(clean[:3, 3], [7, 8, 9])
