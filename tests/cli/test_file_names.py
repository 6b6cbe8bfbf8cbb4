"""Names, streams and files as other systems have them: letters beyond ASCII, a narrow code page, no file locks."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from scopemap.result import result_folder
from scopemap.result.depth_maps import DepthReader
from tests.support.front_door import call
from tests.support.places import ROOT
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

SOURCE = ROOT / "src" / "scopemap"
NAME = "Jörg, 内視鏡 №1"
"""Of a folder: with letters that no single code page of Windows has."""


def test_opencv_opens_no_file_by_its_name() -> None:
    """On Windows it takes names of the code page alone."""
    by_name = re.compile(r"cv2\.(?:imread|imwrite|imreadmulti|VideoWriter|FileStorage\((?![^)]*MEMORY))")
    assert [file.name for file in SOURCE.rglob("*.py") if by_name.search(file.read_text(encoding="utf-8"))] == []


def test_a_folder_with_any_letters_is_read_and_written(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / NAME
    phantom, run = write_tiny(folder / "phantom"), folder / "Ergebnis ü"
    assert call("run", phantom, "--out", run, "--camera", phantom / "camera.yaml", "--quiet") == 0
    assert call("report", run) == 0
    assert call("export", run, "--to", "colmap", "--out", folder / "→", "--quiet") == 0
    capfd.readouterr()
    assert call("evaluate", run, "--truth", phantom, "--json") == 0
    assert json.loads(capfd.readouterr().out)["tracked"] == 9
    assert DepthReader(run).read(0) is not None
    assert (folder / "→/images/000000.png").stat().st_size > 0
    assert json.loads((run / "provenance.json").read_text(encoding="utf-8"))["input"] == str(phantom)


def test_a_narrow_code_page_stops_no_command(tmp_path: Path) -> None:
    phantom = write_tiny(tmp_path / NAME, frames=3)
    for arguments in (["datasets", "check", str(phantom)], ["models", "list"], ["run", "--help"], ["bench"]):
        done = subprocess.run(
            [sys.executable, "-m", "scopemap", *arguments],
            env=os.environ | {"PYTHONIOENCODING": "cp1252:strict", "SCOPEMAP_WEIGHTS_DIR": str(tmp_path)},
            capture_output=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert b"Traceback" not in done.stderr


def test_without_locks_no_file_stays_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An open file cannot be removed on Windows, and its folder would stay behind."""
    monkeypatch.setattr(result_folder, "fcntl", None)
    opened = []
    real = result_folder._lock
    monkeypatch.setattr(result_folder, "_lock", lambda folder: opened.append(real(folder)) or opened[-1])
    with result_folder.result_folder(tmp_path / "out", overwrite=False) as folder:
        assert folder is not None
        assert [lock.closed for lock in opened] == [True]
        (folder / "provenance.json").write_text("{}", encoding="utf-8")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["provenance.json"]
