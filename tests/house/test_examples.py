"""The examples run, as a reader would run them, and say what they promise."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.extras import DEV
from tests.support.places import ROOT

pytest.importorskip("nbclient", reason=DEV)

import nbformat
from nbclient import NotebookClient

from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.dev

EXAMPLES = ROOT / "examples"
PROMISED = {
    "01_reconstruct.py": r"8 of 8 frames tracked, \d+\.\d mm\nsurface: [1-9]\d* vertices, .*\nscale: .*scopenet",
    "02_evaluate.py": r"origin: ATE (0|1)\.\d+ mm.*\nse3 .*\nsim3  : ATE 0\.\d+ mm.*8 of 8 frames tracked",
    "03_depth_from_files.py": r"depth: 8 files in .* \(measured\)\n8 of 8 frames tracked\nsurface: [1-9]\d* faces",
    "05_the_paper_frame_by_frame.py": r"(frame \d: \d+\.\d mm deep, at .*\n){6}surface: [1-9]\d* faces",
    "04_ask_a_result.py": r"(?s)not seen: \d+%.*look again at .*area: .*diameter: .*\n1[0-6] of 16 frames located",
}


def _run(name: str, *arguments: object, weights: Path) -> str:
    done = _ended(name, *arguments, weights=weights)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _ended(name: str, *arguments: object, weights: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(EXAMPLES / name), *map(str, arguments)],
        env=os.environ | {"SCOPEMAP_WEIGHTS_DIR": str(weights), "HF_HUB_OFFLINE": "1"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def test_every_example_is_tested() -> None:
    assert {file.name for file in EXAMPLES.glob("*.py")} == set(PROMISED)


@pytest.mark.parametrize("name", sorted(PROMISED))
def test_example_without_arguments(name: str, tmp_path: Path) -> None:
    assert re.search(PROMISED[name], _run(name, weights=tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_examples_with_arguments(tmp_path: Path) -> None:
    phantom, run = write_tiny(tmp_path / "phantom"), tmp_path / "run"
    assert "9 of 9 frames tracked" in _run("01_reconstruct.py", phantom, run, weights=tmp_path / "none")
    assert (run / "mesh.ply").is_file()
    assert "9 of 9 frames tracked" in _run("02_evaluate.py", run, phantom, weights=tmp_path / "none")
    # A run's own depth folder is depth from files, too.
    assert "9 files" in _run("03_depth_from_files.py", phantom, run / "depth", weights=tmp_path / "none")


@pytest.mark.parametrize("name", sorted(PROMISED))
def test_an_example_that_cannot_go_on_ends_with_one_sentence(name: str, tmp_path: Path) -> None:
    ended = _ended(name, tmp_path / "none", tmp_path / "none", weights=tmp_path)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (1, "", 1), ended.stderr
    assert str(tmp_path / "none") in ended.stderr


def test_the_paper_without_weights_names_all_of_them_in_one_sentence(tmp_path: Path) -> None:
    ended = _ended("05_the_paper_frame_by_frame.py", write_tiny(tmp_path / "phantom"), weights=tmp_path / "none")
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (1, "", 1), ended.stderr
    assert ended.stderr.startswith("weights are missing: scopemap models pull LiheYoung/depth-anything-small-hf && ")


def test_the_notebook_runs_and_is_kept_without_outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    notebook = nbformat.read(EXAMPLES / "first_run.ipynb", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells)
    NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in cells for output in cell.outputs]
    assert any("data:image/jpeg;base64," in output.get("data", {}).get("text/html", "") for output in shown)
    lines = [output.get("data", {}).get("text/plain", "") for output in shown if output.output_type == "display_data"]
    assert "24 frames done" in lines  # the progress of the run, which nobody asked for
    said = "".join(output.get("text", "") for output in shown)
    assert re.search(r"24 of 24 frames, path \d+\.\d", said)
    assert re.search(r"position error 0\.\d+ mm after Sim\(3\)", said)
    assert re.search(r"[1-9]\d* vertices, [1-9]\d* faces", said)
