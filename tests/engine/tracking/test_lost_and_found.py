"""What the tracker does with frames that show too little, and how it finds itself again."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap.engine.config import TrackingSettings
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.tracking import keyframe_alignment, relocalisation
from scopemap.engine.tracking.track import Track
from scopemap.engine.tracking.tracker import Tracker
from tests.support import plane_scene
from tests.support.plane_scene import CAMERA

pytestmark = pytest.mark.slow


def _settings(**changes: Any) -> TrackingSettings:
    return TrackingSettings(keyframe_every=3, finest_level=0, **changes)


SETTINGS = _settings()
# Slowly on, then, unseen, far away and turned.
NEAR = [plane_scene.pose(at_mm=(1.0 * n, 0.3 * n, 0.0), turn_rad=(0.0, 0.0, 0.005 * n)) for n in range(8)]
FAR = [plane_scene.pose(at_mm=(27.0 + n, 8.0, 4.0), turn_rad=(0.05, -0.1, 0.3)) for n in range(3)]


def _smoked(frame: Frame) -> Frame:
    """A frame of which a tenth shines through."""
    return replace(frame, rgb=np.clip(0.1 * frame.rgb + 150, 0, 255).astype(np.uint8))


def _blurred(frame: Frame) -> Frame:
    return replace(frame, rgb=cv2.GaussianBlur(frame.rgb, (0, 0), 5.0))


def _tracked(frames: list[Frame], settings: TrackingSettings = SETTINGS, tracker: Tracker | None = None) -> list[Track]:
    """Tracks by measured depth, or by a tracker's corners."""
    by_corners, tracker, tracks = tracker is not None, tracker or Tracker(settings), []
    for frame in frames:
        track = tracker.track(frame)
        tracks.append(track)
        if track.decision.kind != "none":
            tracked = replace(frame, T_world_camera=track.T_world_camera)
            tracker.update(tracked, track.decision, measured=not by_corners)
    return tracks


def _off(track: Track, T_world_camera: np.ndarray) -> tuple[float, float]:
    off = inverse(track.T_world_camera) @ T_world_camera
    return float(rotation_angle_rad(off[:3, :3])), float(np.linalg.norm(off[:3, 3]))


@pytest.mark.parametrize("spoil", [_smoked, _blurred])
def test_unsharp_frames_are_lost_and_never_a_keyframe(spoil) -> None:  # type: ignore[no-untyped-def]
    frames = [plane_scene.frame(T, n) for n, T in enumerate(NEAR)]
    spoilt = [*frames[:4], spoil(frames[4]), spoil(frames[5]), *frames[6:]]
    tracks = _tracked(spoilt)
    assert [track.status for track in tracks] == ["initial"] + ["ok"] * 3 + ["lost"] * 2 + ["ok"] * 2
    assert "usual sharpness" in tracks[4].reason
    assert not {track.keyframe for track in tracks} & {4, 5}
    turn, way_mm = _off(tracks[-1], NEAR[-1])
    assert turn < np.radians(0.4)
    assert way_mm < 0.3


def test_what_is_too_unsharp_for_any_pose_is_not_searched_for(monkeypatch: pytest.MonkeyPatch) -> None:
    searched, find = [], relocalisation.Relocaliser.find

    def noted(self: relocalisation.Relocaliser, frame: Frame, *arguments: Any, **named: Any) -> Any:
        searched.append(frame.index)
        return find(self, frame, *arguments, **named)

    monkeypatch.setattr(relocalisation.Relocaliser, "find", noted)
    frames = [plane_scene.frame(T, n) for n, T in enumerate(NEAR)]
    nothing = replace(frames[5], rgb=cv2.GaussianBlur(frames[5].rgb, (0, 0), 30.0))
    tracks = _tracked([*frames[:5], nothing, *frames[6:]])
    assert tracks[5].status == "lost"
    assert tracks[5].sharpness < 0.3
    assert searched == [6]  # after the loss


@pytest.mark.parametrize("remembered", [10, 0])
def test_a_camera_that_went_far_unseen_is_found_by_its_landmarks(remembered: int) -> None:
    dark = replace(plane_scene.frame(NEAR[-1], 8), valid=np.zeros_like(plane_scene.EVERYWHERE))
    frames = [
        *(plane_scene.frame(T, n) for n, T in enumerate(NEAR)),
        dark,
        *(plane_scene.frame(T, 9 + n) for n, T in enumerate(FAR)),
    ]
    tracks = _tracked(frames, _settings(relocalisation_keyframes=remembered))
    assert tracks[8].status == "lost"
    turn, way_mm = _off(tracks[9], FAR[0])
    if remembered:
        assert tracks[9].status == "ok"
        assert tracks[9].reason == "relocalised"
        assert turn < np.radians(0.5)
        assert way_mm < 0.5
        assert [track.status for track in tracks[10:]] == ["ok", "ok"]
    else:
        # Alignment alone does not bridge that: either it says so, or it is far off.
        assert tracks[9].status == "lost" or way_mm > 2


