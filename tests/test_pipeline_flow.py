"""What flow carries from frame to frame reaches the tracker: true of the scene, and only where it is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_phantom import true_poses, with_true_depth, write_tiny

from scopemap import open_sequence, reconstruct
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse
from scopemap.tracking import Tracker
from scopemap.tracking.flow_pose import flow_error_px

LOST, FRAMES = 4, 9
# True depth that is said to be predicted, so that MAPIS links the frames.
SETTINGS = {
    "depth__files_kind": "depth",
    "networks__flow": "dis",
    "networks__perceptual": "structure",
    "mapping__method": "none",
    "fusion__enabled": False,
}


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("flow") / "phantom", f"black:{LOST}-{LOST}", frames=FRAMES)


def _tracked_frames(
    phantom: Path, monkeypatch: pytest.MonkeyPatch, **changes: object
) -> tuple[list[Frame], np.ndarray]:
    """The frames as the tracker got them, and the poses that came out."""
    given: list[Frame] = []
    real = Tracker.track

    def track(self: Tracker, frame: Frame) -> object:
        given.append(frame)
        return real(self, frame)

    monkeypatch.setattr(Tracker, "track", track)
    result = reconstruct(open_sequence(phantom), with_true_depth(phantom, **(SETTINGS | changes)))
    return given, result.trajectory.T_world_camera


def test_points_land_where_the_true_motion_takes_them(phantom: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = _tracked_frames(phantom, monkeypatch)
    poses = true_poses(phantom)
    known = [
        n
        for n, frame in enumerate(frames)
        if frame.flow_correspondences is not None and frame.flow_correspondences.share > 0
    ]
    # Neither the first frame, nor a black one, nor the one after it.
    assert known == [n for n in range(FRAMES) if n not in (0, LOST, LOST + 1)]
    for n in known:
        seen = frames[n].flow_correspondences
        assert seen is not None
        assert seen.share > 0.3
        still = flow_error_px(seen, frames[n].camera, np.eye(4))
        assert flow_error_px(seen, frames[n].camera, inverse(poses[n]) @ poses[n - 1]) < min(0.4, 0.5 * still)


def test_no_flow_does_not_hold_the_camera(phantom: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames, poses = _tracked_frames(phantom, monkeypatch, networks__flow="none")
    assert all(frame.flow_correspondences is None for frame in frames)
    true = true_poses(phantom)
    assert np.linalg.norm(poses[-1][:3, 3] - true[-1][:3, 3]) < 0.3 * np.linalg.norm(true[-1][:3, 3])


def test_measured_depth_brings_no_flow(phantom: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = _tracked_frames(phantom, monkeypatch, depth__files_kind="measured")
    assert all(frame.flow_correspondences is None for frame in frames)


@pytest.mark.parametrize(("scaled", "speaks"), [("auto", True), ("robust", False)])
def test_depth_that_mapis_changed_is_not_compared_with_what_is_measured(
    phantom: Path, monkeypatch: pytest.MonkeyPatch, scaled: str, speaks: bool
) -> None:
    adopted: list[bool] = []
    real = Tracker.adopt

    def adopt(self: Tracker, frame: Frame, *, measured: bool) -> bool:
        adopted.append(measured)
        return real(self, frame, measured=measured)

    monkeypatch.setattr(Tracker, "adopt", adopt)
    _tracked_frames(phantom, monkeypatch, depth__files_kind="measured", mapis__advanced__frame_scale=scaled)
    assert adopted
    assert set(adopted) == {speaks}
