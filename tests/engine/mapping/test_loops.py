"""Loop closure of a camera that returns, on a textured plane, and pose graphs with known drift."""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate, pairwise

import cv2
import numpy as np
import pytest

from scopemap.engine.config import MappingSettings
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3_exp
from scopemap.engine.mapping.loop_closure import Loop, LoopFinder, is_verified, small_view
from scopemap.engine.mapping.pose_graph import optimise_pose_graph
from tests.support import plane_scene

# Out to the side and back again.
OUT = [plane_scene.pose(at_mm=(4.0 * n, 0.7 * n, 0.0), turn_rad=(0.0, 0.0, 0.02 * n)) for n in range(9)]
POSES = [*OUT, *OUT[-2::-1]]
COUNT = len(POSES)
LINE = np.column_stack([np.arange(COUNT - 1), np.arange(1, COUNT)])


def _frame(number: int, T_tracked: np.ndarray | None = None, factor: float = 1.0) -> Frame:
    return plane_scene.frame(POSES[number], 10 * number, T_tracked, factor)


def _sideways(number: int, x_mm: float) -> Frame:
    return plane_scene.frame(plane_scene.pose(at_mm=(x_mm, 0.0, 0.0)), number)


def _drifting() -> list[np.ndarray]:
    """Poses with the same error in every step, some 0.6 degrees and 1 mm."""
    step, poses = se3_exp(np.array([0.004, -0.004, 0.008, 0.6, 0.6, -0.5])), [POSES[0]]
    for before, here in pairwise(POSES):
        poses.append(poses[-1] @ inverse(before) @ here @ step)
    return poses


def _off(pose: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    off = inverse(pose) @ true
    return float(rotation_angle_rad(off[:3, :3])), float(np.linalg.norm(off[:3, 3]))


@pytest.mark.slow
def test_a_revisited_place_is_found_with_its_relative_pose() -> None:
    finder = LoopFinder(MappingSettings(), recent=2)
    loops = [loop for number in range(COUNT) for loop in finder.add(_frame(number, factor=1.0 + 0.02 * number))]
    assert any(loop.past + loop.new == COUNT - 1 for loop in loops)
    for loop in loops:
        assert loop.new - loop.past > 2
        T = inverse(POSES[loop.new]) @ POSES[loop.past]
        scale_past, scale_new = 1 + 0.02 * loop.past, 1 + 0.02 * loop.new
        rotation_rad, _ = _off(loop.T_new_past, T)
        assert rotation_rad < np.radians(1.0)
        np.testing.assert_allclose(loop.T_new_past[:3, 3], scale_past * T[:3, 3], atol=1.0)
        assert loop.log_ratio == pytest.approx(np.log(scale_new / scale_past), abs=0.03)


@pytest.mark.parametrize("candidates", [0, 3])
def test_all_keyframes_of_two_maps_are_compared_at_the_end(candidates: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.engine.mapping.loop_closure._CANDIDATES", candidates)
    finder, map_of = LoopFinder(MappingSettings(), recent=2), [0] * len(OUT) + [1] * (COUNT - len(OUT))
    first = [loop for number in range(COUNT) for loop in finder.add(_frame(number), map_of[number])]
    assert bool(first) == bool(candidates)
    loops = finder.between(map_of)
    found = [(loop.past, loop.new) for loop in [*first, *loops]]
    assert len(set(found)) == len(found)
    assert all(map_of[past] != map_of[new] for past, new in found[len(first) :])
    # Places that both maps show: the camera came back through all but the last.
    assert len({past for past, _ in found}) >= 5
    for loop in loops:
        rotation_rad, off_mm = _off(loop.T_new_past, inverse(POSES[loop.new]) @ POSES[loop.past])
        assert rotation_rad < np.radians(1.0)
        assert off_mm < 1.0


@pytest.mark.slow
def test_memory_of_places_is_bounded_and_a_return_is_still_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.engine.mapping.loop_closure.MOST_SEARCHED", 6)
    finder, kept, loops = LoopFinder(MappingSettings(), recent=1), [], []
    for number, x_mm in enumerate([*np.linspace(-60.0, 60.0, 17), -60.0]):
        loops = finder.add(_sideways(number, x_mm))
        kept.append(len(finder._features))
    assert max(kept) == 6
    assert [(loop.past, loop.new) for loop in loops if loop.past == 0] == [(0, 17)]


@pytest.mark.slow
@pytest.mark.parametrize(("map_number", "height_px"), [(0, 40), (1, 80)])
def test_dirt_on_the_lens_closes_no_loop(map_number: int, height_px: int, monkeypatch: pytest.MonkeyPatch) -> None:
    dirt = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(height_px, 80, 3)), (0, 0), 0.9)

    def loops() -> list[Loop]:
        finder, found = LoopFinder(MappingSettings(), recent=2), []
        for number in range(10):
            frame = _sideways(number, -60.0 + 2 * number if number < 5 else 45.0 + 2 * number)
            frame.rgb[60 : 60 + height_px, 80:160] = np.clip(100 + 30 * dirt / dirt.std(), 0, 255).astype(np.uint8)
            found += finder.add(frame, map_number * int(number >= 5))
        return [loop for loop in found if loop.past < 5 <= loop.new]

    assert not loops()
    monkeypatch.setattr("scopemap.engine.mapping.loop_closure.is_verified", lambda *_: True)
    monkeypatch.setattr("scopemap.engine.mapping.loop_closure._STATIC_PX", -1.0)
    assert loops()  # by its features alone


