"""Local bundle adjustment: bent depth and wrong steps are corrected as keyframes come; moving tissue is left."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, se3_exp
from scopemap.engine.mapping.feature_tracks import FeatureTracks
from scopemap.engine.mapping.local_adjustment import LocalAdjustment
from tests.support import plane_scene

pytestmark = pytest.mark.slow

LOCAL = MappingSettings(method="local")
COUNT, SLIDING = 9, 2.5
BEND = np.linspace(-0.15, 0.15, plane_scene.CAMERA.width, dtype=np.float32)  # of ln depth, over the columns
TRUE = [plane_scene.pose(at_mm=(SLIDING * n, 0.3 * n, 0.6 * n), turn_rad=(0.1, 0.03 * n, 0)) for n in range(COUNT)]


def _keyframes(adjustment: LocalAdjustment | None, split: bool = False) -> list[Frame]:
    """Keyframes with bent depth, each tracked with an error from the one before as it was adjusted, adjusted.

    adjustment : None: they stay as tracked. split : the right half of the pictures moves up and down.
    """
    rng, found = np.random.default_rng(3), list[Frame]()
    for n, pose in enumerate(TRUE):
        error = se3_exp(rng.normal(0, [0.01] * 3 + [0.6] * 3)) if n else np.eye(4)
        T = found[-1].T_world_camera @ inverse(TRUE[n - 1]) @ pose @ error if n else pose
        frame, half = plane_scene.frame(pose, n, T), plane_scene.CAMERA.width // 2
        if split:
            moved = plane_scene.see(pose @ se3_exp(np.array([0, 0, 0, 0, 0.8 * (-1) ** n, 0])))
            frame.rgb[:, half:] = moved.rgb[:, half:]
        frame = replace(frame, depth_mm=frame.depth_mm * np.exp(BEND))
        found.append(frame if adjustment is None else adjustment.adjusted(frame, max(n - 1, 0), 0).keyframe)
    return found


def _bend_left(frame: Frame) -> float:
    """Standard deviation of ln of depth over the true one."""
    true_mm = plane_scene.see(TRUE[frame.index]).depth_mm
    return float(np.nanstd(np.log(frame.depth_mm / true_mm)))


def _step_errors_mm(frames: list[Frame]) -> np.ndarray:
    """Length of the error of each step after the scale of all, mm."""
    steps = [np.stack([(inverse(a) @ b)[:3, 3] for a, b in pairwise(T)]) for T in (_poses(frames), TRUE)]
    scale = (steps[0] * steps[1]).sum() / (steps[0] ** 2).sum()
    return np.linalg.norm(scale * steps[0] - steps[1], axis=1)


def _poses(frames: list[Frame]) -> list[np.ndarray]:
    return [np.asarray(frame.T_world_camera) for frame in frames]


def test_bent_depth_and_wrong_steps_are_corrected_as_keyframes_come() -> None:
    local = LocalAdjustment(LOCAL, DisFlow())
    adjusted, tracked = _keyframes(local), _keyframes(None)
    assert _bend_left(tracked[-1]) > 0.08
    assert max(map(_bend_left, adjusted[1:])) < 0.02
    assert _step_errors_mm(adjusted).max() < 0.1 < 0.2 * _step_errors_mm(tracked).mean()
    notice, shape = local.notices(0)
    assert shape.code == "shape-determined"
    assert (notice.code, notice.values) == ("mapping-local", {"adjusted": COUNT - 1, "refused": 0})
    assert not local.notices(1)
    # A frame between takes over the correction of what it was tracked against.
    between = replace(
        plane_scene.frame(TRUE[-1], 99), depth_mm=tracked[-1].depth_mm, depth_sigma_mm=tracked[-1].depth_mm
    )
    followed = local.corrected(between, COUNT - 1)
    np.testing.assert_allclose(followed.depth_mm, adjusted[-1].depth_mm, rtol=1e-5)
    np.testing.assert_allclose(followed.depth_sigma_mm, adjusted[-1].depth_mm, rtol=1e-5)
    local.take_over(99, COUNT - 1)
    np.testing.assert_array_equal(local.corrected(between, 99).depth_mm, followed.depth_mm)


def test_where_half_of_the_picture_moves_keyframes_stay_as_tracked() -> None:
    local = LocalAdjustment(LOCAL, DisFlow())
    adjusted = _keyframes(local, split=True)
    (notice,) = local.notices(0)
    assert notice.code == "mapping-local-not-rigid"
    assert notice.level == "doubtful"
    assert json.loads(json.dumps(dict(notice.values))) == {"adjusted": 0, "refused": COUNT - 1}
    for frame, pose in zip(adjusted, _poses(_keyframes(None)), strict=True):
        np.testing.assert_allclose(frame.T_world_camera, pose, atol=1e-9)


def test_a_keyframe_says_by_how_much_it_was_moved() -> None:
    local = LocalAdjustment(LOCAL, DisFlow())
    adjusted = _keyframes(local)
    pose = TRUE[-1] @ se3_exp(np.array([0, 0, 0, 0.5, 0, 0]))
    T_tracked = adjusted[-1].T_world_camera @ inverse(TRUE[-2]) @ pose
    depth_mm = 1.1 * adjusted[-1].depth_mm
    keyframe = replace(plane_scene.frame(pose, COUNT, T_tracked), depth_mm=depth_mm)
    moved, _, step = local.adjusted(keyframe, COUNT - 1, 0)
    assert np.linalg.norm(step.T_camera_arrived[:3, 3]) > 0.01
    np.testing.assert_allclose(moved.T_world_camera @ step.T_camera_arrived, T_tracked, atol=1e-9)
    led_mm = local.corrected(keyframe, COUNT - 1).depth_mm  # as that of a frame just before it
    factor = np.log(moved.depth_mm / led_mm)
    assert np.median(factor) == pytest.approx(step.log_scale, abs=0.03)


@pytest.mark.parametrize("reference", [COUNT + 5, COUNT])
def test_a_keyframe_that_was_not_tracked_against_the_window_is_not_adjusted_with_it(reference: int) -> None:
    local = LocalAdjustment(LOCAL, DisFlow())
    _keyframes(local)
    frame = plane_scene.frame(TRUE[-1], COUNT)
    begun = local.adjusted(frame, reference, 1).keyframe
    np.testing.assert_allclose(begun.T_world_camera, frame.T_world_camera, atol=1e-12)
    np.testing.assert_array_equal(begun.depth_mm, frame.depth_mm)
    assert not local.notices(1)


def test_a_keyframe_that_sees_nothing_of_those_before_takes_over_the_correction() -> None:
    local = LocalAdjustment(LOCAL, DisFlow())
    last = _keyframes(local)[-1]
    elsewhere = plane_scene.frame(plane_scene.pose(at_mm=(60, -50, 0)), COUNT)
    elsewhere = replace(elsewhere, depth_mm=plane_scene.frame(TRUE[-1]).depth_mm * np.exp(BEND))
    again = local.adjusted(elsewhere, COUNT - 1, 0).keyframe
    np.testing.assert_allclose(again.depth_mm, last.depth_mm, rtol=1e-5)
    local.adjusted(plane_scene.frame(TRUE[0], COUNT + 1), COUNT, 0)  # after it, nothing is observed at all
    assert local.notices(0)[0].values == {"adjusted": COUNT - 1, "refused": 0}


def test_tracks_that_forget_know_of_the_last_keyframes_what_all_know() -> None:
    everything, some = FeatureTracks(DisFlow()), FeatureTracks(DisFlow())
    for n, pose in enumerate(TRUE):
        for tracks in (everything, some):
            tracks.add(plane_scene.frame(pose, n))
        some.keep_last(3)
        last = range(max(n - 2, 0), n + 1)
        for a, b in zip(everything.collected(last), some.collected(last), strict=True):
            for name, values in vars(a).items():
                np.testing.assert_array_equal(values, getattr(b, name))
    assert len(some.collected()[0].host) < 0.5 * len(everything.collected()[0].host)
