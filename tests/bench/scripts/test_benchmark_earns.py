"""The table of what each part of a run earns: its switches and clips exist, and its cells say what they should."""

from __future__ import annotations

import ast
import subprocess
from pathlib import Path
from typing import Any

import pytest

import scopemap
from scopemap import Config, open_sequence, reconstruct
from scopemap_bench.scripts import earns, measuring
from scopemap_bench.scripts.real import RealClip
from scopemap_bench.scripts.with_number import constant_of
from tests.support.tiny_phantom import write_tiny

QUICK = {"networks.flow": "dis", "networks.perceptual": "structure", "tracking.keyframe_every": 2}


def test_each_switch_turns_something_off() -> None:
    default = Config.load()
    for switch in earns.SWITCHES:
        name, value = switch.split("=")
        assert Config.load(settings={name: value}) != default


def test_each_idea_is_another_value_of_a_constant_of_the_engine() -> None:
    engine = Path(scopemap.__file__).parent / "engine"
    for idea in earns.IDEAS:
        name, value = idea.split("=")
        module, _, constant = name.rpartition(".")
        tree = ast.parse((engine / (module.replace(".", "/") + ".py")).read_text(encoding="utf-8"))
        (known,) = (found[1] for node in tree.body if (found := constant_of(node)) and found[0] == constant)
        assert known != ast.literal_eval(value)


@pytest.mark.slow
def test_a_constant_is_changed_for_one_run(tmp_path: Path) -> None:
    clip = RealClip("a clip", write_tiny(tmp_path / "phantom"), arguments=("--frames", "0:2"))
    earns.run_with(clip, "tracking.keyframe_choice._PATIENCE=0", tmp_path / "run")
    assert (tmp_path / "run" / "provenance.json").is_file()
    with pytest.raises(subprocess.CalledProcessError):
        earns.run_with(RealClip("none", tmp_path / "none"), "tracking.keyframe_choice._PATIENCE=0", tmp_path / "failed")


def test_the_phantoms_are_eight_and_those_of_the_other_tables() -> None:
    found = earns.phantoms()
    assert len(found) == 8
    assert all({"--scene", "--frames", "--seed"} <= set(words) for words in found.values())


@pytest.mark.slow
def test_a_cell_has_the_error_of_the_path_and_the_verdict_or_that_the_run_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    phantom, asked = write_tiny(tmp_path / "phantom"), list[tuple[Any, ...]]()

    def run_once(source: Path, out: Path, *words: object) -> Path:
        asked.append(words)
        if "mapping.method=none" in words:
            raise subprocess.CalledProcessError(1, "scopemap")
        reconstruct(open_sequence(source), Config.load(settings=QUICK), out=out)
        return out

    monkeypatch.setattr(measuring, "run_once", run_once)
    clip = RealClip("a clip", phantom, arguments=("--fov", "70"))
    error, word = earns.cell(clip, "", tmp_path).split(", ")
    assert 0 < float(error) < 5
    assert word in ("good", "doubtful", "not usable")
    assert earns.cell(clip, "mapping.method=none", tmp_path) == "the run fails"
    assert asked == [("--fov", "70"), ("--fov", "70", "--set", "mapping.method=none")]
