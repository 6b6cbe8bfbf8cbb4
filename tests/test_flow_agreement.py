"""The check that needs no truth: poses against flow, on a phantom tracked well, and with the camera held still."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tiny_phantom import write_tiny

from scopemap.tracking import Tracker

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

import flow_agreement


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("agreement") / "phantom", frames=7)


def _said(phantom: Path, capsys: pytest.CaptureFixture[str]) -> tuple[float, float]:
    depth = ["--set", f"depth.backend=files:{phantom}", "--set", "depth.files_kind=depth"]
    flow_agreement.main(["--input", str(phantom), *depth, "--set", "tracking.flow_contradiction=0"])
    words = capsys.readouterr().out.split()
    assert "(6 pairs);" in " ".join(words)
    numbers = [float(word) for before, word in pairwise(words) if before in ("by", "are")]
    return numbers[0], numbers[1]


def test_good_poses_agree_with_the_flow(phantom: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moved_px, off_px = _said(phantom, capsys)
    assert off_px < 0.4 < moved_px


def test_standing_still_is_as_far_off_as_tissue_moves(
    phantom: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Tracker, "_T_world_camera", staticmethod(lambda keyframe, alignment: np.eye(4)))
    moved_px, off_px = _said(phantom, capsys)
    assert off_px == pytest.approx(moved_px, abs=0.06)  # one digit and two are said
