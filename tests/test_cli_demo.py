"""The demonstration, on a phantom of few and small frames: figures, files, and that it needs nothing from outside."""

from __future__ import annotations

import json
import socket
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap.actions import demo as demonstration
from scopemap.actions.demo import Demonstration
from scopemap.cli.app import main
from scopemap.config import Config
from scopemap.errors import InputError
from scopemap.io import weights

TINY = replace(demonstration.PHANTOM, frames=8, width=160, height=128)
SETTINGS = {"tracking.keyframe_every": 3}


def _refuse(*_: Any) -> None:
    raise AssertionError("the demonstration went to the network")


@pytest.fixture(scope="module")
def nothing_outside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """No weights, no network; the folder of weights, which must stay as it is."""
    folder = tmp_path_factory.mktemp("weights")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SCOPEMAP_WEIGHTS_DIR", str(folder))
        patch.setattr(socket.socket, "connect", _refuse)
        patch.setattr(socket, "getaddrinfo", _refuse)
        patch.setattr(weights, "locate", _refuse)
        yield folder  # type: ignore[misc]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo") / "out"


@pytest.fixture(scope="module")
def demo(out: Path, nothing_outside: Path) -> Demonstration:
    demonstration.prepare_out(out, overwrite=False)
    assert demonstration.render(out, TINY)
    return demonstration.run_on_phantom(out, Config.load("default", settings=SETTINGS))


@pytest.fixture(scope="module")
def figures(demo: Demonstration) -> dict[str, float]:
    return demonstration.measure(demo)


def test_every_frame_is_tracked_near_the_truth(figures: dict[str, float]) -> None:
    assert figures["frames"] == figures["tracked"] == TINY.frames
    assert figures["path_mm"] > 1
    assert 0 < figures["ate_sim3_mm"] < 0.1 * figures["path_mm"]
    assert figures["ate_sim3_mm"] <= figures["ate_origin_mm"] < 0.5 * figures["path_mm"]
    assert 0.3 < figures["scale"] < 3
    assert 0 < figures["rotation_mean_deg"] <= figures["rotation_max_deg"] < 2


def test_mesh_and_depth_resemble_the_truth(figures: dict[str, float]) -> None:
    assert 0 < figures["mesh_median_mm"] < 10
    assert figures["mesh_median_mm"] <= figures["mesh_accuracy_mm"] < 40
    assert 0 < figures["mesh_completeness_mm"] < 40
    assert 0 < figures["depth_abs_rel"] < 0.4
    assert 0 < figures["raw_depth_abs_rel"] < 0.4


def test_the_run_is_a_run(demo: Demonstration, out: Path) -> None:
    for name in ("trajectory.tum", "mesh.ply", "mesh.glb", "frames.csv", "config.toml", "provenance.json"):
        assert (out / "run" / name).stat().st_size > 0
    assert len(list((out / "run" / "depth").glob("*.png"))) == TINY.frames
    assert demo.result.config.preset == "default"
    assert demo.result.config.tracking.keyframe_every == SETTINGS["tracking.keyframe_every"]


def test_nothing_from_outside_is_used(demo: Demonstration, nothing_outside: Path) -> None:
    assert list(nothing_outside.iterdir()) == []
    parts = demo.result.provenance["estimators"]
    assert (parts["depth"], parts["model"]) == ("scopenet", "that come with the package")
    assert [name for name in parts if "sha256" in name] == ["sha256 scopenet.onnx", "features sha256 alike.onnx"]


def test_pictures_show_something(demo: Demonstration, out: Path) -> None:
    files = demonstration.draw(demo, out / "pictures")
    assert [file.name for file in files] == ["trajectory.png", "mesh.png", "depth.png"]
    for file in files:
        picture = cv2.imread(str(file))
        assert min(picture.shape[:2]) > 300
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_an_earlier_phantom_is_used_again_but_not_another_one(demo: Demonstration, out: Path, tmp_path: Path) -> None:
    before = (out / "phantom" / "mesh_truth.ply").stat().st_mtime_ns
    assert not demonstration.render(out, TINY)
    assert (out / "phantom" / "mesh_truth.ply").stat().st_mtime_ns == before
    small = replace(TINY, frames=2, width=64, height=48)
    assert demonstration.render(tmp_path, small)
    (tmp_path / "phantom" / "mesh_truth.ply").unlink()  # as if it had been stopped half-way
    assert demonstration.render(tmp_path, small)
    assert demonstration.render(tmp_path, replace(small, seed=1))


def test_an_earlier_run_is_kept_unless_told(demo: Demonstration, out: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--overwrite"):
        demonstration.prepare_out(out, overwrite=False)
    (tmp_path / "run").mkdir()
    for name in ("frames.csv", "trajectory.tum", "provenance.json"):
        (tmp_path / "run" / name).write_text("old")
    demonstration.prepare_out(tmp_path, overwrite=True)
    assert (tmp_path / "pictures").is_dir()
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(InputError):
        demonstration.prepare_out(tmp_path / "taken", overwrite=True)


def _command(*arguments: object, done: Demonstration | None = None) -> int | str | None:
    """The exit code of `scopemap demo`; with `done`, nothing is reconstructed and drawn again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["scopemap", "demo", *map(str, arguments)])
        patch.setattr(demonstration, "PHANTOM", TINY)
        if done is not None:
            patch.setattr(demonstration, "run_on_phantom", lambda *_: done)
            patch.setattr(demonstration, "draw", lambda _, folder: [folder / "trajectory.png"])
        with pytest.raises(SystemExit) as caught:
            main()
    return caught.value.code


def test_the_command(demo: Demonstration, out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _command("--out", out) == 1
    assert "--overwrite" in capsys.readouterr().err

    options = ("--overwrite", "--set", "tracking.keyframe_every=3")
    assert _command("--out", out, *options) == 0
    said = capsys.readouterr()
    assert f"{TINY.frames} of {TINY.frames} frames tracked" in said.out
    for file in ("mesh.ply", "mesh_truth.ply", "trajectory.tum", "pose.txt", "trajectory.png"):
        assert file in said.out
    assert "using the earlier phantom" in said.err

    assert _command("--out", out, *options, "--json", done=demo) == 0
    said = capsys.readouterr()
    summary = json.loads(said.out)
    assert said.err == ""
    assert {"frames", "path_mm", "scale", "mesh_accuracy_mm", "raw_depth_abs_rel", "seconds"} < set(summary)
    assert summary["tracked"] == TINY.frames
    assert all(Path(file).is_file() for file in summary["pictures"])

    assert _command("--out", out, *options, "--quiet", done=demo) == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""
