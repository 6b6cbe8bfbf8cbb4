"""The check that needs no truth: poses against flow, on a phantom tracked well, and with the camera held still."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_phantom import with_true_depth, write_tiny

from scopemap.tracking.track import FrameTracker
from scopemap_bench.methods.standing_still import StandingStill
from scopemap_bench.scripts import flow_agreement


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("agreement") / "phantom", frames=7)


def _measured(phantom: Path, tracker: FrameTracker | None = None) -> flow_agreement.Agreement:
    fixed = {"mapping__method": "none", "fusion__enabled": False, "depth__files_kind": "depth"}
    light = {"networks__flow": "dis", "networks__perceptual": "structure"}
    return flow_agreement.measure(phantom, 7, with_true_depth(phantom, **fixed, **light), tracker)


def test_good_poses_agree_with_the_flow(phantom: Path) -> None:
    found = _measured(phantom)
    assert (found.compared, found.lost, found.frames) == (6, 0, 7)
    assert found.off_px < 0.4 < found.moved_px


def test_standing_still_errs_by_the_motion_of_the_tissue(phantom: Path) -> None:
    found = _measured(phantom, StandingStill())
    assert found.off_px == pytest.approx(found.moved_px)


def test_the_result_is_printed(phantom: Path, capsys: pytest.CaptureFixture[str]) -> None:
    depth = ["--set", f"depth.backend=files:{phantom}", "--set", "depth.files_kind=depth"]
    flow_agreement.main(["--input", str(phantom), "--frames", "3", *depth])
    assert "(2 pairs); of 3 frames 0 were lost" in capsys.readouterr().out
