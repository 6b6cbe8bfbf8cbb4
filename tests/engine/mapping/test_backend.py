"""Back end on a textured plane with exact ground truth: feature tracks and the correction of every frame."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import cv2
import numpy as np
import pytest

from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.corners import detect_corners, sample_flow
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3_exp, se3_log
from scopemap.engine.mapping import Backend, FrameCorrection, TrackedPose, hypotheses, judge
from scopemap.engine.mapping.bundle_problem import Observations, Points
from scopemap.engine.mapping.correction import KeyframeCorrection, KeyframeStep
from scopemap.engine.mapping.feature_tracks import FeatureTracks
from scopemap.engine.mapping.judge import LensTest, ShapeTest
from scopemap.result.wording import text_of
from tests.support import plane_scene
from tests.support.plane_scene import CAMERA

POSES = [
    plane_scene.pose(at_mm=(2.0 * n, 0.6 * n, 0.5 * n), turn_rad=(0.01 * n, -0.01 * n, 0.02 * n)) for n in range(6)
]


def _frame(number: int, T_tracked: np.ndarray | None = None, factor: float = 1.0) -> Frame:
    return plane_scene.frame(POSES[number], 10 * number, T_tracked, factor)


def _errors(poses: list[np.ndarray], true: list[np.ndarray]) -> tuple[float, float]:
    off = np.stack([inverse(a) @ b for a, b in zip(poses, true, strict=True)])
    return float(rotation_angle_rad(off[:, :3, :3]).max()), float(np.linalg.norm(off[:, :3, 3], axis=1).max())


def _deformed(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return a frame with a smooth deformation, by some 3 px."""
    x, y = np.meshgrid(np.arange(240, dtype=np.float32), np.arange(180, dtype=np.float32))
    swell = cv2.resize(rng.normal(0, 3, (4, 5, 2)).astype(np.float32), (240, 180), interpolation=cv2.INTER_CUBIC)
    return replace(frame, rgb=cv2.remap(frame.rgb, x + swell[..., 0], y + swell[..., 1], cv2.INTER_LINEAR))


def test_drift_is_corrected_in_keyframes_and_frames_between_them() -> None:
    drift = [se3_exp(0.01 * n * np.array([0.5, -0.6, 1.0, 20, 10, -10])) for n in range(6)]
    tracked = [error @ pose for error, pose in zip(drift, POSES, strict=True)]
    correction = plane_scene.adjusted(_frame(number, tracked[number]) for number in (0, 1, 3, 4, 5))
    before = _errors(tracked, POSES)
    rotation_rad, translation_mm = _errors([correction.pose(10 * n, T) for n, T in enumerate(tracked)], POSES)
    assert before[0] > 0.05
    assert rotation_rad < 0.1 * before[0]
    assert translation_mm < 0.15 * before[1]
    assert correction.sigma_px < 0.3
    assert "adjustment of 5 keyframes" in text_of(correction.notice)


def test_poses_stay_as_tracked_where_left_out_tracks_prefer_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hypotheses, "lens_test", lambda problem, solution: LensTest(held_px=1.04, tracked_px=0.74))
    correction = plane_scene.adjusted(_frame(number) for number in range(4))
    assert correction.refused is not None
    assert correction.refused.code == "mapping-worse"
    assert "than as tracked (0.74 px)" in text_of(correction.refused)
    np.testing.assert_array_equal(correction.pose(20, POSES[2]), POSES[2])


def test_a_keyframe_with_too_small_a_depth_gets_a_factor() -> None:
    frames = [_frame(number, factor=0.8 if number == 2 else 1.0) for number in range(6)]
    correction = plane_scene.adjusted(frames)
    factors = np.array([correction.depth_factor(10 * number) for number in range(6)])
    assert factors[2] / np.delete(factors, 2).mean() == pytest.approx(1.25, rel=0.03)
    assert correction.depth_factor(15) == pytest.approx(np.sqrt(factors[1] * factors[2]))