def _elsewhere(index: int, n: int) -> Frame:
    """A frame of another place, far beyond what any of the others shows."""
    return plane_scene.frame(plane_scene.pose(at_mm=(-58.0 + n, -50.0, -10.0), turn_rad=(0.0, 0.0, 2.0)), index)


def test_a_new_map_begins_where_clear_frames_stay_lost_and_the_old_one_is_known_again() -> None:
    frames = [plane_scene.frame(T, n) for n, T in enumerate(NEAR)]
    there = [_elsewhere(8 + n, n) for n in range(9)]
    back = [plane_scene.frame(T, 17 + n) for n, T in enumerate(NEAR[:3])]
    tracks = _tracked([*frames, *there, *back], _settings(new_map_after=3))
    assert [track.status for track in tracks[8:12]] == ["lost"] * 3 + ["initial"]
    assert tracks[11].reason == "new map"
    assert [track.map for track in tracks] == [0] * 11 + [1] * 6 + [0] * 3
    assert [track.status for track in tracks[12:]] == ["ok"] * 8
    # The new map's world is its first frame's camera.
    np.testing.assert_array_equal(tracks[11].T_world_camera, np.eye(4))
    np.testing.assert_allclose(np.linalg.norm(tracks[16].T_world_camera[:3, 3]), 5.0, atol=0.3)
    # And the old one is where it was.
    assert tracks[17].reason == "relocalised"
    turn, way_mm = _off(tracks[17], NEAR[0])
    assert turn < np.radians(0.4)
    assert way_mm < 0.3


def test_a_camera_that_is_lost_for_long_is_looked_for_in_some_frames_and_still_found() -> None:
    frames = [plane_scene.frame(T, n) for n, T in enumerate(NEAR)]
    there = [_elsewhere(8 + n, n % 9) for n in range(12)]
    back = [plane_scene.frame(T, 20 + n) for n, T in enumerate(NEAR[:4])]
    tracks = _tracked([*frames, *there, *back], _settings(new_map_after=0, fast=True))
    searched = ["not searched" not in track.reason for track in tracks[8:20]]
    # The first five, and every third after these.
    assert searched == [True] * 6 + [True, False, False] * 2
    first = next(track for track in tracks[20:] if track.status == "ok")
    assert first.index <= 22
    turn, way_mm = _off(first, NEAR[first.index - 20])
    assert turn < np.radians(0.4)
    assert way_mm < 0.3


def test_a_lost_frame_is_not_aligned_by_light_and_one_keyframe_finds_it(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []

    def count(module: ModuleType, name: str) -> None:
        call = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *arguments: [tried.append(name), call(*arguments)][1])

    count(keyframe_alignment, "align")
    count(relocalisation, "relative_pose_pnp")
    frames = [plane_scene.frame(T, n) for n, T in enumerate(NEAR)]
    there = [_elsewhere(8 + n, n) for n in range(3)]
    tracker = Tracker(_settings(keyframes_wait=False), DisFlow())
    tracks = _tracked([*frames, *there], tracker=tracker)
    assert [track.status for track in tracks] == ["initial"] + ["ok"] * 7 + ["lost"] * 3
    # Of the keyframes 0, 3 and 6.
    assert set(tried) == {"relative_pose_pnp"}
    tried.clear()
    assert tracker.track(plane_scene.frame(NEAR[4], 11)).status == "ok"
    assert tried == ["relative_pose_pnp"]


@pytest.mark.parametrize("unseen", ["dark", "smoked"])
def test_frames_that_show_nothing_begin_no_map(unseen: str) -> None:
    frames = [plane_scene.frame(T, n) for n, T in enumerate(NEAR)]
    last = frames[-1]
    nothing = replace(last, valid=np.zeros_like(last.valid)) if unseen == "dark" else _smoked(last)
    spoilt = [replace(nothing, index=8 + n) for n in range(12)]
    tracks = _tracked([*frames, *spoilt, replace(last, index=20)], _settings(new_map_after=2))
    assert {track.map for track in tracks} == {0}
    assert tracks[-1].status == "ok"


def test_a_bare_wall_is_reported_as_weakly_constrained() -> None:
    rng = np.random.default_rng(0)

    def bare(index: int) -> Frame:
        """Light that falls off to the sides, and the sensor's noise."""
        away = np.linalg.norm(CAMERA.rays, axis=-1, keepdims=True)
        grey = 150 / away**2 + rng.normal(0, 1.0, away.shape)
        rgb = np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8), 3, axis=2)
        depth_mm = np.full(plane_scene.EVERYWHERE.shape, 50.0, np.float32)
        return Frame(index, index / 30, rgb, CAMERA, plane_scene.EVERYWHERE, depth_mm)

    tracker = Tracker(SETTINGS)
    first = tracker.track(bare(0))
    tracker.update(replace(bare(0), T_world_camera=first.T_world_camera), first.decision, measured=False)
    track = tracker.track(bare(1))
    assert track.status == "lost"
    assert "weakly constrained" in track.reason
    assert abs(track.correlation) < 0.15
