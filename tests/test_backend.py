"""The back end on a textured plane whose truth is a closed form: links, correction of every frame, waiting frames."""

from __future__ import annotations

from concurrent.futures import wait
from dataclasses import replace

import cv2
import numpy as np
import plane_scene
import pytest
from plane_scene import CAMERA

from scopemap.config import MappingSettings
from scopemap.flow.corners import detect_corners, sample_flow
from scopemap.flow.dis import DisFlow
from scopemap.frame import Frame
from scopemap.geometry.align import Similarity
from scopemap.geometry.se3 import inverse, rotation_angle_rad, se3_exp
from scopemap.mapping import Backend, Correction, TrackedPose
from scopemap.mapping.backend import _Keyframe, _neighbours, _of
from scopemap.mapping.bundle_adjustment import Solution
from scopemap.mapping.depth_correction import DepthGrid
from scopemap.mapping.feature_tracks import Linker
from scopemap.mapping.loop_closure import Loop
from scopemap.mapping.reprojection import Points, State

POSES = [
    plane_scene.pose(at_mm=(2.0 * n, 0.6 * n, 0.5 * n), turn_rad=(0.01 * n, -0.01 * n, 0.02 * n)) for n in range(6)
]


def _frame(number: int, T_tracked: np.ndarray | None = None, factor: float = 1.0) -> Frame:
    """View number `number` of the plane, as if tracked at `T_tracked` with depth wrong by `factor`."""
    view = plane_scene.see(POSES[number])
    T = view.T_world_camera if T_tracked is None else T_tracked
    depth_mm = (factor * view.depth_mm).astype(np.float32)
    return Frame(10 * number, number / 3, view.rgb, CAMERA, plane_scene.EVERYWHERE, depth_mm, T)


def _errors(poses: list[np.ndarray], true: list[np.ndarray]) -> tuple[float, float]:
    off = np.stack([inverse(a) @ b for a, b in zip(poses, true, strict=True)])
    return float(rotation_angle_rad(off[:, :3, :3]).max()), float(np.linalg.norm(off[:, :3, 3], axis=1).max())


def test_drifting_poses_are_set_right_and_frames_between_keyframes_with_them() -> None:
    drift = [se3_exp(0.01 * n * np.array([0.5, -0.6, 1.0, 20, 10, -10])) for n in range(6)]
    tracked = [error @ pose for error, pose in zip(drift, POSES, strict=True)]
    backend = Backend(MappingSettings(), DisFlow())
    for number in (0, 1, 3, 4, 5):
        backend.add(_frame(number, tracked[number]))
    correction = backend.adjust()
    before = _errors(tracked, POSES)
    turn, way = _errors([correction.pose(10 * n, T) for n, T in enumerate(tracked)], POSES)
    assert before[0] > 0.05
    assert turn < 0.1 * before[0]
    assert way < 0.15 * before[1]
    assert correction.sigma_px < 0.3
    assert "5 keyframes adjusted" in correction.description


def test_a_keyframe_with_too_small_a_depth_gets_a_factor() -> None:
    backend = Backend(MappingSettings(depth_share=0.05, scale_sigma=0.3), DisFlow())
    for number in range(6):
        backend.add(_frame(number, factor=0.8 if number == 2 else 1.0))
    correction = backend.adjust()
    factors = np.array([correction.depth_factor(10 * number) for number in range(6)])
    assert factors[2] / np.delete(factors, 2).mean() == pytest.approx(1.25, rel=0.03)
    assert correction.depth_factor(15) == pytest.approx(np.sqrt(factors[1] * factors[2]))


def test_points_are_seen_where_the_plane_says() -> None:
    linker = Linker(MappingSettings(gaps=(1, 2)), DisFlow())
    for number in (0, 1, 2):
        linker.add(_frame(number))
    points, sightings = linker.collected()
    assert (np.diff(points.host) >= 0).all()
    assert (np.diff(sightings.point) >= 0).all()
    hosts = points.host[sightings.point]
    assert {(int(a), int(b)) for a, b in zip(hosts, sightings.keyframe, strict=True)} == {
        *((0, 1), (1, 0), (1, 2), (2, 1), (0, 2), (2, 0)),
    }
    for host in range(3):
        for other in {0, 1, 2} - {host}:
            some = (hosts == host) & (sightings.keyframe == other)
            number = sightings.point[some]
            in_host = np.exp(points.log_depth[number])[:, None] * np.column_stack(
                [points.pixel[number] / CAMERA.fx, np.ones(len(number))]
            )
            T = inverse(POSES[other]) @ POSES[host]
            truth = CAMERA.project(in_host @ T[:3, :3].T + T[:3, 3]) - [CAMERA.cx, CAMERA.cy]
            away = np.linalg.norm(truth - sightings.pixel[some], axis=1)
            assert some.sum() > 80
            assert np.median(away) < 0.25


