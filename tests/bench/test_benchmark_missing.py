"""Rows of a benchmark that cannot run here: named before a run, "missing" in it; the exit code where none is done."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from scopemap_bench import runner
from scopemap_bench.forecast import Pace
from scopemap_bench.methods.baselines import OPEN3D_METHODS
from scopemap_bench.methods.method import BASELINES
from scopemap_bench.plan import read_plan
from scopemap_bench.runner import run_plan
from tests.support.front_door import call

NETWORKS = ("torch", "torchvision", "transformers", "safetensors", "lpips")
OF_NETWORKS = "pip install -c constraints.txt -e '.[networks]'"
OF_OPEN3D = "pip install -c constraints.txt -e './bench[baselines]'"
HEAD = """
title = "lacking"

[[sequence]]
name = "colon"
phantom = { scene = "colon", frames = 3, width = 96, height = 80 }
"""
# What each method needs beside scopemap's own packages.
NEEDS = {
    "scopemap": ("", "", ""),
    **{name: (f'use = "{name}"', "", "") for name in BASELINES},
    **{name: (f'use = "{name}"', "Open3D", OF_OPEN3D) for name in OPEN3D_METHODS},
    **{name: (f'preset = "{name}"', " and ".join(NETWORKS), OF_NETWORKS) for name in ("paper", "paper-strict")},
    "flow": ('settings = { "networks.flow" = "raft-small" }', "torch and torchvision", OF_NETWORKS),
    "distance": ('settings = { "networks.perceptual" = "lpips" }', "torch and torchvision and lpips", OF_NETWORKS),
    "pycolmap": ('use = "colmap"', "pycolmap", "pip install -c constraints.txt -e './bench[colmap]'"),
}


@pytest.fixture(autouse=True)
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without weights and without any package of an extra."""
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path / "weights"))
    for package in (*NETWORKS, "open3d", "pycolmap"):  # a module of None cannot be found
        monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setattr(runner, "measured_pace", lambda: Pace(once_s=1.0, ratio=1.0))


def plan_file(folder: Path, *methods: str) -> Path:
    file = folder / "plan.toml"
    file.write_text(HEAD + "".join(f'[[method]]\nname = "{name}"\n{NEEDS[name][0]}\n' for name in methods))
    return file


def test_every_package_that_a_method_needs_is_named_before_a_run(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert call("bench", plan_file(tmp_path, *NEEDS), "--dry-run") == 0
    said = capfd.readouterr().out
    rows = dict(line.strip().split(": ", 1) for line in said.partition("rows:\n")[2].splitlines() if line[:2] == "  ")
    assert set(rows) == set(NEEDS)
    for name, (_, packages, command) in NEEDS.items():
        assert rows[name].startswith(f"needs {packages}: {command}") if packages else "needs" not in rows[name], name
    without = sum(not packages for _, packages, _ in NEEDS.values())
    assert f"{len(NEEDS)} runs: 0 done, {len(NEEDS) - without} missing, {without} to run in about " in said
    assert "needs weights: raft-small (scopemap models pull NAME)" in rows["flow"]


def test_the_measure_of_a_plan_needs_packages_too(tmp_path: Path) -> None:
    plan = read_plan(plan_file(tmp_path, "scopemap"))
    protocol = plan.protocol.model_copy(update={"consistency": True, "flow": "raft-small"})
    (row,) = run_plan(plan.model_copy(update={"protocol": protocol}), tmp_path / "out").results
    assert row.status == "missing"
    assert row.error.startswith(f"its measure needs torch and torchvision: {OF_NETWORKS}; needs weights: raft-small")


def test_a_row_without_its_packages_is_missing_and_no_process_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "worker_command", lambda file: pytest.fail("a row without its packages was run"))
    lacking = [name for name, (_, packages, _) in NEEDS.items() if packages]
    rows = run_plan(read_plan(plan_file(tmp_path, *lacking)), tmp_path / "out").results
    assert {row.method: row.status for row in rows} == dict.fromkeys(lacking, "missing")
    assert all(NEEDS[row.method][2] in row.error for row in rows)


@pytest.mark.parametrize(
    ("methods", "found", "reason"),
    [
        (("scopemap",), "1 failed", "scopemap: it broke"),
        (("park", "paper"), "2 missing", f"park: needs Open3D: {NEEDS['park'][2]}"),
        (("park", "scopemap"), "1 missing and 1 failed", "park: needs Open3D: "),
    ],
)
def test_a_plan_of_which_no_row_is_done_ends_with_one_sentence_and_code_1(
    methods: tuple[str, ...],
    found: str,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(runner, "worker_command", lambda file: [sys.executable, "-c", "raise SystemExit('it broke')"])
    out = tmp_path / "out"
    assert call("bench", plan_file(tmp_path, *methods), "--out", out, "--json") == 1
    said = capfd.readouterr()
    assert said.err.startswith(f"scopemap: no row is done ({found}); the first, colon by {reason}")
    assert said.err.count("\n") == 1
    assert [row["method"] for row in json.loads(said.out)] == list(methods)
    assert (out / "tables" / "overview.csv").is_file()
    assert "needs" in (out / "results.md").read_text() or "it broke" in (out / "results.md").read_text()


def test_a_plan_with_a_row_that_is_done_ends_with_code_0(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = "import json, sys; from pathlib import Path; row = {'sequence': 'colon', 'method': 'scopemap'}; "
    work += "Path(sys.argv[1]).with_name('result.json').write_text(json.dumps(row))"
    monkeypatch.setattr(runner, "worker_command", lambda file: [sys.executable, "-c", work, str(file)])
    assert call("bench", plan_file(tmp_path, "park", "scopemap"), "--out", tmp_path / "out", "--quiet") == 0
