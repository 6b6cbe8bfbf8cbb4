"""The folder of a result: what may be written to and overwritten, and what a failed run leaves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from scopemap.engine.errors import InputError
from scopemap.result.result_folder import result_folder


def _make(folder: Path, *, overwrite: bool = False) -> None:
    with result_folder(folder, overwrite=overwrite) as made:
        assert made is not None
        (made / "provenance.json").write_text("{}")


def _fail(folder: Path, error: type[BaseException], *, overwrite: bool) -> None:
    with result_folder(folder, overwrite=overwrite) as made:
        assert made is not None
        (made / "depth").mkdir()
        (made / "provenance.json").write_text("half of it")
        raise error


def test_what_is_in_the_way_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="a file has that name"):
            _make(file, overwrite=overwrite)
        with pytest.raises(InputError, match="cannot write a run to"):
            _make(file / "inside", overwrite=overwrite)
    with pytest.raises(InputError, match=r"it is not empty; .*--overwrite"):
        _make(tmp_path)
    assert file.read_text() == "mine"


@pytest.mark.parametrize("error", [KeyboardInterrupt, InputError])
def test_a_run_that_fails_leaves_all_as_it_was(tmp_path: Path, error: type[BaseException]) -> None:
    _make(tmp_path / "old")
    (tmp_path / "empty").mkdir()
    for name in ("old", "new", "empty"):
        with pytest.raises(error):
            _fail(tmp_path / name, error, overwrite=name == "old")
    assert (tmp_path / "old" / "provenance.json").read_text() == "{}"
    assert [path.name for path in (tmp_path / "old").iterdir()] == ["provenance.json"]
    assert not (tmp_path / "new").exists()
    assert list((tmp_path / "empty").iterdir()) == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_a_run_that_ends_while_it_is_put_in_place_leaves_the_earlier_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def contents() -> dict[str, str]:
        return {str(file.relative_to(tmp_path)): file.read_text() for file in tmp_path.rglob("*") if file.is_file()}

    def write(folder: Path, content: str) -> None:
        (folder / "depth").mkdir()
        for name in ("depth/000000.png", "mesh.ply", f"{content}.txt", "provenance.json"):
            (folder / name).write_text(content)

    write(tmp_path, "old")
    before, replace, moves, failing = contents(), Path.replace, 0, 0

    def fail_once(self: Path, target: Path) -> Path:
        nonlocal moves
        moves += 1
        if moves == failing:
            raise error(5, "Input/output error")
        return replace(self, target)

    def overwrite() -> None:
        with result_folder(tmp_path, overwrite=True) as made:
            assert made is not None
            write(made, "new")

    monkeypatch.setattr(Path, "replace", fail_once)
    for move in range(1, 8):  # three are moved away, four come
        moves, failing = 0, move
        with pytest.raises((KeyboardInterrupt, InputError)):
            overwrite()
        assert contents() == before
    failing = 0
    overwrite()
    assert contents() == {name: "new" for name in before if name != "old.txt"} | {"old.txt": "old", "new.txt": "new"}


def test_overwrite_takes_the_place_of_a_link_and_spares_what_it_leads_to(tmp_path: Path) -> None:
    run, disk = tmp_path / "run", tmp_path / "disk"
    _make(run)
    disk.mkdir()
    (disk / "000000.png").write_text("old")
    (run / "depth").symlink_to(disk)
    with result_folder(run, overwrite=True) as made:
        assert made is not None
        (made / "depth").mkdir()
        (made / "provenance.json").write_text("{}")
    assert not (run / "depth").is_symlink()
    assert (disk / "000000.png").read_text() == "old"


_HOLD = """
import sys
from scopemap.result.result_folder import result_folder
with result_folder(sys.argv[1], overwrite=True):
    print("in it", flush=True)
    sys.stdin.readline()
"""


@pytest.mark.skipif(os.name != "posix", reason="files are locked on POSIX systems alone")
def test_a_folder_that_another_run_is_writing_is_refused_until_it_ends_or_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _HOLD, str(tmp_path)]
    for kill in (False, True):
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdin is not None
            assert other.stdout is not None
            assert other.stdout.readline() == "in it\n"
            for _ in range(2):
                with pytest.raises(InputError, match=f"process {other.pid} on .* is writing one there"):
                    _make(tmp_path, overwrite=True)
            other.kill() if kill else other.communicate("end\n")
    _make(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["provenance.json"]


def test_overwrite_spares_a_folder_that_is_no_run(tmp_path: Path) -> None:
    """A data set too may hold `camera.yaml` and `depth/`: they are its owner's."""
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "0000.png").write_text("measured")
    (tmp_path / "camera.yaml").write_text("calibrated")
    with pytest.raises(InputError):
        _make(tmp_path, overwrite=True)
    assert (tmp_path / "depth" / "0000.png").read_text() == "measured"
    assert (tmp_path / "camera.yaml").read_text() == "calibrated"