def test_a_loop_is_verified_under_another_exposure_and_refused_at_another_place() -> None:
    past, dark, beside = _sideways(0, 0.0), _sideways(1, 8.0), _sideways(2, 78.0)
    dark = replace(dark, rgb=dark.rgb // 3)
    past_view, dark_view, beside_view = (small_view(frame)[0] for frame in (past, dark, beside))
    T_dark_past, T_beside_past = (inverse(plane_scene.pose(at_mm=(x_mm, 0.0, 0.0))) for x_mm in (8.0, 78.0))
    assert is_verified(past_view, dark_view, T_dark_past, plane_scene.CAMERA)
    assert not is_verified(past_view, beside_view, T_dark_past, plane_scene.CAMERA)
    assert not is_verified(past_view, beside_view, T_beside_past, plane_scene.CAMERA)  # They share too few pixels.


def test_the_pose_graph_removes_drift_of_poses_and_scale() -> None:
    # The depth of keyframe k is too large by exp(0.02 k), and so is every translation tracked from it.
    scale = np.exp(0.02 * np.arange(COUNT))
    tracked = [POSES[0]]
    for k in range(COUNT - 1):
        step = inverse(POSES[k]) @ POSES[k + 1]
        step[:3, 3] *= scale[k]
        tracked.append(tracked[-1] @ step)
    loops = []
    for past in range(3):
        new = COUNT - 1 - past
        T = inverse(POSES[new]) @ POSES[past]
        T[:3, 3] *= scale[past]
        loops.append(replace(_loop(past, new, T), log_ratio=float(np.log(scale[new] / scale[past]))))
    graph = optimise_pose_graph(np.stack(tracked), LINE, loops, depth_mm=50.0)
    before, after = (_off(poses[-1], POSES[-1])[1] for poses in (tracked, graph.T_world_camera))
    assert before > 5
    assert after < 0.05 * before
    assert graph.log_scale[0] == 0
    np.testing.assert_allclose(graph.log_scale[-1], -np.log(scale[-1]), atol=0.05)
    np.testing.assert_array_equal(graph.T_world_camera[0], tracked[0])


def test_drift_of_a_long_way_there_and_back_is_removed_beside_false_loops() -> None:
    rng, turns = np.random.default_rng(0), np.arange(60)
    steps = np.zeros((60, 6))
    steps[:, 0], steps[:, 1], steps[:, 5] = 0.02 * np.sin(turns / 9), 0.03 * np.cos(turns / 13), 1.5
    out = list(accumulate(map(se3_exp, steps), np.matmul, initial=np.eye(4)))
    true, errors = np.stack([*out, *out[-2::-1]]), rng.normal(0, np.repeat([0.003, 0.03], 3), (120, 6))
    moves = inverse(true[:-1]) @ true[1:] @ np.stack([se3_exp(error) for error in errors])
    log_scale = np.append(0.0, np.cumsum(rng.normal(0.002, 0.012, 120)))
    moves[:, :3, 3] *= np.exp(log_scale[:-1, None])
    tracked = np.stack(list(accumulate(moves, np.matmul, initial=np.eye(4))))
    line = np.column_stack([np.arange(120), np.arange(1, 121)])
    ends = [(k, 120 - k) for k in range(0, 50, 5)]
    loops = [replace(_loop(k, n, np.eye(4)), log_ratio=log_scale[n] - log_scale[k]) for k, n in ends]
    false = [_loop(k, 90 - k, se3_exp(rng.normal(0, np.repeat([0.3, 8.0], 3)))) for k in (10, 20)]
    graph = optimise_pose_graph(tracked, line, [*loops, *false], depth_mm=20.0)
    before, after = (np.linalg.norm((T - true)[60:, :3, 3], axis=1).mean() for T in (tracked, graph.T_world_camera))
    assert len(graph.accepted) == len(loops)
    assert after < 0.4 * before


def _loop(past: int, new: int, T_new_past: np.ndarray) -> Loop:
    return Loop(past, new, T_new_past, 0.0, *(np.zeros((0, 2)),) * 4)


def test_one_false_loop_is_an_outlier() -> None:
    poses = np.stack(POSES)
    true = [_loop(k, COUNT - 1 - k, inverse(POSES[COUNT - 1 - k]) @ POSES[k]) for k in range(4)]
    false = se3_exp(np.array([0.0, 0.3, 0.0, 20.0, 0.0, 0.0])) @ true[0].T_new_past
    graph = optimise_pose_graph(poses, LINE, [*true, _loop(0, COUNT - 1, false)], depth_mm=50.0)
    assert len(graph.accepted) == 4
    assert max(_off(a, b)[1] for a, b in zip(graph.T_world_camera, poses, strict=True)) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("closing", [True, False])
def test_the_back_end_closes_loops_if_enabled(closing: bool) -> None:
    tracked = _drifting()
    settings = MappingSettings() if closing else MappingSettings(min_loop_inliers=0)
    correction = plane_scene.adjusted((_frame(number, T) for number, T in enumerate(tracked)), settings)
    _, before = _off(tracked[-1], POSES[-1])
    _, after = _off(correction.pose(10 * (COUNT - 1), tracked[-1]), POSES[-1])
    assert before > 10
    assert bool(correction.loop_frames) == closing
    assert (correction.notice.values["loops"] > 0) == closing
    if closing:
        assert after < 0.3


def test_a_camera_at_rest_closes_few_loops_to_each_keyframe() -> None:
    finder = LoopFinder(MappingSettings(), recent=1)
    loops = [loop for number in range(14) for loop in finder.add(replace(_frame(0), index=10 * number))]
    assert len(loops) > 10
    counts = np.bincount([loop.past for loop in loops])
    assert counts.max() <= 3
    assert max(len(loop.pixels_past) for loop in loops) <= 60


def test_a_loop_that_drift_cannot_explain_is_not_accepted() -> None:
    poses = np.stack(OUT)
    graph = optimise_pose_graph(poses, LINE[: len(OUT) - 1], [_loop(0, len(OUT) - 1, np.eye(4))], depth_mm=10.0)
    assert len(graph.accepted) == 0
    np.testing.assert_allclose(graph.T_world_camera, poses, atol=1e-9)
