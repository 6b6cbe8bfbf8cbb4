"""Feature tracks that shading and long ways do not bias: composed starts of flow, aligned patches, shared errors."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from scopemap.engine.flow.corners import normalised_brightness, refined_corners
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.flow.estimator import FlowEstimator, NoFlow
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.mapping import feature_tracks
from scopemap.engine.mapping.bundle_adjustment import adjust
from scopemap.engine.mapping.bundle_problem import BundleProblem, Observations, Priors
from scopemap.engine.mapping.feature_tracks import FeatureTracks
from tests.support import plane_scene
from tests.support.drawn_bundle import FOCAL_PX, LINE, tracked, world
from tests.support.plane_scene import CAMERA


class _Biased(DisFlow):
    """DIS flow with a bias along x that both directions share, so that they stay consistent."""

    def estimate_both(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        forth, back = super().estimate_both(rgb_a, rgb_b)
        return forth + np.float32([0.8, 0]), back - np.float32([0.8, 0])


def _errors_px(flow: FlowEstimator, gap: int, step_mm: float, nearer_mm: float = 0.0) -> np.ndarray:
    """Errors (n,) of the observations at a gap between keyframes that slide along the plane, and come nearer."""
    poses = [plane_scene.pose(at_mm=(step_mm * n, 0.0, nearer_mm * n)) for n in range(gap + 1)]
    tracks = FeatureTracks(flow, gaps=(gap,))
    for number, pose in enumerate(poses):
        tracks.add(plane_scene.frame(pose, number))
    points, observations = tracks.collected()
    host = points.host[observations.point]
    errors = []
    for one, pixel, h, t in zip(observations.point, observations.pixel, host, observations.keyframe, strict=True):
        x = np.exp(points.log_depth[one]) * np.append(points.pixel[one] / CAMERA.fx, 1.0)
        T = inverse(poses[t]) @ poses[h]
        there = T[:3, :3] @ x + T[:3, 3]
        errors.append(np.linalg.norm(CAMERA.fx * there[:2] / there[2] - pixel))
    return np.array(errors)


def test_patches_take_away_a_bias_that_flow_shares_in_both_directions() -> None:
    away = _errors_px(_Biased(), 1, 2.0)
    assert len(away) > 150
    assert np.median(away) < 0.15


def test_patches_do_not_lag_where_the_camera_comes_nearer() -> None:
    # By a quarter of the distance: patches that are only shifted are 0.5 px off.
    nearer = _errors_px(DisFlow(), 1, 0.0, 12.0)
    assert len(nearer) > 100
    assert np.median(nearer) < 0.12


def test_distant_keyframes_are_matched_along_those_between(monkeypatch: pytest.MonkeyPatch) -> None:
    # 66 px in steps of 11: more than a quarter of the picture, which a search from zero hardly finds.
    along = _errors_px(DisFlow(), 6, 11.0 / 3.0)
    monkeypatch.setattr(feature_tracks, "_expected_flows", lambda past, new: None)
    at_once = _errors_px(DisFlow(), 1, 22.0)
    good, without = (int((away < 0.5).sum()) for away in (along, at_once))
    assert good > 100
    assert good > 1.5 * without
    assert np.median(along) < 0.25


def test_a_map_that_the_camera_leaves_goes_on_when_it_comes_back() -> None:
    tracks = FeatureTracks(DisFlow(), gaps=(1, 2, 3))
    poses = [plane_scene.pose(at_mm=(2.0 * n, 0.0, 0.0)) for n in range(4)]
    for number, (pose, map_number) in enumerate(zip(poses, (0, 0, 1, 0), strict=True)):
        tracks.add(plane_scene.frame(pose, number), map_number)
    points, observations = tracks.collected()
    pairs = set(zip(points.host[observations.point].tolist(), observations.keyframe.tolist(), strict=True))
    assert pairs == {(0, 1), (1, 0), (1, 3), (3, 1), (0, 3), (3, 0)}


def test_keyframes_that_are_far_apart_are_matched_from_depth_and_poses_as_tracked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # 72 px in twelve steps; and four times as much, with nothing in common.
    along = _errors_px(DisFlow(), 12, 2.0)
    assert not len(_errors_px(DisFlow(), 12, 8.0))
    monkeypatch.setattr(feature_tracks, "_expected_flows", lambda past, new: None)
    at_once = _errors_px(DisFlow(), 1, 24.0)
    good, without = (int((away < 0.5).sum()) for away in (along, at_once))
    assert good > 80
    assert good > 1.5 * without
    assert np.median(along) < 0.25


@pytest.mark.parametrize(("step_mm", "tried"), [(2.0, 6), (None, 3)])
def test_farther_keyframes_are_tried_only_where_nearer_ones_have_corners_in_common(
    step_mm: float | None, tried: int
) -> None:
    tracks, rng, pairs = FeatureTracks(DisFlow(), gaps=(1, 2, 3)), np.random.default_rng(0), 0
    for number in range(4):
        frame = plane_scene.frame(plane_scene.pose(at_mm=((step_mm or 0.0) * number, 0.0, 0.0)), number)
        if step_mm is None:  # each another picture
            frame = replace(frame, rgb=rng.integers(0, 255, frame.rgb.shape, np.uint8))
        pairs += len(tracks.add(frame).pairs)
    assert pairs == tried


def test_patches_that_differ_are_no_observations() -> None:
    view, rng = plane_scene.see(plane_scene.pose()), np.random.default_rng(0)
    noise = rng.integers(0, 255, view.rgb.shape, np.uint8)
    image, other = normalised_brightness(view.rgb), normalised_brightness(noise)
    corners = np.stack(np.meshgrid(np.arange(30, 210, 20), np.arange(30, 150, 20)), -1).reshape(-1, 2)
    still = np.zeros((*image.shape, 2), np.float32)
    kept, pixels = refined_corners(image, image, corners, corners + rng.uniform(-0.7, 0.7, corners.shape), still)
    assert len(kept) > 0.95 * len(corners)
    np.testing.assert_allclose(pixels, corners[kept], atol=0.05)
    assert len(refined_corners(image, other, corners, corners.astype(float), still)[0]) < 0.2 * len(corners)
    assert len(refined_corners(image, image, corners[:0], corners[:0], still)[0]) == 0


def test_observations_that_share_their_errors_count_as_one() -> None:
    rng = np.random.default_rng(3)
    T, points, observations = world(rng)
    observations = replace(observations, pixel=observations.pixel + rng.normal(0, 3.0, observations.pixel.shape))
    once = BundleProblem(tracked(T, rng), points, observations, Priors(translation_share=0.002), LINE, FOCAL_PX)
    repeated = Observations(*(np.repeat(part, 4, axis=0) for part in observations.__dict__.values()))
    problems = once, replace(once, observations=repeated, correlated=4.0), replace(once, observations=repeated)
    wanted, found, trusted = (adjust(p, max_iterations=50, min_decrease=1e-8).state for p in problems)
    np.testing.assert_allclose(found.T_camera_world, wanted.T_camera_world, atol=1e-3)
    np.testing.assert_allclose(found.log_scale, wanted.log_scale, atol=1e-4)
    assert np.abs(trusted.T_camera_world - wanted.T_camera_world).max() > 0.02


def test_of_a_long_video_every_nth_point_is_adjusted() -> None:
    tracks = FeatureTracks(DisFlow(), gaps=(1, 2))
    for number in range(4):
        tracks.add(plane_scene.frame(plane_scene.pose(at_mm=(2.0 * number, 0.0, 0.0)), number))
    points, observations = tracks.collected()
    most = len(observations.point) // 3 + 1
    fewer_points, fewer = tracks.collected(most_observations=most)
    every = -(-len(observations.point) // most)
    assert np.array_equal(fewer_points.pixel, points.pixel[::every])
    assert 0.6 * most < len(fewer.point) <= 1.1 * most
    counts = np.bincount(observations.point, minlength=len(points.host))
    assert np.array_equal(np.bincount(fewer.point, minlength=len(fewer_points.host)), counts[::every])


def test_across_a_cut_flow_is_searched_from_where_poses_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def observations() -> int:
        tracks = FeatureTracks(DisFlow(), gaps=(1,))
        for number, at_mm in enumerate((0.0, 20.0)):
            tracks.add(plane_scene.frame(plane_scene.pose(at_mm=(at_mm, 0.0, 0.0)), number))
        return len(tracks.collected()[1].point)

    assert observations() > 150
    monkeypatch.setattr(feature_tracks, "_expected_flows", lambda past, new: None)
    assert observations() < 10  # flow alone does not reach so far


def test_observations_between_parts_alone_and_the_median_depth_of_some_keyframes() -> None:
    tracks = FeatureTracks(DisFlow(), gaps=(1, 2))
    for number in range(4):
        tracks.add(plane_scene.frame(plane_scene.pose(at_mm=(2.0 * number, 0.0, 0.0)), number))
    points, observations = tracks.collected()
    part_of = np.array([0, 0, 1, 1])
    between = part_of[points.host[observations.point]] != part_of[observations.keyframe]
    assert 0 < between.sum() < len(between)
    same_points, found = tracks.collected(across=part_of)
    assert np.array_equal(same_points.pixel, points.pixel)
    for part, wanted in zip(found.columns, observations.columns, strict=True):
        assert np.array_equal(part, wanted[between])
    assert tracks.median_depth_mm([1, 2]) == tracks.collected([1, 2])[0].median_mm
    assert tracks.median_depth_mm([]) is None


def test_what_windows_have_matched_is_not_matched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    matched, both_ways = Mock(wraps=feature_tracks._matched), 2
    frames = [plane_scene.frame(plane_scene.pose(at_mm=(1.5 * n, 0.5 * n, 0.0)), n) for n in range(5)]
    alone, far = FeatureTracks(DisFlow(), gaps=(1, 2, 3)), FeatureTracks(NoFlow(), gaps=(1, 2, 3))
    near = FeatureTracks(DisFlow(), gaps=(1, 2))
    for frame in frames:
        alone.add(frame)
        known = near.add(frame)
        with monkeypatch.context() as patched:
            patched.setattr(feature_tracks, "_matched", matched)
            far.add(frame, known=known)
    for one, other in zip(alone.collected(), far.collected(), strict=True):
        for name in vars(one):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    # Only keyframes three apart are left: 0 and 3, 1 and 4.
    assert matched.call_count == 2 * both_ways
