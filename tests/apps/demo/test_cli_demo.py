"""The demonstration, on a part of its clip: figures, files, and that it needs nothing from outside."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap.apps.demo import demo as demonstration
from scopemap.apps.demo.demo import Demonstration
from scopemap.engine.config import Config
from scopemap.engine.models import weights
from tests.support.front_door import call

pytestmark = pytest.mark.slow

COUNT = 12


def _refuse(*_: Any) -> None:
    raise AssertionError("the demonstration went to the network")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demonstration:
    """Of the first frames, without weights or a network."""
    out = tmp_path_factory.mktemp("demo") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", _refuse)
        patch.setattr(socket, "getaddrinfo", _refuse)
        patch.setattr(weights, "locate", _refuse)
        demonstration.prepare_out(out, overwrite=False)
        return demonstration.run_clip(out, Config(), frames=slice(0, COUNT))


def test_the_run_is_near_the_truth(demo: Demonstration) -> None:
    figures = demonstration.measure(demo)
    assert figures["frames"] == figures["tracked"] == COUNT
    assert figures["path_mm"] > 1
    assert 0 < figures["ate_sim3_mm"] < 0.1
    assert figures["ate_sim3_mm"] <= figures["ate_origin_mm"] < 0.5 * figures["path_mm"]
    assert 0 < figures["rotation_mean_deg"] <= figures["rotation_max_deg"] < 2
    run = demo.clip.parent / "run"
    for name in ("trajectory.tum", "mesh.ply", "mesh.glb", "frames.csv", "config.toml", "provenance.json"):
        assert (run / name).stat().st_size > 0
    parts = demo.result.provenance["estimators"]
    assert [name for name in parts if "sha256" in name] == ["sha256 scopenet.onnx", "features sha256 alike.onnx"]


def test_the_command(demo: Demonstration, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    out = demo.clip.parent
    assert call("demo", "--out", out) == 1
    assert "--overwrite" in capsys.readouterr().err
    monkeypatch.setattr(demonstration, "run_clip", lambda *_: demo)
    assert call("demo", "--out", out, "--overwrite") == 0
    said = capsys.readouterr().out
    assert f"{COUNT} of {COUNT} frames tracked" in said
    assert all(name in said for name in ("colon.mp4", "mesh.ply", "trajectory.tum", "pose.txt", "trajectory.png"))
    assert call("demo", "--out", out, "--overwrite", "--json") == 0
    said = capsys.readouterr()
    summary = json.loads(said.out)
    assert said.err == ""
    assert summary["tracked"] == COUNT
    assert [Path(file).name for file in summary["pictures"]] == ["trajectory.png", "depth.png"]
    for file in summary["pictures"]:
        picture = cv2.imread(file)
        assert min(picture.shape[:2]) > 300
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert call("demo", "--out", out, "--overwrite", "--quiet") == 0
    assert capsys.readouterr().out == ""