def test_keyframes_that_are_not_named_by_the_gaps_are_not_linked() -> None:
    linker = Linker(MappingSettings(gaps=(2,)), DisFlow())
    for number in (0, 1, 2):
        linker.add(_frame(number))
    points, sightings = linker.collected()
    assert set(np.abs(points.host[sightings.point] - sightings.keyframe)) == {2}


def test_corners_are_found_where_there_are_some_and_only_on_usable_tissue() -> None:
    rgb = np.full((180, 240, 3), 90, np.uint8)
    for x, y in ((40, 40), (136, 100)):
        rgb[y : y + 4, x : x + 4] = 200
    valid = plane_scene.EVERYWHERE.copy()
    valid[:, 200:] = False
    depth_mm = np.full((180, 240), 50.0, np.float32)
    depth_mm[150:] = np.nan
    places = detect_corners(Frame(0, 0.0, rgb, CAMERA, valid, depth_mm), 16)
    for x, y in ((41.5, 41.5), (137.5, 101.5)):
        assert np.abs(places - [x, y]).max(1).min() <= 3
    assert places[:, 0].max() < 200
    assert places[:, 1].max() < 150
    cells = places // 16
    assert len(np.unique(cells, axis=0)) == len(cells)


def test_keyframes_without_a_single_corner_are_no_harm() -> None:
    speckled = np.random.default_rng(0).random(plane_scene.EVERYWHERE.shape) < 0.6
    backend = Backend(MappingSettings(), DisFlow())
    for number in range(3):
        backend.add(replace(_frame(number), valid=speckled))
    correction = backend.adjust()
    np.testing.assert_array_equal(correction.pose(20, POSES[2]), POSES[2])
    assert "nothing linked" in correction.description


def test_more_points_than_opencv_takes_columns_are_sampled() -> None:
    flow = np.random.default_rng(0).normal(size=(180, 240, 2)).astype(np.float32)
    pixel = np.tile([[3.0, 5.0], [10.0, 20.0], [-5.0, 2.0]], (12000, 1))
    found = sample_flow(flow, pixel)
    np.testing.assert_allclose(found[:2], [flow[5, 3], flow[20, 10]], atol=1e-5)
    assert np.isnan(found[2]).all()
    assert found.shape == (36000, 2)


def test_what_goes_wrong_with_a_keyframe_is_heard_of_at_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: Linker, keyframe: Frame, map_number: int) -> None:
        raise RuntimeError("flow broke")

    monkeypatch.setattr(Linker, "add", broken)
    backend = Backend(MappingSettings(), DisFlow())
    backend.add(_frame(0))
    wait(backend._links)
    with pytest.raises(RuntimeError, match="flow broke"):
        backend.add(_frame(1))


def test_outside_all_keyframes_the_nearest_correction_holds() -> None:
    T = np.stack([se3_exp(np.array([0, 0, 0.1 * k, k, 0, 0.0])) for k in range(3)])
    correction = Correction(np.array([10, 20, 40]), T, np.log([1.0, 1.1, 1.3]))
    np.testing.assert_allclose(correction.pose(3, np.eye(4)), T[0])
    np.testing.assert_allclose(correction.pose(20, np.eye(4)), T[1])
    np.testing.assert_allclose(correction.pose(99, np.eye(4)), T[2])
    assert correction.depth_factor(99) == pytest.approx(1.3)
    middle = correction.pose(30, np.eye(4))
    assert rotation_angle_rad(middle[:3, :3]) == pytest.approx(0.15)
    assert "as tracked" in correction.description


def _tracked(keyframe: int, x_mm: float, segment: int = 0) -> TrackedPose:
    return TrackedPose(0, keyframe, se3_exp(np.array([0, 0, 0, x_mm, 0, 0])), segment)


