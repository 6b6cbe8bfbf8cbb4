"""The processor time of a run's stages is measured."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from typer.testing import CliRunner

from scopemap import Config
from scopemap.cli.app import app
from scopemap_bench import speed
from scopemap_bench.speed import STAGES, Speed, resolved, timed_runs
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow


def _functions() -> list[Callable[..., Any]]:
    owners = [resolved(place) for places in STAGES.values() for place in places]
    return [getattr(owner, name) for owner, name in owners]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Speed:
    before = _functions()
    folder = tmp_path_factory.mktemp("speed")
    write_tiny(folder / "tiny")
    with timed_runs("tiny", slice(2, 8), Config(), folder) as run:
        found = run()
    assert _functions() == before
    return found


def test_every_frame_of_a_run_is_measured_stage_by_stage(measured: Speed) -> None:
    assert (measured.video, measured.selection, measured.clip) == ("tiny", "2:8", "tiny 2:8")
    assert (measured.frames, measured.size) == (6, (160, 128))
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


@pytest.mark.parametrize("words", [("speed", "--dry-run"), ("speed", "--out", "x"), ("scared", "--frames", "0:5")])
def test_options_that_would_be_ignored_are_refused(words: tuple[str, ...]) -> None:
    answer = CliRunner().invoke(app, ["bench", *words])
    assert answer.exit_code == 2
    assert f"Invalid value for {words[1]}: only" in answer.output
