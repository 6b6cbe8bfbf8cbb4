"""A wall that fills the picture: its rotation is followed, marked and written; features must confirm what follows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.config import TrackingSettings
from scopemap.engine.depth.mapis import DenseCorrespondence
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.mapping.segments import Segment, Submap
from scopemap.engine.tracking.causes import LossCause, causes_of_loss
from scopemap.engine.tracking.relocalisation import RotationFollower, rotation_by_flow
from scopemap.engine.tracking.track import Track
from scopemap.engine.tracking.tracker import Tracker
from scopemap.result.frame_table import LOST, ROTATED, FrameTable
from scopemap.result.losses import ADVICE
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.submap_frames import frames_of_submap
from tests.support import plane_scene
from tests.support.drawn_run import changed
from tests.support.plane_scene import CAMERA, EVERYWHERE
from tests.support.tiny_phantom import with_true_depth, write_tiny

FIRST = plane_scene.pose(turn_rad=(0.3, 0.1, 0.0))
SECOND = FIRST @ plane_scene.pose(at_mm=(3.0, -1.0, 2.0), turn_rad=(0.03, -0.06, 0.02))
TURN = (inverse(SECOND) @ FIRST)[:3, :3]


def _seen(earlier: np.ndarray, later: np.ndarray, outliers: float = 0.0) -> DenseCorrespondence:
    """The flow that the plane gives, with a share of false matches that pass for consistent."""
    flow = plane_scene.true_flow(plane_scene.see(later), plane_scene.see(earlier))
    rng = np.random.default_rng(3)
    false = rng.uniform(size=EVERYWHERE.shape) < outliers
    flow[false] = rng.uniform(-30, 30, (int(false.sum()), 2))
    return DenseCorrespondence(flow, EVERYWHERE, np.zeros(EVERYWHERE.shape, np.float32))


def _deg(R: np.ndarray) -> float:
    return float(np.degrees(rotation_angle_rad(R)))


@pytest.mark.parametrize("scale", [1.0, 8.0])
@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_the_rotation_beside_a_near_wall_is_found_whatever_its_depth_is_scaled_by(
    scale: float, outliers: float
) -> None:
    depth_mm = np.float32(scale) * plane_scene.see(FIRST).depth_mm
    R = rotation_by_flow(depth_mm, CAMERA, _seen(FIRST, SECOND, outliers))
    assert R is not None
    assert _deg(TURN) > 3
    assert _deg(R @ TURN.T) < 0.1


def test_flow_that_matches_little_or_fits_nothing_gives_no_rotation() -> None:
    depth_mm, found = plane_scene.see(FIRST).depth_mm, _seen(FIRST, SECOND)
    few = replace(found, consistent=np.broadcast_to(np.arange(CAMERA.width) < 0.2 * CAMERA.width, EVERYWHERE.shape))
    assert rotation_by_flow(depth_mm, CAMERA, few) is None
    assert rotation_by_flow(depth_mm, CAMERA, _seen(FIRST, SECOND, 1.0)) is None
    assert rotation_by_flow(np.full_like(depth_mm, np.nan), CAMERA, found) is None


def _small(T: np.ndarray) -> Frame:
    view = plane_scene.see(T)
    return Frame(0, 0.0, view.rgb, CAMERA, EVERYWHERE, view.depth_mm)


def _track(status: str, index: int = 0) -> Track:
    return Track(index, status, "", np.eye(4), 0)  # type: ignore[arg-type]


def test_rotations_add_up_until_flow_ends_and_a_resumed_follower_goes_on_alike() -> None:
    third = SECOND @ plane_scene.pose(at_mm=(1.0, 1.0, 0.0), turn_rad=(0.0, 0.05, 0.0))
    follower = RotationFollower()
    tracked = follower.follow(_track("ok"), _small(FIRST), None)
    assert tracked.rotation is None
    lost = follower.follow(_track("lost"), _small(SECOND), _seen(FIRST, SECOND))
    assert lost.rotation is not None
    assert _deg(lost.rotation @ TURN) < 0.1
    resumed = RotationFollower()
    resumed.resume_after(lost, np.asarray(_small(SECOND).depth_mm))
    step = _track("lost"), _small(third), _seen(SECOND, third)
    later, again = follower.follow(*step), resumed.follow(*step)
    assert later.rotation is not None
    assert _deg(later.rotation.T @ (inverse(FIRST) @ third)[:3, :3]) < 0.2
    np.testing.assert_array_equal(later.rotation, again.rotation)
    # Once it is not followed it is unknown, until the camera is tracked.
    assert follower.follow(_track("lost"), _small(third), None).rotation is None
    assert follower.follow(_track("lost"), _small(third), _seen(third, third)).rotation is None
    follower.follow(_track("ok"), _small(third), None)
    assert follower.follow(_track("lost"), _small(third), _seen(third, third)).rotation is not None


# ---- tracking


TILTED = [plane_scene.pose(at_mm=(0.8 * n, 0.0, 0.0), turn_rad=(0.6, 0.0, 0.0)) for n in range(24)]


def _frames(depth_after: float) -> list[Frame]:
    """A tilted plane; in frames 6 to 8 a bare wall; the depth after it is of another scale."""
    frames = []
    for n, T in enumerate(TILTED):
        view = plane_scene.see(T)
        rgb, depth_mm = view.rgb, view.depth_mm * np.float32(depth_after if n > 8 else 1.0)
        if 6 <= n <= 8:
            rgb, depth_mm = cv2.GaussianBlur(rgb, (0, 0), 12.0), np.full_like(depth_mm, 20.0)
        frames.append(Frame(n, n / 30, rgb, CAMERA, EVERYWHERE, depth_mm))
    return frames


def _tracked(frames: list[Frame], **changes: object) -> list[Track]:
    tracker, tracks = Tracker(TrackingSettings(keyframe_every=3, finest_level=0, **changes)), []
    for frame in frames:
        track = tracker.track(frame)
        tracks.append(track)
        if track.decision.kind != "none":
            tracker.update(replace(frame, T_world_camera=track.T_world_camera), track.decision, measured=False)
    return tracks


@pytest.mark.slow
def test_after_a_wall_features_confirm_the_pose_and_tell_the_scale_of_depth() -> None:
    tracks = _tracked(_frames(2.0))
    assert all(track.cause is LossCause.CONTACT for track in tracks[6:9])
    frames = FrameTable.of(track.row for track in tracks)
    causes = causes_of_loss(frames["status"], frames["cause"], frames["motion"])
    assert causes[6:9] == ["contact with the wall"] * 3
    assert ADVICE["contact with the wall"]
    assert (tracks[9].status, tracks[9].reason, tracks[9].map) == ("ok", "relocalised", 0)
    assert tracks[9].depth_ratio == pytest.approx(0.5, rel=0.03)
    assert np.isnan([track.depth_ratio for track in [*tracks[:9], *tracks[10:]]]).all()
    assert np.linalg.norm((inverse(tracks[9].T_world_camera) @ inverse(TILTED[0]) @ TILTED[9])[:3, 3]) < 0.5


@pytest.mark.slow
def test_a_pose_after_a_wall_that_no_features_confirm_begins_a_new_map_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tracker, "_found", lambda *_, **__: None)
    tracks = _tracked(_frames(1.0), new_map_after=4)
    assert [track.status for track in tracks[6:]] == ["lost"] * (3 + 8) + ["initial"] + ["ok"] * 6
    assert {track.reason for track in tracks[9:17]} == {
        "rejected: no features confirm the pose after a wall filled the picture"
    }
    assert tracks[17].map == 1


# ---- what is written


def _frames_at_a_wall() -> FrameTable:
    """Three tracked frames, three lost ones of which a wall fills one, one tracked, one lost to something else."""
    step = plane_scene.pose(turn_rad=(0.0, 0.2, 0.0))
    rows, found = [], [None, None, None, step, step @ step, None, None, step]
    for index, rotation in enumerate(found):
        is_lost = index in (3, 4, 5, 7)
        lost_by = LossCause.CONTACT if index == 4 else LossCause.VIEW_CHANGED
        T = plane_scene.pose(at_mm=(float(index), 0.0, 0.0), turn_rad=(0.1 * index, 0.0, 0.0))
        row = {"index": index, "time_s": index / 30, "map": 0, "keyframe": 0, "status": "lost" if is_lost else "ok"}
        row["cause"] = lost_by if is_lost else LossCause.NONE
        row["T_world_camera"], row["rotation"] = None if is_lost else T, None if rotation is None else rotation[:3, :3]
        rows.append(row)
    frames = frozenset({0, 1, 2, 6})
    return frames_of_submap(
        0, [Submap(0, (0,), frames, frames, (Segment(max(frames), frames=frames),))], FrameTable.of(rows)
    )


def test_rotations_are_marked_where_a_wall_filled_the_picture_and_not_counted_as_tracked() -> None:
    frames = _frames_at_a_wall()
    assert frames["status"].tolist() == ["ok"] * 3 + ["rotation-only"] * 2 + ["lost", "ok", "lost"]
    assert frames.counts == {"frames": 8, "tracked": 4, "lost": 4, "rotation_only": 2, "in_other_maps": 0}
    last, turned = frames["T_world_camera"][2], plane_scene.pose(turn_rad=(0.0, 0.4, 0.0))
    np.testing.assert_allclose(frames["T_world_camera"][4, :3, :3], (last @ turned)[:3, :3], atol=1e-12)
    assert np.isnan(frames["T_world_camera"][4, :3, 3]).all()


@pytest.mark.slow
def test_rotations_are_in_the_folder_and_come_back(tmp_path: Path) -> None:
    phantom = write_tiny(tmp_path / "phantom", frames=8)
    result = changed(reconstruct(open_sequence(phantom), with_true_depth(phantom)), frames=_frames_at_a_wall())
    assert result.lost["index"].tolist() == [3, 4, 5, 7]
    result.save(tmp_path / "out")
    found = read_trajectory(tmp_path / "out", kind="run")
    np.testing.assert_array_equal(found.status, result.trajectory.status)
    np.testing.assert_allclose(found.T_world_camera, result.trajectory.T_world_camera, atol=2e-6)
    assert found.tracked.tolist() == [True] * 3 + [False] * 3 + [True, False]
    assert result.frames.submap.tolist() == [0, 0, 0, ROTATED, ROTATED, LOST, 0, LOST]
