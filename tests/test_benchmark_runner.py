"""Running a plan: one process a row, crashes isolated, killed half-way and resumed."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from scopemap.benchmark import runner
from scopemap.benchmark.plan import Plan, read_plan
from scopemap.benchmark.result import RunResult
from scopemap.benchmark.runner import Benchmark, run_plan
from scopemap.errors import InputError

PLAN = """
title = "tiny"
settings = { "networks.flow" = "dis", "networks.perceptual" = "structure", "fusion.voxel_mm" = 2.0 }

[protocol]
align = "origin"
protocols = ["evo"]

[[sequence]]
name = "colon"
phantom = { scene = "colon", frames = 8, seed = 3, width = 160, height = 128 }
depth = "true"

[[method]]
name = "ours"

[[method]]
name = "standing still"
use = "standing-still"

[[method]]
name = "imported"
use = "import"
files = "{sequence}.txt"
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    file = tmp_path_factory.mktemp("plan") / "plan.toml"
    file.write_text(PLAN)
    return read_plan(file)


@pytest.fixture(scope="module")
def done(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> tuple[Benchmark, Path]:
    """The plan, run once without disturbance; the imported trajectory is missing."""
    out = tmp_path_factory.mktemp("out")
    return run_plan(plan, out, data=out), out


def figures(results: list[RunResult]) -> list[Any]:
    """All that two runs of a plan must share, as text: NaN is equal to itself there."""
    return [json.dumps([r.sequence, r.method, r.seed, r.status, r.error, r.figures]) for r in results]


def test_every_method_is_a_row_and_one_that_dies_says_so(done: tuple[Benchmark, Path]) -> None:
    ours, still, imported = done[0].results
    assert [row.status for row in (ours, still, imported)] == ["done", "done", "failed"]
    assert "colon.txt" in imported.error
    assert ours.figures["poses"]["tracked"] == 8
    assert 0 < ours.figure("poses", "ate_rmse_mm") < still.figure("poses", "ate_rmse_mm")
    assert math.isnan(imported.figure("poses", "ate_rmse_mm"))
    assert {"poses", "paper", "evo", "depth", "surface"} <= set(ours.figures)


def test_a_row_says_where_and_with_what_it_was_run(done: tuple[Benchmark, Path]) -> None:
    row = done[0].results[0]
    assert {"machine", "commit", "versions", "align", "key"} <= set(row.facts)
    assert row.facts["align"] == "origin"
    assert row.timing["ms_per_frame"] > row.timing["track_ms_per_frame"] > 0
    assert row.timing["peak_memory_mb"] > 100
    assert {"seconds_read", "seconds_perceive"} <= set(row.timing)


def test_every_run_keeps_its_folder(done: tuple[Benchmark, Path]) -> None:
    folder = done[1] / "runs" / "colon" / "ours"
    kept = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    assert {"entry.json", "result.json", "log.txt", "run/trajectory.tum", "run/mesh.ply", "run/depth"} <= kept


def test_what_is_done_is_not_done_again(
    plan: Plan, done: tuple[Benchmark, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "worker_command", lambda file: pytest.fail("a row was run again"))
    known: list[bool] = []
    again = run_plan(plan, done[1], data=done[1], listener=lambda entry, row, kept: known.append(kept))
    assert known == [True, True, True]
    assert figures(again.results) == figures(done[0].results)


def test_a_failed_row_is_run_again_when_asked_or_when_its_file_has_come(
    plan: Plan, done: tuple[Benchmark, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = plan.model_copy(update={"method": plan.method[2:]})
    missing = run_plan(alone, tmp_path, data=tmp_path).results
    assert run_plan(alone, tmp_path, data=tmp_path).results == missing
    (tmp_path / "colon.txt").write_bytes((done[1] / "phantoms" / "colon" / "pose.txt").read_bytes())
    monkeypatch.setattr(runner, "worker_command", lambda file: [sys.executable, "-c", "raise ValueError('once')"])
    (died,) = run_plan(alone, tmp_path, data=tmp_path).results
    assert died.error == "ValueError: once"
    monkeypatch.undo()
    assert run_plan(alone, tmp_path, data=tmp_path).results == [died]
    (row,) = run_plan(alone, tmp_path, data=tmp_path, retry=True).results
    assert row.status == "done"
    assert row.figure("poses", "ate_rmse_mm") == pytest.approx(0, abs=1e-6)
    assert math.isnan(row.figure("poses", "no such figure"))


def test_a_changed_plan_is_run_again(plan: Plan, done: tuple[Benchmark, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    changed = plan.model_copy(update={"settings": plan.settings | {"tracking.huber": 2.0}, "method": plan.method[:1]})
    monkeypatch.setattr(runner, "worker_command", lambda file: [sys.executable, "-c", "print('ran')"])
    (row,) = run_plan(changed, done[1], data=done[1]).results
    assert (row.status, row.error) == ("failed", "ended without a result")
    monkeypatch.undo()
    (again,) = run_plan(plan.model_copy(update={"method": plan.method[:1]}), done[1], data=done[1]).results
    assert figures([again]) == figures(done[0].results[:1])


@pytest.mark.parametrize(
    ("code", "error"),
    [
        ("import os; os.kill(os.getpid(), 9)", "killed by SIGKILL"),
        ("raise MemoryError('too much')", "MemoryError: too much"),
        ("import sys; sys.exit(3)", "ended with exit code 3"),
        ("import time; time.sleep(60)", "took longer than 1 s"),
    ],
)
def test_however_a_method_dies_the_others_go_on(
    code: str, error: str, plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "worker_command", lambda file: [sys.executable, "-c", code])
    rows = run_plan(plan, tmp_path, data=tmp_path, timeout_s=1 if "sleep" in code else None).results
    assert [(row.status, row.error) for row in rows] == [("failed", error)] * 3


def test_killed_half_way_and_restarted_it_gives_the_same(
    plan: Plan, done: tuple[Benchmark, Path], tmp_path: Path
) -> None:
    file, out = tmp_path / "plan.toml", tmp_path / "out"
    file.write_text(PLAN)
    start = "from scopemap.cli import main; main()"
    command = [sys.executable, "-c", start, "bench", str(file), "--out", str(out), "--data", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as bench:
        second = out / "runs" / "colon" / "standing-still" / "entry.json"
        deadline = time.monotonic() + 120
        while not second.is_file() and time.monotonic() < deadline:
            time.sleep(0.05)
        assert second.is_file()
        bench.send_signal(signal.SIGKILL)
    first = (out / "runs" / "colon" / "ours" / "result.json").read_bytes()
    assert not second.with_name("result.json").exists()
    resumed = run_plan(plan, out, data=out)
    assert (out / "runs" / "colon" / "ours" / "result.json").read_bytes() == first
    expected = [row.replace(str(done[1]), str(out)) for row in figures(done[0].results)]
    assert figures(resumed.results) == expected


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc to see whether a process is alive")
def test_a_worker_ends_when_its_benchmark_is_gone(tmp_path: Path) -> None:
    """Started with the pipe's other end closed it ends by itself, long before its work is done."""
    code = (
        "from scopemap.benchmark.worker import end_with_parent; import time; end_with_parent(); "
        "print('up', flush=True); time.sleep(60)"
    )
    worker = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert worker.stdout is not None
    assert worker.stdin is not None
    assert worker.stdout.readline() == b"up\n"
    worker.stdin.close()
    assert worker.wait(20) == -signal.SIGTERM
    assert not os.path.exists(f"/proc/{worker.pid}")


def test_a_folder_that_cannot_be_is_one_clear_line(plan: Plan, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write a benchmark to"):
        run_plan(plan, tmp_path / "file" / "out", data=tmp_path)
