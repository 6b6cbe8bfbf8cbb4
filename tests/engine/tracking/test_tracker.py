"""Alignment and tracking on phantom frames with exact truth, and what happens to frames that show nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from scopemap.engine.config import TrackingSettings
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.pyramid import build_pyramid
from scopemap.engine.tracking.rtdl import align
from scopemap.engine.tracking.track import KeyframeDecision, TrackingLoss
from scopemap.engine.tracking.tracker import Tracker, _Failure
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec

SPEC = PhantomSpec(scene="colon", frames=12, width=160, height=128, seed=4)
# By what is seen alone: measured depth of the frames would hide what these tests look at.
PLAIN = {"finest_level": 0}
SETTINGS = TrackingSettings(**PLAIN)
NEW = KeyframeDecision("new")


@cache
def _sequence() -> tuple[list[Frame], np.ndarray]:
    """Frames with true depth, and their true poses relative to the first."""
    phantom, frames = prepare(SPEC), []
    for index in range(SPEC.frames or 0):
        rgb, surface = render_frame(phantom, index)
        depth_mm = surface.depth_mm
        valid = np.isfinite(depth_mm) & (rgb.max(-1) > 20) & (rgb.max(-1) < 240)
        frames.append(Frame(index, index / 30, rgb, SPEC.camera, valid, depth_mm))
    return frames, inverse(phantom.poses[0]) @ phantom.poses


def _errors(T_estimated: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Translation (mm) and rotation (deg) between two motions."""
    difference = inverse(T_true) @ T_estimated
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(rotation_angle_rad(difference[:3, :3])))


def _track_all(settings: TrackingSettings, frames: list[Frame]) -> list[np.ndarray]:
    """Poses by grey values alone: frames are tracked without their depth, only keyframes have one."""
    tracker, poses = Tracker(settings), []
    for frame in frames:
        track = tracker.track(replace(frame, depth_mm=None))
        poses.append(track.T_world_camera)
        if track.decision.kind != "none":
            tracker.update(replace(frame, T_world_camera=track.T_world_camera), track.decision, measured=True)
    return poses


@cache
def _last_pose() -> np.ndarray:
    """The last pose of the sequence by the plain settings."""
    return _track_all(SETTINGS, _sequence()[0])[-1]


@pytest.mark.slow
def test_alignment_finds_the_true_motion() -> None:
    frames, truth = _sequence()
    reference = build_pyramid(frames[0], SETTINGS, use_slope=True)
    found = align(reference, build_pyramid(frames[6], SETTINGS), np.eye(4), SETTINGS)
    moved_mm, turned_deg = _errors(inverse(found.motion.T_current_reference), truth[6])
    assert np.linalg.norm(truth[6][:3, 3]) > 1.5  # standing still would not do
    assert moved_mm < 0.1
    assert turned_deg < 0.15
    assert found.inlier_share > 0.6
    assert found.overlap > 0.6


@pytest.mark.parametrize(
    "changes",
    [
        {"solver": "gauss-newton"},
        {"rotation_first": False},
        {"photometric": "paper", "keyframe_every": 2},
        {"finest_level": 1},
    ],
)
def test_every_ablation_tracks_and_changes_the_result(changes: dict[str, object]) -> None:
    frames, truth = _sequence()
    poses = _track_all(TrackingSettings(**PLAIN | changes), frames)
    moved_mm, turned_deg = _errors(poses[-1], truth[-1])
    assert moved_mm < 0.6
    assert turned_deg < 1.0
    # A tenth of a micrometre or more: the part is not ignored.
    assert np.abs(poses[-1] - _last_pose()).max() > 1e-4