def test_a_frame_takes_as_much_of_the_next_correction_as_it_has_moved() -> None:
    T = np.stack([np.eye(4), se3_exp(np.array([0, 0, 0, 4.0, 0, 0]))])
    tracked = {0: _tracked(0, 0), 2: _tracked(0, 1), 5: _tracked(0, 2), 7: _tracked(0, 9), 10: _tracked(0, 10)}
    correction = Correction(np.array([0, 10]), T, np.log([1.0, 2.0]), tracked=tracked, depth_mm=50.0)
    for index, share in ((0, 0), (2, 0.1), (5, 0.2), (7, 0.9), (10, 1)):
        assert correction.pose(index, np.eye(4))[0, 3] == pytest.approx(4 * share)
        assert correction.depth_factor(index) == pytest.approx(2.0**share)
    # Of frame 4 nothing is known, and of a camera at rest nothing can be: time has to do.
    assert correction.pose(4, np.eye(4))[0, 3] == pytest.approx(1.6)
    resting = replace(correction, tracked={0: _tracked(0, 3), 5: _tracked(0, 3), 10: _tracked(0, 3)})
    assert resting.pose(5, np.eye(4))[0, 3] == pytest.approx(2.0)


def test_a_camera_found_again_is_corrected_as_from_there_on() -> None:
    T = np.stack([se3_exp(np.array([0, 0, 0, 1.0 * k, 0, 0])) for k in range(4)])
    # Up to frame 23 all goes on from keyframe 20; then keyframe 10 finds the camera again, and 30 comes of that.
    tracked = {0: _tracked(0, 0), 10: _tracked(0, 1), 20: _tracked(10, 2), 30: _tracked(10, 3)}
    tracked |= {22: _tracked(20, 2.2), 26: _tracked(10, 2.6), 33: _tracked(30, 3.3), 35: _tracked(20, 3.5)}
    correction = Correction(np.array([0, 10, 20, 30]), T, np.zeros(4), tracked=tracked, depth_mm=50.0)
    for index, of in ((20, 2), (22, 2), (26, 3), (30, 3), (33, 3), (35, 2)):
        np.testing.assert_allclose(correction.pose(index, np.eye(4)), T[of], atol=1e-12)


def test_keyframes_hang_on_those_that_they_were_aligned_to() -> None:
    T = np.eye(4)
    tracked = [(0, 0, 0), (10, 0, 0), (15, 1, 15), (20, 1, 15), (30, 0, 0), (40, 0, 17), (50, 1, 20)]
    keyframes = [_Keyframe(frame, TrackedPose(number, of, T)) for frame, number, of in tracked]
    # What keyframe 40 was aligned to is none: the one before it in its map has to do.
    expected = [[0, 1], [2, 3], [0, 4], [4, 5], [3, 6]]
    np.testing.assert_array_equal(_neighbours(keyframes), expected)
    assert _neighbours(keyframes[:1]).shape == (0, 2)


def test_loops_are_told_in_the_millimetres_of_the_joined_world() -> None:
    T = se3_exp(np.array([0.1, 0, 0, 2.0, 3.0, 4.0]))
    loops = [Loop(3, 7, T, 0.1, *(np.zeros((0, 2)),) * 4), Loop(3, 5, T, 0.1, *(np.zeros((0, 2)),) * 4)]
    (loop,) = _of(loops, [3, 6, 7], np.log([2.0, 1.0, 3.0]))
    assert (loop.past, loop.new) == (0, 2)
    np.testing.assert_allclose(loop.T_new_past[:3, 3], [2 * x for x in T[:3, 3]])
    np.testing.assert_allclose(loop.T_new_past[:3, :3], T[:3, :3])
    assert loop.log_ratio == pytest.approx(0.1 + np.log(1.5))
    np.testing.assert_array_equal(loops[0].T_new_past, T)


