"""Frames that were lost are tracked backwards from where a map began, and a map that leads back to another joins it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_phantom import true_poses, with_true_depth, write_tiny

from scopemap import Reconstruction, open_sequence, reconstruct
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap.mapping import Mapper
from scopemap.runner.backwards import _agree, _join
from scopemap.tracking.relocalisation import Keyframe
from scopemap.tracking.rtdl import Alignment
from scopemap.tracking.track import Track, TrackingLoss
from scopemap.tracking.tracker import Tracker
from scopemap.trajectory.causes import LossCause
from scopemap.trajectory.frame_table import FrameTable

FRAMES, LOST = 16, range(6, 9)
LIGHT = {
    "depth__files_kind": "depth",
    "tracking__new_map_after": len(LOST),
    "tracking__keyframe_every": 3,
    "fusion__enabled": False,
}


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("backwards") / "phantom", frames=FRAMES)


def _run(phantom: Path, monkeypatch: pytest.MonkeyPatch, twice: range = range(0), **changes: object) -> Reconstruction:
    """Run while every pose of the frames `LOST`, and of that with which a map begins then, is refused the first time.

    twice : frames of which every pose is refused later, too.
    """
    track, reject = Tracker.track, Tracker._rejection
    now, done = [-1], set[int]()

    def watched(self: Tracker, frame: Frame) -> Track:
        now[0] = frame.index
        found = track(self, frame)
        done.add(frame.index)
        return found

    def refusing(self: Tracker, keyframe: Keyframe, alignment: Alignment) -> TrackingLoss | None:
        first = now[0] in (*LOST, LOST.stop) and now[0] not in done
        again = now[0] in twice and now[0] in done
        refused = TrackingLoss(LossCause.VIEW_CHANGED, "refused")
        return refused if first or again else reject(self, keyframe, alignment)

    monkeypatch.setattr(Tracker, "track", watched)
    monkeypatch.setattr(Tracker, "_rejection", refusing)
    return reconstruct(open_sequence(phantom), with_true_depth(phantom, **LIGHT | changes))


def _off(result: Reconstruction, phantom: Path, frames: range) -> tuple[float, float]:
    true, found = true_poses(phantom, frames[0]), result.trajectory.T_world_camera
    off = [inverse(true[k]) @ inverse(found[frames[0]]) @ found[k] for k in frames]
    turn = max(float(rotation_angle_rad(T[:3, :3])) for T in off)
    return turn, max(float(np.linalg.norm(T[:3, 3])) for T in off)


def test_a_map_that_leads_back_to_an_earlier_one_joins_it(phantom: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = _run(phantom, monkeypatch)
    assert result.frames["status"].tolist() == ["initial"] + ["ok"] * (FRAMES - 1)
    assert set(result.frames["map"].tolist()) == {0}
    assert [result.frames["reason"][k] for k in LOST] == ["tracked backwards"] * len(LOST)
    assert result.frames["reason"][LOST.stop] == "relocalised"
    turn, way_mm = _off(result, phantom, range(FRAMES))
    assert turn < np.radians(1.0)
    assert way_mm < 0.5


def test_lost_frames_are_tracked_backwards_in_a_map_of_its_own(phantom: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = _run(phantom, monkeypatch, twice=range(LOST.start), mapping__min_loop_inliers=0)
    # The earlier frames are never found from the later ones: two maps, the larger with the lost frames.
    assert result.frames["status"].tolist() == ["other-map"] * LOST.start + ["ok"] * len(LOST) + ["ok"] * (
        FRAMES - LOST.stop
    )
    assert result.frames["reason"][LOST.stop] == "new map"
    np.testing.assert_allclose(result.trajectory.T_world_camera[LOST.start], np.eye(4), atol=1e-9)
    turn, way_mm = _off(result, phantom, range(LOST.start, FRAMES))
    assert turn < np.radians(1.0)
    assert way_mm < 0.5


@pytest.mark.parametrize(
    "changes", [{"tracking__relocalisation_keyframes": 0}, {"mapping__method": "none"}, {"smoothing__method": "wema"}]
)
def test_nothing_goes_back_where_it_is_not_wanted(
    phantom: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, object]
) -> None:
    result = _run(phantom, monkeypatch, **changes)
    assert [result.frames["status"][k] for k in LOST] == ["lost"] * len(LOST)


def test_motions_that_differ_join_nothing() -> None:
    here, turned, moved = np.eye(4), np.eye(4), np.eye(4)
    turned[:2, :2] = [[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]]
    moved[0, 3] = 11.0
    assert _agree([here, here, here], 50.0)
    assert not _agree([here, turned, here], 50.0)
    assert not _agree([here, here, moved], 50.0)
    assert _agree([here, here, moved], 60.0)


def test_a_joined_map_takes_the_earlier_number_and_world(phantom: Path) -> None:
    T = np.eye(4)
    T[0, 3] = 7.0
    config = with_true_depth(phantom)
    mapper = Mapper(config.mapping, _NoFlow())
    tracks = [Track(0, "initial", "", np.eye(4), 0), Track(1, "lost", "", np.eye(4), 0)]
    tracks += [Track(2, "initial", "new map", np.eye(4), 2, map=1), Track(3, "ok", "", T, 2, map=1)]
    for track in tracks:
        mapper.observe(track)
    mapper.join(tracks[2].index, tracks[0].index, T)
    frames = FrameTable.of(track.row for track in tracks)
    _join(frames, 2, 0, T)
    assert frames["map"].tolist() == [0, 0, 0, 0]
    assert frames["status"].tolist() == ["initial", "lost", "ok", "ok"]
    assert frames["T_world_camera"][3, 0, 3] == 14.0
    (submap,), _ = mapper.submaps()
    assert submap.frames == {0, 2, 3}


class _NoFlow:
    name = "none"
