"""Frames that were lost are tracked backwards from where a map began, and a map that leads back to another joins it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.keyframe_alignment import Keyframe, KeyframeAligner
from scopemap.engine.tracking.rtdl import Alignment
from scopemap.engine.tracking.track import Track, TrackingLoss
from scopemap.engine.tracking.tracker import Tracker
from scopemap.result.result import Result
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import true_poses, with_true_depth, write_tiny

pytestmark = pytest.mark.slow

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


def _run(phantom: Path, monkeypatch: pytest.MonkeyPatch, twice: range = range(0), **changes: object) -> Result:
    """Run while every pose of the frames `LOST`, and of that with which a map begins then, is refused the first time.

    twice : frames of which every pose is refused later, too.
    """
    track, reject = Tracker.track, KeyframeAligner.rejection
    now, done = [-1], set[int]()

    def watched(self: Tracker, frame: Frame) -> Track:
        now[0] = frame.index
        found = track(self, frame)
        done.add(frame.index)
        return found

    def refusing(self: KeyframeAligner, keyframe: Keyframe, alignment: Alignment) -> TrackingLoss | None:
        first = now[0] in (*LOST, LOST.stop) and now[0] not in done
        again = now[0] in twice and now[0] in done
        refused = TrackingLoss(LossCause.VIEW_CHANGED, "refused")
        return refused if first or again else reject(self, keyframe, alignment)

    monkeypatch.setattr(Tracker, "track", watched)
    monkeypatch.setattr(KeyframeAligner, "rejection", refusing)
    return reconstruct(open_sequence(phantom), with_true_depth(phantom, **LIGHT | changes))


def _rows(result: Result, folder: Path) -> list[dict[str, str]]:
    result.save(folder)
    return frame_rows(folder)


def _off(result: Result, phantom: Path, frames: range) -> tuple[float, float]:
    true, found = true_poses(phantom, frames[0]), result.trajectory.T_world_camera
    off = [inverse(true[k]) @ inverse(found[frames[0]]) @ found[k] for k in frames]
    turn = max(float(rotation_angle_rad(T[:3, :3])) for T in off)
    return turn, max(float(np.linalg.norm(T[:3, 3])) for T in off)


def test_a_map_that_leads_back_to_an_earlier_one_joins_it(
    phantom: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = _run(phantom, monkeypatch)
    assert result.trajectory.status.tolist() == ["initial"] + ["ok"] * (FRAMES - 1)
    rows = _rows(result, tmp_path)
    assert {row["map"] for row in rows} == {"0"}
    assert [rows[k]["reason"] for k in LOST] == ["tracked backwards"] * len(LOST)
    assert rows[LOST.stop]["reason"] == "relocalised"
    turn, way_mm = _off(result, phantom, range(FRAMES))
    assert turn < np.radians(1.0)
    assert way_mm < 0.5


def test_lost_frames_are_tracked_backwards_in_a_map_of_its_own(
    phantom: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = _run(phantom, monkeypatch, twice=range(LOST.start), mapping__min_loop_inliers=10**6)
    # The earlier frames are never found from the later ones: two maps, the larger with the lost frames.
    assert result.trajectory.status.tolist() == ["other-map"] * LOST.start + ["ok"] * (FRAMES - LOST.start)
    assert _rows(result, tmp_path)[LOST.stop]["reason"] == "new map"
    np.testing.assert_allclose(result.trajectory.T_world_camera[LOST.start], np.eye(4), atol=1e-9)
    turn, way_mm = _off(result, phantom, range(LOST.start, FRAMES))
    assert turn < np.radians(1.0)
    assert way_mm < 0.5


@pytest.mark.parametrize("changes", [{"tracking__relocalisation_keyframes": 0}, {"smoothing__method": "wema"}])
def test_nothing_goes_back_where_it_is_not_wanted(
    phantom: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, object]
) -> None:
    result = _run(phantom, monkeypatch, **changes)
    assert [result.trajectory.status[k] for k in LOST] == ["lost"] * len(LOST)
