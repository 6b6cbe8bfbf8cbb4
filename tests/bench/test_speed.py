"""The processor time of a run's stages: measured, kept, compared."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from scopemap import Config
from scopemap.cli.app import app
from scopemap.engine.errors import InputError
from scopemap_bench import speed
from scopemap_bench.speed import STAGES, Speed, measure_speed, read_speed, resolved
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow


def _functions() -> list[Callable[..., Any]]:
    owners = [resolved(place) for places in STAGES.values() for place in places]
    return [getattr(owner, name) for owner, name in owners]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Speed:
    before = _functions()
    found = measure_speed(write_tiny(tmp_path_factory.mktemp("speed") / "tiny"), Config(), frames=6)
    assert _functions() == before
    return found


def test_every_frame_of_a_run_is_measured_stage_by_stage(measured: Speed) -> None:
    assert (measured.clip, measured.frames, measured.size) == ("tiny", 6, (160, 128))
    always = {"read", "masks", "depth network", "flow to the previous frame", "flow to the keyframe", "tracking"}
    assert always | {"MAPIS", "store", "fusion", "writing", "back end"} <= measured.stages.keys()
    assert sum(stage.share for stage in measured.stages.values()) == pytest.approx(1)
    assert measured.stages["depth network"].thread == "preprocess"
    assert measured.stages["tracking"].thread == "track"
    for stage in measured.stages.values():
        assert stage.ratio == pytest.approx(stage.ms / measured.calibration_ms)
    assert measured.cpu_ms > measured.stages["tracking"].ms


def test_a_stage_counts_without_the_stages_within(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter(range(100))
    monkeypatch.setattr(speed.time, "thread_time", lambda: float(next(ticks)))
    clock = speed.Stopwatch()
    with clock.noted("tracking"):
        for _ in range(2):
            with clock.noted("masks"):
                pass
    stages = clock.stages(frames=1, calibration_ms=1000.0)
    # 6 ticks from first to last, of which each of the calls within takes one.
    assert {name: stage.ratio for name, stage in stages.items()} == {"tracking": 3, "masks": 2}


def test_a_measurement_is_kept_and_slower_stages_are_named(measured: Speed, tmp_path: Path) -> None:
    file = tmp_path / "speed.json"
    file.write_text(json.dumps(measured.json()), encoding="utf-8")
    before = read_speed(file)
    assert measured.slower_than(before, 0.25) == []
    masks = measured.stages["masks"]
    slower = replace(measured, stages=measured.stages | {"masks": replace(masks, ratio=masks.ratio + 1)})
    assert [line.partition(":")[0] for line in slower.slower_than(before, 0.25)] == ["masks"]
    assert before.slower_than(slower, 0.25) == []
    whole = replace(measured, cpu_ms=2 * measured.cpu_ms)
    assert [line.partition(":")[0] for line in whole.slower_than(before, 0.25)] == ["whole process"]
    assert slower.slower_than(before, 0.25, whole=True) == []
    assert len(whole.slower_than(before, 0.25, whole=True)) == 1
    unknown = replace(before, stages={name: stage for name, stage in before.stages.items() if name != "depth network"})
    assert measured.slower_than(unknown, 0.25)[0].startswith("depth network: ")
    with pytest.raises(InputError, match="preset realtime: measure the same"):
        measured.slower_than(replace(before, preset="realtime"), 0.25)
    file.write_text('{"clip": 3}', encoding="utf-8")
    with pytest.raises(InputError, match="no measurement of speed"):
        read_speed(file)


def test_the_command_prints_compares_and_fails(
    measured: Speed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []
    monkeypatch.setattr(speed, "measure_speed", lambda *arguments: given.append(arguments) or measured)
    file = tmp_path / "speed.json"
    file.write_text(
        CliRunner().invoke(app, ["bench", "speed", "clip.mp4", "--frames", "5", "--json"]).stdout, encoding="utf-8"
    )
    assert (given[0][0], given[0][2]) == (Path("clip.mp4"), 5)
    assert read_speed(file).stages.keys() == measured.stages.keys()
    same = CliRunner().invoke(app, ["bench", "speed", "--compare", str(file)])
    assert same.exit_code == 0
    assert "depth network" in same.stdout
    content = json.loads(file.read_text(encoding="utf-8"))
    content["stages"]["depth network"]["ratio"] = 0.0
    file.write_text(json.dumps(content), encoding="utf-8")
    slower = CliRunner().invoke(app, ["bench", "speed", "--compare", str(file)])
    assert slower.exit_code == 1
    assert "slower: depth network" in slower.stderr


def test_of_three_runs_the_median_counts(measured: Speed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "speed.json"
    file.write_text(json.dumps(measured.json()), encoding="utf-8")
    slow = replace(measured, cpu_ms=2 * measured.cpu_ms)
    monkeypatch.setattr(speed, "reconstruct", lambda *_, **__: None)
    monkeypatch.setattr(speed, "write_phantom", lambda *_: None)
    monkeypatch.setattr(speed, "open_sequence", lambda *_, **__: None)
    for found, code in (([slow, measured, measured], 0), ([slow, measured, slow], 1)):
        runs = iter(found)
        monkeypatch.setattr(speed, "_measured", lambda *_, runs=runs: next(runs))
        answer = CliRunner().invoke(app, ["bench", "speed", "--compare", str(file), "--whole"])
        assert (answer.exit_code, next(runs, None)) == (code, None)
    assert CliRunner().invoke(app, ["bench", "speed", "--whole"]).exit_code == 2


def test_the_calibration_is_measured_while_the_run_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "_CALIBRATION_PAUSE_S", 0.0)
    with speed.calibrating() as found:
        while len(found) < 3:
            pass
    count = len(found)
    assert min(found) > 0
    with speed.calibrating() as others:
        pass
    assert (len(found), len(others) >= 1) == (count, True)


@pytest.mark.parametrize("words", [("speed", "--dry-run"), ("speed", "--out", "x"), ("scared", "--frames", "5")])
def test_options_that_would_be_ignored_are_refused(words: tuple[str, ...]) -> None:
    answer = CliRunner().invoke(app, ["bench", *words])
    assert answer.exit_code == 2
    assert f"Invalid value for {words[1]}: only" in answer.output