def test_lost_frames_are_kept_and_tracking_goes_on() -> None:
    frames, truth = _sequence()
    noise = np.random.default_rng(0).integers(0, 255, frames[0].rgb.shape, dtype=np.uint8)
    spoilt = list(frames)
    spoilt[5] = replace(frames[5], valid=np.zeros_like(frames[5].valid))
    spoilt[6] = replace(frames[6], rgb=noise)
    tracker, tracks = Tracker(SETTINGS), []
    for frame in spoilt:
        track = tracker.track(frame)
        tracks.append(track)
        if track.status == "initial":
            tracker.update(replace(frame, T_world_camera=track.T_world_camera), track.decision, measured=True)
    assert [track.status for track in tracks] == ["initial"] + ["ok"] * 4 + ["lost"] * 2 + ["ok"] * 5
    assert tracks[5].reason == "only 0% of the image is usable"
    assert "inlier share" in tracks[6].reason
    np.testing.assert_array_equal(tracks[6].T_world_camera, tracks[4].T_world_camera)
    moved_mm, turned_deg = _errors(tracks[-1].T_world_camera, truth[-1])
    assert moved_mm < 0.3
    assert turned_deg < 0.4


def test_a_jump_is_believed_only_where_many_features_confirm_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.engine.tracking.keyframe_alignment._MAX_STEP", 1e-4)
    frames, truth = _sequence()
    tracks = []
    for searched in (0, 10):
        tracker = Tracker(TrackingSettings(**PLAIN, relocalisation_keyframes=searched))
        first = tracker.track(frames[0])
        tracker.update(replace(frames[0], T_world_camera=first.T_world_camera), first.decision, measured=True)
        tracks.append(tracker.track(frames[4]))
    assert tracks[0].status == "lost"
    assert "jump" in tracks[0].reason
    assert tracks[1].status == "ok"
    assert max(_errors(tracks[1].T_world_camera, truth[4])) < 0.3


@pytest.mark.parametrize(("share", "wanted"), [(0.7, True), (0.0, False)])
def test_a_fading_keyframe_is_replaced_before_its_turn(share: float, wanted: bool) -> None:
    frames, _ = _sequence()
    tracker = Tracker(TrackingSettings(**PLAIN, min_keyframe_agreement=share))
    first = tracker.track(frames[0])
    tracker.update(replace(frames[0], T_world_camera=first.T_world_camera), first.decision, measured=True)
    assert tracker.track(frames[1]).decision.kind == "none"
    half = frames[2].valid.copy()
    half[:, half.shape[1] // 2 :] = False
    track = tracker.track(replace(frames[2], valid=half))
    assert track.status == "ok"
    assert track.decision.reason == ("the keyframe fits less well than at first" if wanted else "")
    # A new keyframe starts without a past.
    known = replace(frames[2], T_world_camera=track.T_world_camera)
    assert tracker.update(known, NEW, measured=True)
    assert tracker.track(frames[3]).decision.kind == "none"


def test_a_keyframe_without_depth_is_refused() -> None:
    frames, _ = _sequence()
    tracker = Tracker(SETTINGS)
    blind = replace(frames[0], depth_mm=np.full_like(frames[0].depth_mm, np.nan), T_world_camera=np.eye(4))
    assert not tracker.update(blind, NEW, measured=True)
    assert tracker.track(frames[1]).status == "initial"
    with pytest.raises(ValueError, match="needs a depth and a pose"):
        tracker.update(frames[0], NEW, measured=True)


def test_a_frame_that_features_alone_have_found_becomes_a_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = _sequence()
    tracker = Tracker(SETTINGS)
    first = tracker.track(frames[0])
    tracker.update(replace(frames[0], T_world_camera=first.T_world_camera), first.decision, measured=True)
    rejected = TrackingLoss(LossCause.VIEW_CHANGED, "flow is made to fail")
    with monkeypatch.context() as failing:
        failing.setattr(tracker, "_failure", lambda frame, alignment, sharpness: _Failure(rejected, is_obscured=False))
        track = tracker.track(frames[1])
    assert (track.status, track.decision.kind) == ("ok", "new")
    assert track.decision.reason == "flow fails, features find the frame"


def test_masked_pixels_do_not_bleed_into_coarser_levels() -> None:
    frames, _ = _sequence()
    spoilt = frames[0].rgb.copy()
    spoilt[~frames[0].valid] = 255
    twin = replace(frames[0], rgb=spoilt)
    for one, two in zip(build_pyramid(frames[0], SETTINGS), build_pyramid(twin, SETTINGS), strict=True):
        used = one.weight > 0
        np.testing.assert_allclose(one.channels[:, used], two.channels[:, used], atol=1e-4)
