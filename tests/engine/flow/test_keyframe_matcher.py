"""Corners of a keyframe in later frames, on a textured plane with exact truth, and what the tracker makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.config import TrackingSettings
from scopemap.engine.flow.corners import KeyframeMatcher
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.flow.estimator import FlowEstimator, FlowPair, NoFlow
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.tracking.track import KeyframeDecision, Track
from scopemap.engine.tracking.tracker import Tracker
from tests.support import plane_scene
from tests.support.plane_scene import CAMERA

HERE = plane_scene.pose()
THERE = plane_scene.pose(at_mm=(2.0, 0.6, 0.5), turn_rad=(0.01, -0.01, 0.02))


def test_corners_are_matched_where_the_plane_projects() -> None:
    matcher = KeyframeMatcher(DisFlow())
    assert matcher.match(plane_scene.frame(THERE, 1)) is None
    matcher.set_keyframe(plane_scene.frame(HERE, 4))
    found = matcher.match(plane_scene.frame(THERE, 5))
    assert found is not None
    assert found.reference == 4
    assert 0.8 < found.coverage <= 1
    T = inverse(THERE) @ HERE
    errors = CAMERA.project(found.points_mm @ T[:3, :3].T + T[:3, 3]) - found.pixels
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.25
    matcher.set_keyframe(None)
    assert matcher.match(plane_scene.frame(THERE, 5)) is None


def test_corners_of_masked_or_unknown_tissue_are_not_matched() -> None:
    matcher, frame = KeyframeMatcher(DisFlow()), plane_scene.frame(HERE, 0)
    half = plane_scene.EVERYWHERE.copy()
    half[:, 120:] = False
    matcher.set_keyframe(frame)
    found = matcher.match(replace(plane_scene.frame(HERE, 1), valid=half))
    assert found is not None
    assert found.pixels[:, 0].max() < 120.5
    matcher.set_keyframe(replace(frame, depth_mm=np.full_like(frame.depth_mm, np.nan)))
    assert matcher.match(plane_scene.frame(THERE, 1)) is None


class _InHalf(DisFlow):
    """DIS flow that is searched in images of half the size."""

    enough_px = 120

    def __init__(self) -> None:
        super().__init__()
        self.widths: list[int] = []

    def estimate_checked(self, rgb_from: np.ndarray, rgb_to: np.ndarray, start: FlowPair | None = None) -> FlowPair:
        self.widths.append(rgb_from.shape[1])
        return super().estimate_checked(rgb_from, rgb_to, start)


def test_flow_between_small_images_is_enough_for_as_exact_corners() -> None:
    T, errors_px = inverse(THERE) @ HERE, []
    for flow in (DisFlow(), _InHalf()):
        matcher = KeyframeMatcher(flow)
        matcher.set_keyframe(plane_scene.frame(HERE, 0))
        for index in (1, 2):
            found = matcher.match(plane_scene.frame(THERE, index))
        assert found is not None
        assert found.coverage > 0.8
        errors = CAMERA.project(found.points_mm @ T[:3, :3].T + T[:3, 3]) - found.pixels
        errors_px.append(np.median(np.linalg.norm(errors, axis=1)))
    assert flow.widths == [120, 120]
    assert errors_px[1] <= errors_px[0]


class _Shifted(DisFlow):
    """DIS flow with a bias along x, px, that both directions share, so that they stay consistent."""

    def __init__(self, bias_px: float) -> None:
        super().__init__()
        self._bias_px = np.float32([bias_px, 0])

    def estimate_checked(self, rgb_from: np.ndarray, rgb_to: np.ndarray, start: FlowPair | None = None) -> FlowPair:
        forth, back = super().estimate_checked(rgb_from, rgb_to, start)
        return forth + self._bias_px, back - self._bias_px


def _tracked(flow: FlowEstimator | None, *, measured: bool = False, **changes: object) -> Track:
    tracker = Tracker(TrackingSettings(finest_level=0, **changes), flow)
    tracker.track(plane_scene.frame(HERE, 0))
    assert tracker.update(plane_scene.frame(HERE, 0), KeyframeDecision("new"), measured=measured)
    return tracker.track(plane_scene.frame(THERE, 1))


def test_the_pose_is_the_corners_and_no_alignment_is_needed() -> None:
    track = _tracked(DisFlow())
    assert (track.status, track.iterations) == ("ok", 0)
    assert np.linalg.norm((inverse(THERE) @ track.T_world_camera)[:3, 3]) < 0.1
    assert track.correlation > 0.8
    # Half a pixel at 50 mm.
    moved_mm = _tracked(_Shifted(0.5)).T_world_camera[0, 3] - track.T_world_camera[0, 3]
    assert moved_mm == pytest.approx(-0.5 * plane_scene.PLANE_MM / CAMERA.fx, abs=0.1)


@pytest.mark.parametrize(
    ("flow", "measured", "changes"),
    [(None, False, {}), (NoFlow(), False, {}), (DisFlow(), True, {}), (DisFlow(), False, {"corner_depth_sigma": 0.0})],
)
def test_without_corners_the_image_is_aligned(flow: FlowEstimator, measured: bool, changes: dict[str, object]) -> None:
    track = _tracked(flow, measured=measured, **changes)
    assert track.status == "ok"
    assert track.iterations > 0
    assert np.linalg.norm((inverse(THERE) @ track.T_world_camera)[:3, 3]) < 0.3


def test_corners_that_the_image_contradicts_are_rejected() -> None:
    wrong = _tracked(_Shifted(30.0))
    assert (wrong.status, wrong.iterations > 0) == ("ok", True)
    assert np.linalg.norm((inverse(THERE) @ wrong.T_world_camera)[:3, 3]) < 0.3


def test_a_frame_in_which_few_corners_are_matched_becomes_a_keyframe() -> None:
    """Without a window of the image most corners have no match, although the frame is tracked."""
    narrow = plane_scene.EVERYWHERE.copy()
    narrow[:, 64:] = False
    for valid, wanted in ((plane_scene.EVERYWHERE, False), (narrow, True)):
        tracker = Tracker(TrackingSettings(finest_level=0, min_keyframe_agreement=0.0), DisFlow())
        first = tracker.track(plane_scene.frame(HERE, 0))
        tracker.update(plane_scene.frame(HERE, 0), first.decision, measured=False)
        track = tracker.track(replace(plane_scene.frame(THERE, 1), valid=valid))
        assert track.status == "ok"
        assert track.decision.kind == ("new" if wanted else "none")


def _to_and_fro(tracker: Tracker) -> list[Track]:
    """Track a camera that goes 16 mm and comes back; each keyframe's depth is wrong by 3 % more than the last one's."""
    tracks: list[Track] = []
    keyframes = 0
    for index, way in enumerate([*range(9), *range(7, -1, -1)]):
        frame = plane_scene.frame(plane_scene.pose(at_mm=(2.0 * way, 0.3 * way, 0.0)), index)
        track = tracker.track(replace(frame, T_world_camera=None))
        assert track.status != "lost", track.reason
        if track.decision.kind != "none":
            wrong_mm = frame.depth_mm * np.float32(1.03**keyframes)
            keyframe = replace(frame, depth_mm=wrong_mm, T_world_camera=track.T_world_camera)
            assert tracker.update(keyframe, track.decision, measured=False)
            keyframes += 1
        tracks.append(track)
    return tracks


def test_a_camera_that_comes_back_is_tracked_against_the_keyframes_it_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = TrackingSettings(keyframe_every=2)
    again = _to_and_fro(Tracker(settings, DisFlow()))
    assert again[-1].keyframe == 0
    revisited = [track for track in again if track.decision.kind == "revisited"]
    assert revisited
    assert all(track.keyframe < track.index - 1 for track in revisited)
    assert len({track.keyframe for track in again}) <= 6
    assert np.linalg.norm(again[-1].T_world_camera[:3, 3]) < 0.1
    monkeypatch.setattr("scopemap.engine.tracking.tracker.nearer_keyframe", lambda *_: None)
    onwards = _to_and_fro(Tracker(settings, DisFlow()))
    assert np.linalg.norm(onwards[-1].T_world_camera[:3, 3]) > 0.5
    assert onwards[-1].keyframe > 10
