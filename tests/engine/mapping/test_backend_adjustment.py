"""Bundle adjustment: exact data recover exact poses, scales and depths; outliers do little harm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3_exp
from scopemap.engine.mapping import lens
from scopemap.engine.mapping.bundle_adjustment import adjust, adjust_in_windows, linearised
from scopemap.engine.mapping.bundle_problem import BundleProblem, Observations, Points, Priors
from scopemap.engine.mapping.judge import LensTest
from scopemap.engine.mapping.lens import lens_test
from tests.support.drawn_bundle import FOCAL_PX, KEYFRAMES, LINE, tracked, world

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


@pytest.mark.parametrize("factor", [1.0, 0.85, 1.15])
def test_left_out_tracks_contradict_a_wrong_focal_length_and_ask_for_the_right_one(factor: float) -> None:
    rng = np.random.default_rng(11)
    T, points, observations = world(rng)
    seen = replace(observations, pixel=observations.pixel + rng.normal(0, 0.1, observations.pixel.shape))
    problem = BundleProblem(tracked(T, rng), points, seen, LOOSE, LINE, factor * FOCAL_PX)
    found = lens_test(problem, adjust(problem).state)
    assert found.log_focal == pytest.approx(-np.log(factor), abs=0.02)
    assert found.contradicts == (factor != 1.0)
    assert [notice.code for notice in found.notices] == ["camera-contradicted"] * (factor != 1.0)
    assert found.ratio == pytest.approx(1.0, abs=0.03) if factor == 1.0 else found.ratio < 0.97


def test_of_many_keyframes_those_in_the_middle_tell_of_the_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(11)
    T, points, observations = world(rng)
    monkeypatch.setattr(lens, "MOST_AT_ONCE", len(T) - 1)
    seen = replace(observations, pixel=observations.pixel + rng.normal(0, 0.1, observations.pixel.shape))
    problem = BundleProblem(tracked(T, rng), points, seen, LOOSE, LINE, 0.85 * FOCAL_PX)
    found = lens_test(problem, adjust(problem).state)
    assert found.log_focal == pytest.approx(-np.log(0.85), abs=0.03)
    assert found.contradicts


def test_a_shifted_centre_alone_contradicts_no_lens() -> None:
    rng = np.random.default_rng(11)
    T, points, observations = world(rng)
    off_px = FOCAL_PX * np.array([0.03, -0.02])
    seen = observations.pixel + off_px + rng.normal(0, 0.1, observations.pixel.shape)
    points, observations = replace(points, pixel=points.pixel + off_px), replace(observations, pixel=seen)
    problem = BundleProblem(tracked(T, rng), points, observations, LOOSE, LINE, FOCAL_PX)
    assert not lens_test(problem, adjust(problem).state).contradicts


@pytest.mark.parametrize(("held_px", "adjustment_is_worse"), [(0.99 * 0.74, False), (1.04, True), (0.78, False)])
def test_an_adjustment_is_worse_where_left_out_tracks_prefer_the_poses_as_tracked(
    held_px: float, adjustment_is_worse: bool
) -> None:
    assert LensTest(held_px=held_px, tracked_px=0.74).adjustment_is_worse == adjustment_is_worse
    assert not LensTest(held_px=held_px).adjustment_is_worse  # not tested


def test_a_scene_that_is_not_rigid_contradicts_no_lens() -> None:
    rng = np.random.default_rng(11)
    T, points, observations = world(rng)
    seen = replace(observations, pixel=observations.pixel + rng.normal(0, 1.0, observations.pixel.shape))
    problem = BundleProblem(tracked(T, rng), points, seen, LOOSE, LINE, 0.6 * FOCAL_PX)
    found = lens_test(problem, adjust(problem).state)
    assert found.ratio < 0.97
    assert not found.contradicts


def test_a_motion_that_does_not_constrain_the_focal_length_is_noted() -> None:
    rng = np.random.default_rng(3)
    T, points, observations = world(rng)
    resting = np.repeat(T[:1], len(T), axis=0)
    seen = replace(
        observations, pixel=points.pixel[observations.point] + rng.normal(0, 0.1, (len(observations.point), 2))
    )
    problem = BundleProblem(resting, points, seen, LOOSE, LINE, 0.85 * FOCAL_PX)
    notices = lens_test(problem, adjust(problem).state).notices
    assert [(notice.code, notice.level) for notice in notices] == [("camera-unconfirmed", "note")]
    nothing = Observations(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    unseen = replace(problem, observations=nothing)
    untested = lens_test(unseen, adjust(unseen).state)
    assert np.isnan(untested.held_px)
    assert not untested.notices


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


def test_a_step_can_be_asked_for_again_and_the_last_unknown_is_as_sure_as_the_inverse_says() -> None:
    rng = np.random.default_rng(0)
    T, points, observations = world(rng)
    problem = BundleProblem(tracked(T, rng), points, observations, LOOSE, LINE, FOCAL_PX, log_focal_sigma=0.5)
    model = linearised(problem, problem.begin._replace(sigma_px=1.0))
    lower = np.tril(model._normal.matrix)
    inverse = np.linalg.inv(lower + np.tril(lower, -1).T)
    step = model.gauss_newton_step()
    np.testing.assert_array_equal(model.gauss_newton_step(), step)
    np.testing.assert_allclose(model.last_sigma, np.sqrt(inverse[-1, -1]), rtol=1e-6)
