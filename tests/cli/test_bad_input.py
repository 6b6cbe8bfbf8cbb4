"""Bad input by the front door: one sentence and exit code 1, or what is readable and a warning; the rest is left alone.

Here is what needs the whole way, or no reader of its own. Elsewhere: files cut off, empty, of text, of another size,
numbers missing, twice or out of order, poses of NaN and left-handed, depth of 8 bit, in every data set's layout
(test_planted_faults); what means harm (test_hostile_input); names without numbers (test_datasets); options (test_cli);
an earlier run, and what else lies in an output folder (test_reconstruction, test_refusals).
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
import trimesh

from scopemap.engine.errors import ScopemapError
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.opening import open_sequence
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.datasets.survey import survey
from tests.support.drawn_datasets import WRITERS, read_all
from tests.support.drawn_inputs import picture, save, write_video
from tests.support.front_door import call, refused
from tests.support.tiny_phantom import FRAMES, write_tiny

pytestmark = pytest.mark.slow

Capture = pytest.CaptureFixture[str]
LONG = "a folder with spaces, äöü 中文 and a long name " + "x" * 40
NOBODY = 65534


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "sound")


# ---- files that are not what their names say


def test_content_decides_not_names(tmp_path: Path) -> None:
    """A PNG named JPG among others is read, a video named PNG too; among pictures that video is left out."""
    for number in range(4):
        save(tmp_path / f"{number}.png", picture(number))
    (tmp_path / "1.png").rename(tmp_path / "1.jpg")
    assert [frame.index for frame in open_sequence(tmp_path).frames()] == [0, 1, 2, 3]
    video = write_video(tmp_path / "clip.mp4", 5).rename(tmp_path / "2.png")
    assert len(list(open_sequence(video).frames())) == 5
    sequence = open_sequence(tmp_path)
    assert [frame.index for frame in sequence.frames()] == [0, 1, 3]
    assert "2.png cannot be read and was left out" in sequence.warnings[0]


# ---- folders that may not be read, and that lead in circles


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that everyone can come to: that of the tests belongs to who runs them."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    for inner in [folder, *folder.rglob("*")]:
        if inner.is_dir() and not inner.is_symlink():
            inner.chmod(0o755)
    shutil.rmtree(folder)


def _as_nobody(act: Callable[[], str]) -> str:
    """Who may do everything is told nothing: root acts as someone else."""
    root = os.geteuid() == 0
    if root:
        os.setresuid(NOBODY, NOBODY, 0)
    try:
        return act()
    finally:
        if root:
            os.setresuid(0, 0, 0)


def _outcome(path: Path) -> str:
    """The sentence by which reading ends, "" where all can be read."""
    try:
        read_all(path)
    except ScopemapError as error:
        return str(error)
    return ""


@pytest.mark.skipif(not hasattr(os, "setresuid"), reason="permissions are taken away as on Linux")
@pytest.mark.parametrize("name", sorted(WRITERS))
def test_no_permission_is_a_sentence(name: str, open_folder: Path) -> None:
    entry = WRITERS[name](open_folder / "input")
    read_all(entry)  # what is imported late is imported now
    folders = [entry if entry.is_dir() else entry.parent, *(f for f in entry.rglob("*") if f.is_dir())]
    files = {(file.parent, file.suffix): file for file in entry.rglob("*") if file.is_file()}
    files |= {} if entry.is_dir() else {(entry.parent, ""): entry}
    for path in (*folders, *files.values()):
        before = path.stat().st_mode
        # A folder that may be entered and not listed still gives a file that is named.
        modes = (0o000,) if path.is_file() else (0o000, 0o444, 0o111) if entry.is_dir() else (0o000, 0o444)
        for mode in modes:
            path.chmod(mode)
            outcome = _as_nobody(lambda: _outcome(entry))
            path.chmod(before)
            assert "\n" not in outcome
            assert outcome or path.is_file(), f"{path.name} without permission ({mode:o}) went unnoticed"


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_links_in_a_circle_change_nothing(name: str, tmp_path: Path) -> None:
    entry = WRITERS[name](tmp_path / "input")
    found = [frame.index for frame in open_sequence(entry).frames()]
    for folder in [entry if entry.is_dir() else entry.parent, *(f for f in entry.rglob("*") if f.is_dir())]:
        (folder / "loop").symlink_to(".")
        (folder / "there").symlink_to("back")
        (folder / "back").symlink_to("there")
    assert [frame.index for frame in open_sequence(entry).frames()] == found
    survey(open_sequence(entry))


def test_a_path_in_a_circle_or_too_long_is_a_sentence(capfd: Capture, tmp_path: Path) -> None:
    (tmp_path / "there.mp4").symlink_to("back.mp4")
    (tmp_path / "back.mp4").symlink_to("there.mp4")
    for path in (tmp_path / "there.mp4", tmp_path / ("x" * 300), Path("/".join(["y" * 200] * 30))):
        assert "scopemap: reading" in refused(capfd, "run", path, "--out", tmp_path / "out", "--quiet")
        assert "scopemap: " in refused(capfd, "evaluate", path, "--truth", path)
        assert "scopemap: " in refused(capfd, "datasets", "check", path, "--quiet")


# ---- paths, and folders to write to


def _tree(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_a_run_on_paths_with_spaces_other_alphabets_and_300_characters(
    phantom: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    base = tmp_path / LONG / LONG / LONG
    source = base / "in"
    source.parent.mkdir(parents=True)
    shutil.copytree(phantom, source)
    out = base / "out"
    assert len(str(out)) > 300
    arguments = (source, "--out", out, "--depth", f"files:{source}", "--camera", source / "camera.yaml", "--quiet")
    assert call("run", *arguments) == 0, capfd.readouterr().err
    assert len(read_trajectory(out)) == FRAMES
    assert len(trimesh.load(out / "mesh.ply").faces) > 100
    assert len(trimesh.load(out / "mesh.glb", force="mesh").faces) > 100
    assert read_calibration(out / "camera.yaml", (160, 128)).camera.width == 160
    assert len(list((out / "depth").glob("*.png"))) == FRAMES
    assert call("evaluate", out, "--truth", source) == 0
    assert call("datasets", "check", source) == 0


@pytest.mark.skipif(not hasattr(os, "setresuid"), reason="permissions are taken away as on Linux")
def test_an_output_folder_that_is_read_only_is_a_sentence(
    phantom: Path, open_folder: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(phantom, open_folder / "in")
    (open_folder / "out").mkdir()
    (open_folder / "out").chmod(0o555)
    arguments = ("--depth", f"files:{open_folder / 'in'}", "--quiet", "--frames", "0:3")
    assert call("run", open_folder / "in", "--out", open_folder / "warm", *arguments) == 0
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(open_folder / "weights"))
    for out in ("out", "out/new", "in/0000_color.png", "in/0000_color.png/new"):
        ask = ("run", open_folder / "in", "--out", open_folder / out, *arguments)
        assert "cannot write" in _as_nobody(partial(refused, capfd, *ask))
    (open_folder / "weights").mkdir(mode=0o000)
    assert "cannot read the record of pulled weights" in _as_nobody(partial(refused, capfd, "models", "list"))


def test_an_output_folder_that_holds_something_else_is_kept(phantom: Path, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "mine"
    (out / "depth").mkdir(parents=True)
    for name in ("thesis.txt", "depth/thesis.png", "camera.yaml", "config.toml"):
        (out / name).write_text("mine")
    before = _tree(out)
    arguments = ("run", phantom, "--out", out, "--depth", f"files:{phantom}", "--frames", "0:3", "--quiet")
    assert "not empty" in refused(capfd, *arguments)
    assert _tree(out) == before
    call(*arguments, "--overwrite")
    kept = _tree(out)
    assert kept["thesis.txt"] == kept["depth/thesis.png"] == b"mine"


def test_the_input_is_never_the_output(
    phantom: Path, tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = Path(shutil.copytree(phantom, tmp_path / "sets" / "in"))
    before = _tree(tmp_path)
    monkeypatch.chdir(source)
    for place, *extra in ((".",), (".", "--overwrite"), ("..", "--overwrite")):
        refused(capfd, "run", source, "--out", place, "--depth", f"files:{source}", "--quiet", *extra)
    assert _tree(tmp_path) == before
