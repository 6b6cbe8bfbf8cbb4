"""Poses from 2D-3D correspondences: exact motions come back, outliers and wrong depth count little; what moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.corners import Correspondences2D3D
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3_exp
from scopemap.engine.tracking.corner_pose import nonrigidity, pose_from_correspondences

CAMERA = PinholeCamera(150.0, 151.0, 79.5, 63.5, 160, 128)
TRUE = se3_exp(np.array([0.02, -0.03, 0.05, 2.0, -1.0, 1.5]))


def _observed(T: np.ndarray, depth_error: np.ndarray | float = 1.0, seed: int = 0) -> Correspondences2D3D:
    """Points on a rough wall where a motion takes them, with depth that is wrong by a factor."""
    rng = np.random.default_rng(seed)
    points = CAMERA.unproject(rng.uniform([10, 10], [150, 118], (300, 2))) * rng.uniform(20, 60, (300, 1))
    pixels = CAMERA.project(points @ T[:3, :3].T + T[:3, 3])
    return Correspondences2D3D(points * np.reshape(depth_error, (-1, 1)), pixels, 0.9, 0)


def _pose(correspondences: Correspondences2D3D, start: np.ndarray | None = None, sigma: float = 0.2) -> np.ndarray:
    T = pose_from_correspondences(correspondences, CAMERA, np.eye(4) if start is None else start, sigma)
    assert T is not None
    return T


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6), st.integers(0, 2**16))
def test_a_motion_that_explains_all_is_found_exactly(share: list[float], seed: int) -> None:
    T = se3_exp(np.array(share) * [0.15, 0.15, 0.15, 4.0, 4.0, 4.0])
    for sigma in (0.2, 0.0):
        np.testing.assert_allclose(_pose(_observed(T, seed=seed), sigma=sigma), T, atol=2e-3)


def test_outliers_hardly_move_the_pose() -> None:
    noisy = _observed(TRUE)
    rng = np.random.default_rng(1)
    pixels = noisy.pixels + rng.normal(0, 0.3, noisy.pixels.shape)
    pixels[:100] += rng.uniform(-40, 40, (100, 2))
    error = inverse(TRUE) @ _pose(replace(noisy, pixels=pixels))
    assert np.linalg.norm(error[:3, 3]) < 0.3
    assert np.degrees(rotation_angle_rad(error[:3, :3])) < 0.3


def test_wrong_depth_biases_rotation_less_where_it_is_expected() -> None:
    true = se3_exp(np.array([0.02, -0.03, 0.05, 4.0, -2.0, 1.5]))

    def rotation_error(sigma: float, seed: int) -> float:
        wrong = np.exp(np.random.default_rng(seed).normal(0, 0.25, 300))
        return float(rotation_angle_rad((_pose(_observed(true, wrong), true, sigma) @ inverse(true))[:3, :3]))

    expected, trusted = (np.mean([rotation_error(sigma, seed) for seed in range(20)]) for sigma in (0.2, 1e-6))
    assert expected < 0.8 * trusted


def test_too_few_points_and_points_behind_give_no_pose() -> None:
    seen = _observed(TRUE)
    few = Correspondences2D3D(seen.points_mm[:49], seen.pixels[:49], 0.2, 0)
    assert pose_from_correspondences(few, CAMERA, np.eye(4), 0.2) is None
    assert pose_from_correspondences(replace(seen, points_mm=-seen.points_mm), CAMERA, np.eye(4), 0.2) is None


@pytest.mark.parametrize("moved_px", [0.0, 0.2, 3.0])
def test_what_all_corners_move_beside_the_rigid_motion_is_told_in_deviations_of_a_match(moved_px: float) -> None:
    seen = _observed(TRUE)
    moved = replace(seen, pixels=seen.pixels + np.array([moved_px, 0.0]))
    found = nonrigidity(moved, CAMERA, TRUE, 0.0)
    # Matches have a standard deviation of 0.5 px, and these do not scatter.
    np.testing.assert_allclose(found[np.isfinite(found)], moved_px / 0.5, atol=1e-5)
    assert np.isfinite(found).sum() > 30
