"""Drift of depth's scale along new places is removed from the path, by the scale of the network itself."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.engine.mapping import TrackedPose, hypotheses
from scopemap.engine.mapping.feature_tracks import FeatureTracks
from scopemap.engine.mapping.judge import LensTest
from scopemap.engine.mapping.keyframes import path_without_drift
from scopemap.engine.mapping.mapper import Backend
from tests.support import plane_scene

pytestmark = pytest.mark.slow


def _tracked(log_scale: np.ndarray, map_number: int = 0) -> list[TrackedPose]:
    """A straight path of steps of 1 mm, times the scale of each."""
    x = np.concatenate([[0.0], np.cumsum(np.exp((log_scale[1:] + log_scale[:-1]) / 2))])
    R = so3_exp(np.array([0.1, 0, 0]))
    return [TrackedPose(map_number, k, se3(R, np.array([x_mm, 0, 0]))) for k, x_mm in enumerate(x)]


@given(st.floats(-0.03, 0.03), st.integers(0, 1000))
def test_drift_is_removed_and_noise_of_the_network_is_not_followed(per_keyframe: float, seed: int) -> None:
    count, rng = 120, np.random.default_rng(seed)
    chained = per_keyframe * np.arange(count)
    tracked = _tracked(chained)
    drift, T = path_without_drift(tracked, chained + rng.normal(0, 0.1, count))
    np.testing.assert_allclose(drift, chained, atol=0.15 + 0.2 * abs(chained[-1]))
    steps = np.diff(T[:, 0, 3])
    np.testing.assert_allclose(np.log(steps), (chained - drift)[1:], atol=0.05)
    np.testing.assert_array_equal(T[:, :3, :3], [pose.T_world_camera[:3, :3] for pose in tracked])


def test_each_map_keeps_its_first_keyframe_and_has_a_drift_of_its_own() -> None:
    drifting, steady = 0.02 * np.arange(60), np.full(60, 0.7)
    mixed = [pose for pair in zip(_tracked(drifting), _tracked(steady, 1), strict=True) for pose in pair]
    drift, T = path_without_drift(mixed, np.column_stack([drifting, steady]).ravel())
    np.testing.assert_allclose(T[0], mixed[0].T_world_camera)
    np.testing.assert_allclose(T[1::2], [pose.T_world_camera for pose in mixed[1::2]])
    np.testing.assert_allclose(drift[1::2], 0, atol=1e-9)
    assert drift[-2] > 0.5 * drifting[-1]


@pytest.mark.parametrize("anchored", [False, True])
@pytest.mark.parametrize("refused", [False, True])
def test_every_map_gets_the_millimetres_of_the_network(anchored: bool, refused: bool) -> None:
    """Two maps apart: the chain of scales has come to 1.3 in the first, and begins with 6 in the second."""
    settings = MappingSettings(max_sigma_px=1e-3) if refused else MappingSettings()
    backend = Backend(settings, DisFlow(), anchored=anchored)
    chained, poses = (1.3, 6.0), []
    for n in range(12):
        number = n // 6
        true = plane_scene.pose(at_mm=(2.0 * (n % 6) + 40 * number, 0, 0), turn_rad=(0, 0, 0.01 * n))
        T = Similarity(chained[number], np.eye(3), np.zeros(3)).transform_poses(true)
        poses.append(TrackedPose(number, max(n - 1, 6 * number), T))
        keyframe = plane_scene.frame(true, n, T, chained[number])
        backend.add(replace(keyframe, depth_scale=chained[number]), poses[n])
    for number in (0, 1):
        correction = plane_scene.only(backend.adjust(number, among=()))
        assert bool(correction.refused) == refused
        correction = replace(correction, tracked=dict(enumerate(poses)))
        own, mm = range(6 * number, 6 * number + 6), 1.3 if anchored else 1.0
        np.testing.assert_allclose([correction.depth_factor(n) * chained[number] for n in own], mm, rtol=0.02)
        first, last = (correction.pose(n, poses[n].T_world_camera)[:3, 3] for n in (own[0], own[-1]))
        np.testing.assert_allclose(np.linalg.norm(last - first), 10 * mm, rtol=0.03)


def test_the_adjustment_does_not_bring_the_drift_back(monkeypatch: pytest.MonkeyPatch) -> None:
    true = [plane_scene.pose(at_mm=(0.5 * n, 0.1 * n, 0.0), turn_rad=(0.0, 0.0, 0.005 * n)) for n in range(40)]
    log_scale, spread = 0.03 * np.arange(40), []
    steps = np.diff([T[:3, 3] for T in true], axis=0) * np.exp((log_scale[1:] + log_scale[:-1]) / 2)[:, None]
    # A point of one keyframe is in the picture of the next one alone, as where the camera moves fast: with all of them
    # in every picture observations alone would remove the drift.
    monkeypatch.setattr("scopemap.engine.mapping.mapper.FeatureTracks", partial(FeatureTracks, gaps=(1,)))
    for known in (True, False):
        frames = []
        for n, T_true in enumerate(true):
            T, factor = T_true.copy(), float(np.exp(log_scale[n]))
            T[:3, 3] = true[0][:3, 3] + steps[:n].sum(0)
            frames.append(replace(plane_scene.frame(T_true, n, T, factor), depth_scale=factor if known else 1.0))
        correction = plane_scene.adjusted(frames)
        assert not correction.refused
        factor = np.log([correction.depth_factor(n) for n in range(40)]) + log_scale
        spread.append(np.ptp(factor))
    # The drift to be removed is 1.17.
    assert spread[0] < min(0.06, spread[1]), spread


def test_where_left_out_tracks_prefer_the_poses_as_tracked_these_have_the_scale_of_the_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They have the drift, so most of their keyframes, with it, must have the network's millimetres."""
    monkeypatch.setattr(hypotheses, "lens_test", lambda problem, solution: LensTest(held_px=1.0, tracked_px=0.5))
    log_scale, frames, x_mm = 0.1 * np.arange(8), [], 0.0
    for n, factor in enumerate(np.exp(log_scale)):
        true = plane_scene.pose(at_mm=(2.0 * n, 0, 0), turn_rad=(0, 0, 0.01 * n))
        T = plane_scene.pose(at_mm=(x_mm, 0, 0), turn_rad=(0, 0, 0.01 * n))
        frames.append(replace(plane_scene.frame(true, n, T, factor), depth_scale=factor))
        x_mm += 2.0 * factor
    correction = plane_scene.adjusted(frames)
    assert correction.refused is not None
    assert correction.refused.code == "mapping-worse"
    off = np.log([correction.depth_factor(n) for n in range(8)]) + log_scale
    np.testing.assert_allclose(np.median(off), 0, atol=1e-6)