def test_the_way_and_the_depth_of_a_joined_map_are_taken_in_the_common_world() -> None:
    grid = DepthGrid(np.broadcast_to(np.linspace(-0.2, 0.2, 4), (6, 7, 4)).copy(), np.log(20.0), np.log(80.0))
    merged = {0: Similarity.identity(), 1: Similarity(2.0, np.eye(3), np.array([5.0, 0, 0]))}
    T, depth_mm = np.stack([np.eye(4), se3_exp(np.array([0, 0, 0, 4.0, 0, 0]))]), np.full((10, 12), 20.0, np.float32)
    # Keyframe 10 of map 0 is at 5 mm; those of map 1, whose world begins there, at twice their millimetres from it.
    tracked = {
        10: TrackedPose(1, 10, np.eye(4)),
        14: _tracked(10, 1.0)._replace(map=1),
        20: _tracked(10, 4.0)._replace(map=1),
    }
    correction = Correction(
        np.array([10, 20]),
        T,
        np.zeros(2),
        grids=(grid, grid),
        S_common_map=merged,
        tracked=tracked,
    )
    assert correction.pose(14, tracked[14].T_world_camera)[0, 3] == pytest.approx(5 + 2 + 1)
    expected = 2 * np.exp(grid.log_factor(2 * depth_mm))
    np.testing.assert_allclose(correction.depth_factors(14, depth_mm), expected, rtol=1e-5)
    assert not np.allclose(expected, 2 * np.exp(grid.log_factor(depth_mm)))


@pytest.mark.parametrize(("sure", "refused"), [(3, False), (30, True)])
def test_few_points_that_ask_for_another_depth_are_what_moves_by_itself(sure: int, refused: bool) -> None:
    count, known = 100, np.arange(100) < sure
    points = Points(np.zeros(count, int), np.ones((count, 2)), np.zeros(count), np.full(count, 0.1))
    sigma = np.where(known, 0.01, np.inf)
    state = State(np.eye(4)[None], np.zeros(1), np.where(known, 1.0, 0.0), np.zeros(2), 0.2)
    found = Solution(state, sigma, 1)
    assert bool(Backend(MappingSettings(), DisFlow())._doubt(points, found)) == refused


def test_a_loss_divides_what_lies_before_it_from_what_lies_after_it() -> None:
    T = np.stack([se3_exp(np.array([0, 0, 0, 1.0 * k, 0, 0])) for k in range(2)])
    # Keyframe 0 finds the camera again after frames 4 and 5 were lost; keyframe 10 comes of that.
    tracked = {
        0: _tracked(0, 0),
        2: _tracked(0, 0.2),
        7: _tracked(0, 0.7, 2),
        10: _tracked(0, 1, 2),
        12: _tracked(10, 1.2, 2),
    }
    correction = Correction(np.array([0, 10]), T, np.zeros(2), tracked=tracked, depth_mm=50.0)
    for index, of in ((2, 0), (7, 1), (12, 1)):
        np.testing.assert_allclose(correction.pose(index, np.eye(4)), T[of], atol=1e-12)


def test_tissue_that_moves_by_itself_leaves_poses_as_tracked() -> None:
    rng = np.random.default_rng(1)
    backend = Backend(MappingSettings(), DisFlow())
    x, y = np.meshgrid(np.arange(240, dtype=np.float32), np.arange(180, dtype=np.float32))
    for number in range(5):
        frame = _frame(number)
        # A slow swell that differs from keyframe to keyframe, by some 3 px.
        swell = cv2.resize(rng.normal(0, 3, (4, 5, 2)).astype(np.float32), (240, 180), interpolation=cv2.INTER_CUBIC)
        moved = cv2.remap(frame.rgb, x + swell[..., 0], y + swell[..., 1], cv2.INTER_LINEAR)
        backend.add(replace(frame, rgb=moved))
    correction = backend.adjust()
    assert correction.refused
    assert correction.sigma_px > 0.8
    assert correction.depth_factor(20) == 1.0
    np.testing.assert_array_equal(correction.pose(20, POSES[2]), POSES[2])
    assert "moves by itself" in correction.description


def test_depth_that_would_have_to_change_too_much_leaves_all_as_tracked() -> None:
    factors = np.exp(0.5 * np.sin(np.linspace(-2, 2, CAMERA.width))).astype(np.float32)
    for most, refused in ((0.2, True), (0.6, False)):
        backend = Backend(MappingSettings(max_depth_change=most, depth_share=0.5), DisFlow())
        for number in range(5):
            frame = _frame(number)
            assert frame.depth_mm is not None
            backend.add(replace(frame, depth_mm=frame.depth_mm * factors))
        correction = backend.adjust()
        assert bool(correction.refused) == refused
        assert ("depth would have to change by" in correction.description) == refused


def test_nothing_to_adjust_is_an_error_of_the_caller() -> None:
    with pytest.raises(ValueError, match="no keyframe"):
        Backend(MappingSettings(), DisFlow()).adjust()
