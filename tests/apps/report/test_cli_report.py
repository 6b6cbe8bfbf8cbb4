"""`scopemap report`: the page and the picture of a finished run, made again."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.front_door import call, refused
from tests.support.tiny_phantom import FRAMES, write_tiny

pytestmark = pytest.mark.slow


def test_a_report_is_made_again_with_pictures_from_the_input(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder, out = write_tiny(tmp_path / "phantom"), tmp_path / "out"
    assert call("run", folder, "--out", out, "--depth", f"files:{folder}", "--quiet") == 0
    pictures = {file.name: file.read_bytes() for file in (out / "frames").iterdir() if file.suffix != ".csv"}
    page, summary = (out / "report.html").read_text(encoding="utf-8"), (out / "summary.png").read_bytes()
    assert len(pictures) == 2 * FRAMES
    for file in (out / "report.html", out / "summary.png", *(out / "frames").iterdir()):
        file.unlink()
    assert call("report", out) == 0
    assert str(out / "report.html") in capfd.readouterr().out
    assert {file.name: file.read_bytes() for file in (out / "frames").iterdir() if file.suffix != ".csv"} == pictures
    assert (out / "summary.png").read_bytes() == summary
    again = (out / "report.html").read_text(encoding="utf-8")
    # Only what took how long is not known any more.
    assert again.partition('"depth_range"')[2] == page.partition('"depth_range"')[2]
    assert again.partition('"ms"')[0] == page.partition('"ms"')[0]


def test_without_its_input_a_report_shows_no_frames(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder, out = write_tiny(tmp_path / "phantom", frames=3), tmp_path / "out"
    assert call("run", folder, "--out", out, "--depth", f"files:{folder}", "--quiet") == 0
    for file in (out / "frames").iterdir():
        file.unlink()
    folder.rename(tmp_path / "moved")
    assert call("report", out) == 0
    assert "the page shows no frames" in capfd.readouterr().err
    assert '"pictures": []' in (out / "report.html").read_text(encoding="utf-8")
    assert "was not found; name it with --input PATH" in refused(capfd, "report", out, "--pictures")


def test_no_run_has_no_report(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert "no finished run" in refused(capfd, "report", tmp_path)
