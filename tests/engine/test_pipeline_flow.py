"""Runs without flow, and measured depth that MAPIS changed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.frame import Frame
from scopemap.engine.tracking.track import KeyframeDecision
from scopemap.engine.tracking.tracker import Tracker
from tests.support.tiny_phantom import true_poses, with_true_depth, write_tiny

pytestmark = pytest.mark.slow

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


def test_no_flow_does_not_hold_the_camera(phantom: Path) -> None:
    changes = {"networks__flow": "none", "networks__keyframe_flow": "none"}
    result = reconstruct(open_sequence(phantom), with_true_depth(phantom, **SETTINGS | changes))
    poses, true = result.trajectory.T_world_camera, true_poses(phantom)
    assert np.linalg.norm(poses[-1][:3, 3] - true[-1][:3, 3]) < 0.3 * np.linalg.norm(true[-1][:3, 3])


@pytest.mark.parametrize(("scaled", "speaks"), [("auto", True), ("robust", False)])
def test_depth_that_mapis_changed_is_not_compared_with_what_is_measured(
    phantom: Path, monkeypatch: pytest.MonkeyPatch, scaled: str, speaks: bool
) -> None:
    inserted: list[bool] = []
    real = Tracker.update

    def update(self: Tracker, frame: Frame, decision: KeyframeDecision, *, measured: bool) -> bool:
        if decision.kind == "new":
            inserted.append(measured)
        return real(self, frame, decision, measured=measured)

    monkeypatch.setattr(Tracker, "update", update)
    changes = {"depth__files_kind": "measured", "mapis__frame_scale": scaled}
    reconstruct(open_sequence(phantom), with_true_depth(phantom, **SETTINGS | changes))
    assert inserted
    assert set(inserted) == {speaks}
