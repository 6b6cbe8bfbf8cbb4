"""A result that is not as its run wrote it is used with a warning, by every command that reads one."""

from __future__ import annotations

from pathlib import Path

import pytest

from scopemap.result.checksums import changed_files, write_checksums
from tests.support.drawn_run import draw_run
from tests.support.front_door import call

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("short_films")]

COMMANDS = {
    "report": ("report", "RUN"),
    "export": ("export", "RUN", "--to", "ply", "--out", "OUT/a.ply"),
    "export of a submap": ("export", "RUN/maps/1", "--to", "ply", "--out", "OUT/a.ply"),
    "turntable": ("view", "RUN", "--turntable", "OUT/a.mp4"),
    "coverage": ("coverage", "RUN", "--out", "OUT/c"),
    "measure": ("measure", "RUN", "--frame", 2, "--points", "20,20 40,40", "--reference", "30,20 48,20"),
    "evaluate": ("evaluate", "RUN", "--truth", "RUN"),
}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = draw_run(tmp_path / "run")
    write_checksums(folder)
    assert changed_files(folder) == []
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_it(command: str, run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arguments = [str(part).replace("RUN", str(run)).replace("OUT", str(tmp_path)) for part in COMMANDS[command]]
    (run / "camera.yaml").write_text((run / "camera.yaml").read_text() + "\n")
    (run / "depth" / "000003.png").unlink()
    assert call(*arguments) == 0
    said = capfd.readouterr().err
    assert "is not as its run wrote it: camera.yaml, depth/000003.png; see scopemap verify" in said


def test_of_a_large_result_the_main_files_are_looked_at(run: Path) -> None:
    (run / "mesh.ply").write_bytes((run / "mesh.ply").read_bytes() + b" ")
    (run / "depth" / "000003.png").unlink()
    assert changed_files(run) == ["mesh.ply", "depth/000003.png"]
    size = sum((run / name).stat().st_size for name in ("camera.yaml", "config.toml", "frames.csv", "mesh.ply"))
    assert changed_files(run, size) == ["mesh.ply"]


def test_a_film_is_not_replaced_unasked(run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "a.mp4"
    film.write_bytes(b"a film")
    assert call("view", run, "--turntable", film) == 1
    assert "exists; give another name" in capfd.readouterr().err
    assert film.read_bytes() == b"a film"
    assert call("view", run, "--turntable", film, "--overwrite") == 0


def test_a_pixel_without_surface_is_answered_by_the_nearest(run: Path, capfd: pytest.CaptureFixture[str]) -> None:
    # The wall of the tube fills the view; a pixel outside the picture meets none.
    assert call("measure", run, "--frame", 2, "--points", "-5,20 40,40", "--reference", "30,20 48,20") == 1
    assert "the nearest with a surface is 0,20" in capfd.readouterr().err
