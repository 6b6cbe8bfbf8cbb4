"""Where tissue moves further than flow follows: features match the frame tracked last and give flow its start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.config import TrackingSettings
from scopemap.engine.flow.corners import KeyframeMatcher
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.tracking.alike import AlikeFeatures
from scopemap.engine.tracking.keyframe_alignment import MIN_SHARPNESS, is_obscured
from scopemap.engine.tracking.rtdl import Alignment, Motion
from scopemap.engine.tracking.track import KeyframeDecision, Track
from scopemap.engine.tracking.tracker import Tracker
from tests.support import plane_scene
from tests.support.plane_scene import CAMERA

# Each frame some 50 px and 14 degrees from the one before; the first and the fifth have hardly anything in common.
FAST = [plane_scene.pose(at_mm=(14.0 * n, 6.0 * n, 0.0), turn_rad=(0.0, 0.0, 0.25 * n)) for n in range(5)]
NO_KEYFRAME = KeyframeDecision()
SETTINGS = TrackingSettings(finest_level=0, keyframe_every=100, min_keyframe_agreement=0.0)


def _frame(index: int, T_world_camera: np.ndarray) -> Frame:
    view = plane_scene.see(T_world_camera)
    return Frame(index, index / 30, view.rgb, CAMERA, plane_scene.EVERYWHERE, view.depth_mm)


def _tracked(*, remembering: bool) -> list[Track]:
    tracker, tracks = Tracker(SETTINGS, DisFlow(), AlikeFeatures()), []
    for index, T in enumerate(FAST):
        frame = _frame(index, T)
        track = tracker.track(frame)
        tracks.append(track)
        if track.status == "lost":
            continue
        tracked = replace(frame, T_world_camera=track.T_world_camera)
        if index == 0:
            assert tracker.update(tracked, track.decision, measured=False)
        elif remembering:
            assert tracker.update(tracked, NO_KEYFRAME, measured=False)
    return tracks


def test_fast_motion_is_tracked_from_the_last_frame() -> None:
    tracks = _tracked(remembering=True)
    assert [track.status for track in tracks] == ["initial", *["ok"] * 4]
    # It became the keyframe, and nothing was lost in between.
    assert [track.reason for track in tracks[1:]] == [""] * 4
    assert tracks[-1].keyframe in (2, 3)
    promoted = [track.index for track in tracks if track.decision.promotes_previous]
    assert promoted
    assert all(tracks[index].keyframe == index - 1 for index in promoted)
    assert {tracks[index].decision.reason for index in promoted} == {"flow fails, features find the frame"}
    for track, T in zip(tracks, FAST, strict=True):
        off = inverse(track.T_world_camera) @ T
        assert rotation_angle_rad(off[:3, :3]) < np.radians(1.0)
        assert np.linalg.norm(off[:3, 3]) < 1.5


def test_without_the_last_frame_the_same_motion_loses_the_camera() -> None:
    assert _tracked(remembering=False)[-1].status == "lost"


def test_flow_is_searched_from_the_guessed_motion() -> None:
    near, far = _frame(0, FAST[0]), _frame(1, FAST[1])
    T, coverage = inverse(FAST[1]) @ FAST[0], []
    for guess in (None, T):
        matcher = KeyframeMatcher(DisFlow())
        matcher.set_keyframe(near, far, guess)
        found = matcher.match(far)
        assert found is not None
        coverage.append(found.coverage)
    assert coverage[1] > 0.3
    assert coverage[1] > 2 * coverage[0]
    errors = CAMERA.project(found.points_mm @ T[:3, :3].T + T[:3, 3]) - found.pixels
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.3


@pytest.mark.parametrize(("sharpness", "matches", "obscured"), [(0.5, 39, True), (0.5, 40, False), (0.2, 400, True)])
def test_features_that_match_tell_a_bare_wall_from_smoke(sharpness: float, matches: int, obscured: bool) -> None:
    alignment = Alignment(Motion(np.eye(4), np.array([1.0, 0.0])), 1.0, 0.5, 0.3, 1.0, 0.9, 5, matches=matches)
    assert is_obscured(sharpness, alignment, MIN_SHARPNESS) == obscured
