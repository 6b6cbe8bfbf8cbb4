"""Running a plan: one process a row, crashes isolated, killed half-way and resumed."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scopemap_bench import runner
from scopemap_bench.entry import Entry
from scopemap_bench.plan import Plan, read_plan
from scopemap_bench.result import RunResult
from scopemap_bench.runner import Benchmark, run_plan

pytestmark = pytest.mark.slow

PLAN = """
title = "tiny"
settings = { "networks.flow" = "dis", "networks.perceptual" = "structure", "fusion.voxel_mm" = 2.0 }

[protocol]
align = "origin"
protocols = ["evo"]
contradiction = true

[[sequence]]
name = "colon"
phantom = { scene = "colon", frames = 6, seed = 3, width = 160, height = 128 }
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


# A worker that leaves a row: it imports nothing, so it takes no time.
FINISHES = """
import json, os, sys, time
from pathlib import Path

def wait(folder):
    from scopemap_bench.runner import end_with_parent
    end_with_parent()
    Path(folder, "draft").write_text(str(os.getpid()))
    Path(folder, "draft").rename(Path(folder, "pid"))
    time.sleep(60)

entry, key = Path(sys.argv[1]), sys.argv[2]
method = json.loads(entry.read_text())["method"]["name"]
# the work
row = {"sequence": "colon", "method": method, "figures": {"poses": {"ate_rmse_mm": 1.5}}, "facts": {"key": key}}
entry.with_name("result.json").write_text(json.dumps(row))
"""


def command(code: str) -> Callable[[Path], list[str]]:
    """What runs `code` instead of a method."""
    return lambda file: [sys.executable, "-c", code, str(file), Entry.load(file).key]


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
    assert [row.status for row in (ours, still, imported)] == ["done", "done", "missing"]
    assert imported.error == "not supplied: colon.txt"
    assert ours.figures["poses"]["tracked"] == 6
    assert 0 < ours.figure("poses", "ate_rmse_mm") < still.figure("poses", "ate_rmse_mm")
    assert ours.figure("poses", "frames_until_contradicted") == 6
    assert math.isnan(imported.figure("poses", "ate_rmse_mm"))
    assert {"poses", "paper", "evo", "depth", "surface"} <= set(ours.figures)
    assert {"machine", "commit", "versions", "align", "key"} <= set(ours.facts)
    assert ours.timing["ms_per_frame"] > ours.timing["track_ms_per_frame"] > 0
    folder = done[1] / "runs" / "colon" / "ours"
    kept = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    assert {"entry.json", "result.json", "log.txt", "run/trajectory.tum", "run/mesh.ply", "run/depth"} <= kept


def test_what_is_done_is_not_done_again(
    plan: Plan, done: tuple[Benchmark, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "worker_command", lambda file: pytest.fail("a row was run again"))
    known: list[bool] = []
    again = run_plan(plan, done[1], data=done[1], listener=lambda entry, row, kept: known.append(kept))
    assert known == [True, True, False], "what is missing is looked for again"
    assert figures(again.results) == figures(done[0].results)


def test_failed_and_changed_rows_are_run_again(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = plan.model_copy(update={"method": plan.method[2:]})
    (tmp_path / "colon.txt").write_text("")

    def run(code: str, changed: Plan = alone, **options: Any) -> RunResult:
        monkeypatch.setattr(runner, "worker_command", command(code))
        return run_plan(changed, tmp_path, data=tmp_path, **options).results[0]

    died = run("raise ValueError('once')")
    assert (died.status, died.error) == ("failed", "ValueError: once")
    assert run(FINISHES) == died
    assert run(FINISHES, retry=True).figure("poses", "ate_rmse_mm") == 1.5
    assert run("raise ValueError('again')").status == "done"
    (tmp_path / "colon.txt").write_text("a file that the plan names")
    assert run("print('ran')").error == "ended without a result"
    (tmp_path / "camera.yaml").write_text("a calibration beside the frames")
    assert run(FINISHES).status == "done"
    other = alone.model_copy(update={"settings": alone.settings | {"fusion.enabled": False}})
    assert run(FINISHES, other).status == "done"


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
    monkeypatch.setattr(runner, "worker_command", command(code))
    (tmp_path / "colon.txt").write_text("")
    rows = run_plan(plan, tmp_path, data=tmp_path, timeout_s=1 if "sleep" in code else None).results
    assert [(row.status, row.error) for row in rows] == [("failed", error)] * 3


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc to see whether a process is alive")
def test_killed_half_way_it_continues_and_no_worker_stays(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plan.toml").write_text(PLAN)
    work, out = FINISHES.replace("# the work", f"if method != 'ours': wait({str(tmp_path)!r})"), tmp_path / "out"
    out.mkdir()
    (out / "colon.txt").write_text("")
    start = (
        "import sys; from pathlib import Path; from scopemap_bench import runner, plan; "
        "command = lambda file, code: [sys.executable, '-c', code, str(file), runner.Entry.load(file).key]; "
        f"runner.worker_command = lambda file: command(file, {work!r}); "
        f"runner.run_plan(plan.read_plan({str(tmp_path / 'plan.toml')!r}), Path({str(out)!r}), data=Path({str(out)!r}))"
    )
    with subprocess.Popen([sys.executable, "-c", start]) as bench:
        waiting = _eventually(lambda: (tmp_path / "pid").is_file())
        bench.send_signal(signal.SIGKILL)
    assert waiting
    process = Path("/proc") / (tmp_path / "pid").read_text()
    assert _eventually(lambda: not process.exists() or "zombie" in (process / "status").read_text())
    assert not (out / "runs" / "colon" / "standing-still" / "result.json").exists()
    monkeypatch.setattr(runner, "worker_command", command(FINISHES))
    kept: list[bool] = []
    resumed = run_plan(plan, out, data=out, listener=lambda entry, row, known: kept.append(known))
    assert kept == [True, False, False]
    assert {row.status for row in resumed.results} == {"done"}


def _eventually(condition: Callable[[], bool], within_s: float = 60.0) -> bool:
    deadline = time.monotonic() + within_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.05)
    return condition()
