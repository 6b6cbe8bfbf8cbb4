"""Bundle adjustment: exact data recover exact poses, scales and depths; outliers do little harm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_bundle import FOCAL_PX, KEYFRAMES, LINE, tracked, world

from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3_exp
from scopemap.engine.mapping.bundle_adjustment import adjust, adjust_in_windows
from scopemap.engine.mapping.bundle_problem import BundleProblem, Observations, Points, Priors
from scopemap.engine.mapping.lens_residual import lens_residual, shape_change

LOOSE = Priors(rotation_rad=10, translation_share=10)


def _pose_errors(T: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    off = T @ inverse(true)
    return float(rotation_angle_rad(off[:, :3, :3]).max()), float(np.linalg.norm(off[:, :3, 3], axis=1).max())


@pytest.mark.parametrize("window", [2, 3, 4, None])
def test_exact_observations_and_depths_recover_exact_poses(window: int | None) -> None:
    rng = np.random.default_rng(7)
    T, points, observations = world(rng)
    problem = BundleProblem(tracked(T, rng), points, observations, LOOSE, LINE, FOCAL_PX)
    found = adjust(problem) if window is None else adjust_in_windows(problem, window)
    rotation_rad, translation_mm = _pose_errors(found.state.T_camera_world, T)
    assert rotation_rad < 3e-4
    assert translation_mm < 3e-2
    assert np.abs(found.state.log_depth - points.log_depth).max() < 3e-3
    assert np.isfinite(found.log_depth_sigma).all()
    assert found.sigma_px == pytest.approx(0.1)  # its floor


@pytest.mark.parametrize(
    ("factor", "shift"),
    [(1.0, (0, 0)), (0.9, (0, 0)), (1.1, (0, 0)), (1.0, (0.1, 0)), (1.0, (0, -0.1)), (1.05, (-0.05, 0.1))],
)
def test_observations_ask_for_the_right_lens(factor: float, shift: tuple[float, float]) -> None:
    rng = np.random.default_rng(11)
    T, points, observations = world(rng)
    off_px = FOCAL_PX * np.array(shift)
    seen = observations.pixel + off_px + rng.normal(0, 0.1, observations.pixel.shape)
    points, observations = replace(points, pixel=points.pixel + off_px), replace(observations, pixel=seen)
    problem = BundleProblem(tracked(T, rng), points, observations, LOOSE, LINE, factor * FOCAL_PX)
    asked = np.array(lens_residual(problem, adjust(problem).state)[:3])
    expected = np.array([-np.log(factor), *np.array(shift) / factor])
    assert asked == pytest.approx(expected, abs=0.02)
    assert ((asked == 0) == (expected == 0)).all()
    nothing = Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    unseen = replace(problem, observations=nothing)
    assert np.isnan(lens_residual(unseen, adjust(unseen).state)).all()


def test_a_change_of_shape_is_measured_in_the_scale_of_the_path_and_without_a_turn_of_each_camera() -> None:
    rng = np.random.default_rng(5)
    T, points, observations = world(rng)
    problem = BundleProblem(T, points, observations, LOOSE, LINE, FOCAL_PX)
    one = problem.tracked
    S = Similarity(1.7, se3_exp(np.array([0.3, -0.2, 0.5, 0, 0, 0]))[:3, :3], np.array([3.0, -2.0, 9.0]))
    moved = one._replace(
        T_camera_world=inverse(S.transform_poses(inverse(T))), log_depth=one.log_depth + np.log(S.scale)
    )
    assert shape_change(problem, one, moved) == pytest.approx((0, 0), abs=1e-9)
    farther = moved._replace(log_depth=moved.log_depth + np.log(1.05))
    assert shape_change(problem, one, farther) == pytest.approx((0.05, 0), abs=1e-6)
    turned = moved._replace(T_camera_world=se3_exp(np.array([0.02, 0.01, 0, 0, 0, 0])) @ moved.T_camera_world)
    assert shape_change(problem, one, turned)[0] == pytest.approx(0, abs=1e-9)
    resting = one._replace(T_camera_world=np.repeat(T[:1], len(T), axis=0))
    assert np.isnan(shape_change(problem, resting, one)).all()


def test_a_lens_is_contradicted_where_the_one_asked_for_would_change_the_shape() -> None:
    rng = np.random.default_rng(11)
    T, points, observations = world(rng)
    seen = replace(observations, pixel=observations.pixel + rng.normal(0, 0.1, observations.pixel.shape))
    codes = []
    for factor in (1.0, 0.8):
        problem = BundleProblem(tracked(T, rng), points, seen, LOOSE, LINE, factor * FOCAL_PX)
        found = adjust(problem).state
        residual = lens_residual(problem, found)
        codes.append([notice.code for notice in residual.notices])
        right = adjust(replace(problem, start=found._replace(lens=np.array([np.log(FOCAL_PX), 0, 0])))).state
        surface, path = shape_change(problem, found, right)
        assert (residual.surface, residual.path) == pytest.approx((surface, path), abs=0.01)
    assert codes == [[], ["camera-contradicted"]]


@pytest.mark.parametrize("window", [2, 3])
def test_a_window_that_nothing_is_observed_in_goes_on_as_tracked(window: int) -> None:
    rng = np.random.default_rng(9)
    T, points, observations = world(rng)
    early = np.maximum(points.host[observations.point], observations.keyframe) < 3
    some = Observations(observations.point[early], observations.keyframe[early], observations.pixel[early])
    start = tracked(T, rng)
    problem = BundleProblem(start, points, some, LOOSE, LINE, FOCAL_PX)
    found, last = adjust_in_windows(problem, window).state.T_camera_world, 5 - window
    for k in range(last + 1, KEYFRAMES):
        np.testing.assert_allclose(found[k] @ inverse(found[last]), start[k] @ inverse(start[last]), atol=1e-9)
    assert _pose_errors(found[:3], T[:3])[1] < 3e-2


def test_a_wrong_depth_scale_of_one_keyframe_is_found() -> None:
    rng = np.random.default_rng(1)
    T, points, observations = world(rng)
    sigma = np.full(len(points.host), 0.02)
    wrong = replace(points, log_depth=points.log_depth - 0.2 * (points.host == 3), sigma=sigma)
    priors = LOOSE._replace(scale=0.3)
    found = adjust(BundleProblem(tracked(T, rng), wrong, observations, priors, LINE, FOCAL_PX))
    assert found.state.log_scale[3] - np.delete(found.state.log_scale, 3).mean() == pytest.approx(0.2, abs=0.02)
    assert _pose_errors(found.state.T_camera_world, T)[0] < 2e-3


def test_a_fifth_of_outliers_does_little_harm() -> None:
    rng = np.random.default_rng(2)
    T, points, observations = world(rng)
    pixel = observations.pixel + rng.normal(0, 0.3, observations.pixel.shape)
    wild = rng.random(len(pixel)) < 0.2
    pixel[wild] += rng.uniform(-20, 20, (int(wild.sum()), 2))
    start = tracked(T, rng)
    noisy = replace(points, log_depth=points.log_depth + rng.normal(0, 0.1, len(points.host)))
    found = adjust(BundleProblem(start, noisy, replace(observations, pixel=pixel), Priors(), LINE, FOCAL_PX))
    rotation_rad, translation_mm = _pose_errors(found.state.T_camera_world, T)
    rotation_before, translation_before = _pose_errors(start, T)
    assert rotation_rad < 0.2 * rotation_before
    assert translation_mm < 0.3 * translation_before
    assert found.sigma_px == pytest.approx(0.3, rel=0.6)


def test_without_observations_nothing_changes() -> None:
    rng = np.random.default_rng(3)
    T, points, _ = world(rng)
    nothing = Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    found = adjust(BundleProblem(T, points, nothing, Priors(), LINE, FOCAL_PX))
    np.testing.assert_array_equal(found.state.T_camera_world, T)
    assert found.iterations == 0


def test_depth_uncertainty_follows_from_the_baseline() -> None:
    rng = np.random.default_rng(8)
    pixels, depth_mm, baseline_mm = rng.uniform([-70, -54], [70, 54], (50, 2)), rng.uniform(25, 60, 50), 4.0
    rays = np.column_stack([pixels / FOCAL_PX, np.ones(50)])
    T = np.stack([np.eye(4), se3_exp(np.array([0, 0, 0, -baseline_mm, 0, 0]))])
    moved = depth_mm[:, None] * rays - [baseline_mm, 0, 0]
    seen = FOCAL_PX * moved[:, :2] / moved[:, 2:]
    # No other keyframe observes the last point.
    points = Points(np.zeros(50, int), pixels, np.log(depth_mm), np.full(50, 0.1))
    found = adjust(
        BundleProblem(T, points, Observations(np.arange(49), np.ones(49, int), seen[:49]), Priors(), LINE[:1], FOCAL_PX)
    )
    # A pixel moves by fx baseline / depth, and the floor of a pixel's deviation is 0.1.
    np.testing.assert_allclose(found.log_depth_sigma[:49], 0.1 * depth_mm[:49] / (FOCAL_PX * baseline_mm), rtol=0.02)
    assert np.isinf(found.log_depth_sigma[49])