def test_corners_are_detected_on_usable_tissue_only() -> None:
    frame = _frame(0)
    valid, depth_mm = frame.valid.copy(), frame.depth_mm.copy()
    valid[:, 200:], depth_mm[150:] = False, np.nan
    places = detect_corners(replace(frame, valid=valid, depth_mm=depth_mm), 16)
    assert len(places) > 80
    assert (places.max(0) < [200, 150]).all()
    assert len(np.unique(places // 16, axis=0)) == len(places)


def test_keyframes_without_corners_change_nothing() -> None:
    speckled = np.random.default_rng(0).random(plane_scene.EVERYWHERE.shape) < 0.6
    correction = plane_scene.adjusted(replace(_frame(number), valid=speckled) for number in range(3))
    np.testing.assert_array_equal(correction.pose(20, POSES[2]), POSES[2])


def test_flow_is_sampled_at_more_points_than_opencv_allows() -> None:
    flow = np.random.default_rng(0).normal(size=(180, 240, 2)).astype(np.float32)
    found = sample_flow(flow, np.tile([[3.0, 5.0], [-5.0, 2.0]], (18000, 1)))
    np.testing.assert_allclose(found[::2], np.tile(flow[5, 3], (18000, 1)), atol=1e-5)
    assert np.isnan(found[1::2]).all()


def test_an_error_with_a_keyframe_is_raised_at_a_later_call(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: FeatureTracks, keyframe: Frame, map_number: int, known: object) -> None:
        raise RuntimeError("flow broke")

    monkeypatch.setattr(FeatureTracks, "add", broken)
    mapper = Backend(MappingSettings(), DisFlow())
    mapper.add(_frame(0))
    with pytest.raises(RuntimeError, match="flow broke"):
        mapper.adjust()


def _tracked(keyframe: int, x_mm: float, lost_before: int = 0) -> TrackedPose:
    return TrackedPose(0, keyframe, se3_exp(np.array([0, 0, 0, x_mm, 0, 0])), lost_before)


def test_corrections_are_interpolated_by_the_camera_motion() -> None:
    T = np.stack([np.eye(4), se3_exp(np.array([0, 0, 0, 4.0, 0, 0]))])
    tracked = {0: _tracked(0, 0), 2: _tracked(0, 1), 5: _tracked(0, 2), 7: _tracked(0, 9), 10: _tracked(0, 10)}
    correction = FrameCorrection(np.array([0, 10]), T, np.log([1.0, 2.0]), tracked=tracked, depth_mm=50.0)
    for index, share in ((0, 0), (2, 0.1), (5, 0.2), (7, 0.9), (10, 1)):
        assert correction.pose(index, np.eye(4))[0, 3] == pytest.approx(4 * share)
        assert correction.depth_factor(index) == pytest.approx(2.0**share)
    # Before and after all keyframes the nearest correction holds.
    np.testing.assert_array_equal(replace(correction, index=correction.index + 5).pose(3, np.eye(4)), T[0])
    assert correction.depth_factor(99) == pytest.approx(2.0)
    # Frame 4 has no tracked pose, and a camera at rest has no motion: time is used.
    assert correction.pose(4, np.eye(4))[0, 3] == pytest.approx(1.6)
    resting = replace(correction, tracked={0: _tracked(0, 3), 5: _tracked(0, 3), 10: _tracked(0, 3)})
    assert resting.pose(5, np.eye(4))[0, 3] == pytest.approx(2.0)


def test_the_motion_from_a_keyframe_is_scaled_as_its_depth_is() -> None:
    T = np.stack([np.eye(4), se3_exp(np.array([0, 0, 0, 4.0, 0, 0]))])
    tracked = {0: _tracked(0, 0), 4: _tracked(0, 4), 10: _tracked(0, 10), 13: _tracked(10, 13)}
    correction = FrameCorrection(np.array([0, 10]), T, np.log([1.4, 2.0]), tracked=tracked, depth_mm=50.0)
    # Frame 10 was 10 mm from keyframe 0, whose depth asks for 14, where the adjustment has it.
    for index, x_mm in ((0, 0), (4, 5.6), (10, 14), (13, 20)):
        pose = correction.pose(index, tracked[index].T_world_camera)
        assert pose[0, 3] == pytest.approx(x_mm)


def test_the_step_of_a_keyframe_that_was_moved_as_it_came_is_spread_over_the_frames_that_lead_to_it() -> None:
    """Frames drift by 0.5 mm until the next keyframe, every tenth, which comes back to its place."""
    mapper = Backend(MappingSettings(), DisFlow())
    drift, tracked = se3_exp(np.array([0, 0, 0, 0.5, 0, 0])), {}
    for number, true in enumerate(POSES):
        mapper.add(
            _frame(number),
            tracked.setdefault(10 * number, TrackedPose(0, max(10 * number - 10, 0), true)),
            step=KeyframeStep(drift, after=KeyframeCorrection(np.log(1.25))) if number else None,
        )
        if number:
            middle = POSES[number - 1] @ se3_exp(0.5 * se3_log(inverse(POSES[number - 1]) @ true))
            half = se3_exp(np.array([0, 0, 0, 0.25, 0, 0]))
            tracked[10 * number - 5] = TrackedPose(0, 10 * number - 10, middle @ half)
    correction = plane_scene.only(mapper.adjust(0, tracked))
    for number in range(1, len(POSES)):
        before, own, after = (correction.pose(i, tracked[i].T_world_camera) for i in np.arange(-10, 1, 5) + 10 * number)
        between = 0.5 * (before + after)[:3, 3]
        assert np.linalg.norm(own[:3, 3] - between) < 0.01
        factors = [correction.depth_factor(i) for i in np.arange(-10, 1, 5) + 10 * number]
        assert factors[1] == pytest.approx(np.sqrt(1.25 * factors[0] * factors[2]), rel=0.01)
    moved = correction.in_world(drift)
    for index in (15, 20):
        pose = moved.pose(index, tracked[index].T_world_camera)
        np.testing.assert_allclose(pose, drift @ correction.pose(index, tracked[index].T_world_camera), atol=1e-9)


@pytest.mark.parametrize(
    ("keyframes", "tracked", "expected"),
    [
        # Frames up to 23 follow keyframe 20; the next are relocalised against keyframe 10, and keyframe 30 follows.
        (
            (0, 10, 20, 30),
            {
                **{0: _tracked(0, 0), 10: _tracked(0, 1), 20: _tracked(10, 2), 30: _tracked(10, 3)},
                **{22: _tracked(20, 2.2), 26: _tracked(10, 2.6), 33: _tracked(30, 3.3), 35: _tracked(20, 3.5)},
            },
            {20: 2, 22: 2, 26: 3, 30: 3, 33: 3, 35: 2},
        ),
        # Frames 4 and 5 were lost; the next are relocalised against keyframe 0, and keyframe 10 follows.
        (
            (0, 10),
            {
                **{0: _tracked(0, 0), 2: _tracked(0, 0.2), 7: _tracked(0, 0.7, 2)},
                **{10: _tracked(0, 1, 2), 12: _tracked(10, 1.2, 2)},
            },
            {2: 0, 7: 1, 12: 1},
        ),
    ],
)
def test_corrections_are_not_interpolated_across_a_loss(
    keyframes: tuple[int, ...], tracked: dict[int, TrackedPose], expected: dict[int, int]
) -> None:
    T = np.stack([se3_exp(np.array([0, 0, 0, 1.0 * k, 0, 0])) for k in range(len(keyframes))])
    correction = FrameCorrection(np.array(keyframes), T, np.zeros(len(T)), tracked=tracked, depth_mm=50.0)
    for index, of in expected.items():
        np.testing.assert_allclose(correction.pose(index, np.eye(4)), T[of], atol=1e-12)


def test_poses_stay_as_tracked_where_tissue_deforms() -> None:
    rng = np.random.default_rng(1)
    correction = plane_scene.adjusted([_deformed(frame, rng) for frame in map(_frame, range(5))])
    assert correction.refused
    assert correction.sigma_px > 0.8
    assert correction.depth_factor(20) == 1.0
    np.testing.assert_array_equal(correction.pose(20, POSES[2]), POSES[2])
    assert "no rigid scene" in text_of(correction.notice)


def test_a_second_in_which_tissue_moves_is_not_hidden_by_the_rest_of_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    assert judge.refusal_by_views(0.6, 0.9, 0.8, ShapeTest(), 20) is None
    moving = judge.refusal_by_views(0.6, 1.7, 0.8, ShapeTest(), 20)
    assert moving is not None
    assert (moving.code, moving.values["sigma_px"]) == ("mapping-not-rigid", 1.7)
    asked = []
    monkeypatch.setattr(hypotheses, "refusal_by_views", lambda *errors: asked.append(errors[:2]))
    frames = [_frame(number) for number in range(6)]
    plane_scene.adjusted(frames)
    plane_scene.adjusted([*frames[:5], _deformed(frames[5], np.random.default_rng(1))])
    (_, near_rigid_px), (moving_px, near_moving_px) = asked
    assert near_rigid_px < 0.4
    assert near_moving_px > max(0.96, 2 * moving_px)


def test_an_adjustment_says_what_determines_the_shape() -> None:
    factors = np.exp(0.2 * np.sin(np.linspace(-2, 2, CAMERA.width))).astype(np.float32)
    correction = plane_scene.adjusted(
        [replace(frame, depth_mm=frame.depth_mm * factors) for frame in map(_frame, range(5))]
    )
    assert correction.shape.outcome == "determined"
    assert [notice.code for notice in correction.notices][:2] == ["mapping-adjusted", "shape-determined"]


def test_poses_stay_as_tracked_where_the_starts_end_in_different_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    undetermined = ShapeTest("not determined", False, 0.2, 0.3, 0.30, 0.31)
    monkeypatch.setattr(hypotheses, "with_other_starts", lambda problem, found, is_rigid: (found, undetermined))
    kept = plane_scene.adjusted(map(_frame, range(5)))  # one rigid scene fits: the poses are the better ones
    assert [notice.code for notice in kept.notices][:2] == ["mapping-adjusted", "shape-not-determined"]
    monkeypatch.setattr(judge, "RIGID_SIGMA_PX", 0.01)
    correction = plane_scene.adjusted(map(_frame, range(5)))
    assert [notice.code for notice in correction.notices] == ["mapping-not-determined"]
    assert "depth network alone" in text_of(correction.notice)
    assert correction.depth_factor(20) == 1.0
    np.testing.assert_array_equal(correction.pose(20, POSES[2]), POSES[2])


@pytest.mark.parametrize("zoom", [0.0, 0.04])
def test_an_adjustment_that_makes_depths_disagree_is_refused(zoom: float, monkeypatch: pytest.MonkeyPatch) -> None:
    def biased(
        self: FeatureTracks, keyframes: Collection[int] | None = None, most: int | None = None
    ) -> tuple[Points, Observations]:
        """Return observations like those of a camera that comes nearer, which a rigid scene explains."""
        points, observations = collected(self, keyframes, most)
        later = observations.keyframe - points.host[observations.point]
        return points, replace(observations, pixel=observations.pixel * np.exp(zoom * later)[:, None])

    collected = FeatureTracks.collected
    monkeypatch.setattr(FeatureTracks, "collected", biased)
    drift = [se3_exp(0.003 * n * np.array([0.5, -0.6, 1.0, 20, 10, -10])) for n in range(6)]
    tracked = [error @ pose for error, pose in zip(drift, POSES, strict=True)]
    # Where other starts confirm the shape, depth that was not used does not judge it.
    settings = MappingSettings(other_starts=False)
    correction = plane_scene.adjusted((_frame(number, T) for number, T in enumerate(tracked)), settings)
    assert correction.sigma_px < 0.8
    assert (correction.notice.code == "mapping-depth-disagrees") == bool(zoom)
    before = _errors(tracked, POSES)
    after = _errors([correction.pose(10 * n, T) for n, T in enumerate(tracked)], POSES)
    assert after == before if zoom else after < (0.3 * before[0], 0.3 * before[1])
