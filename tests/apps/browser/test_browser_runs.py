"""Runs that the window starts: one at a time, stopped, killed, resumed; the folder that it works on."""

from __future__ import annotations

import os
import stat
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from scopemap.apps.browser import runs
from scopemap.apps.browser.runs import BrowserRun
from scopemap.apps.browser.workspace import Workspace
from scopemap.engine.errors import InputError

# In place of Python with scopemap: what the input is called says what its run does.
STAND_IN = """#!{python}
import pathlib, shutil, signal, sys, time
source, out = pathlib.Path(sys.argv[4]), pathlib.Path(sys.argv[6])
kept = out / ".unfinished" / "checkpoint.npz"
has_begun = kept.is_file()
kept.parent.mkdir(parents=True, exist_ok=True)
def stopped(*_):
    kept.write_bytes(b"")
    sys.exit(130)
signal.signal(signal.SIGINT, signal.SIG_IGN if source.stem == "long_deaf" else stopped)
print("started", flush=True)
if source.stem.startswith("long") and not has_begun:
    time.sleep(300)
if source.stem.startswith("bad"):
    print("scopemap: reading the video: it is none")
    sys.exit(1)
shutil.rmtree(out / ".unfinished")
(out / "provenance.json").write_text("{{}}")
"""


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Workspace]:
    program = tmp_path / "stand-in"
    program.write_text(STAND_IN.format(python=sys.executable))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(runs, "sys", SimpleNamespace(executable=str(program)))
    folder = tmp_path / "videos"
    folder.mkdir()
    with Workspace(folder) as made:
        yield made


def wait(workspace: Workspace, is_so: Callable[[], object]) -> None:
    end = time.monotonic() + 60
    while not is_so():
        workspace.runs.tick()
        assert time.monotonic() < end
        time.sleep(0.01)


def has_begun(run: BrowserRun) -> Callable[[], bool]:
    return lambda: "started" in run.printed


def test_runs_wait_for_each_other_and_end_as_they_end(workspace: Workspace) -> None:
    asked = [workspace.reconstruct(workspace.folder / name, []) for name in ("long.mp4", "bad.mp4", "good.mp4")]
    assert [run.status for run in asked] == ["running", "waiting", "waiting"]
    assert [workspace.runs.place(run) for run in asked] == [0, 1, 2]
    wait(workspace, has_begun(asked[0]))
    asked[0].stop()
    asked[0].stop()  # a second signal to the process would leave less
    wait(workspace, lambda: asked[2].status == "done")
    assert [run.status for run in asked] == ["stopped", "failed", "done"]
    assert asked[1].sentence == "reading the video: it is none"


def test_what_was_stopped_goes_on_and_is_made_a_result_of(workspace: Workspace) -> None:
    source = workspace.folder / "long.mp4"
    run = workspace.reconstruct(source, ["--fps=5"])
    wait(workspace, has_begun(run))
    run.stop()
    wait(workspace, lambda: run.status == "stopped")
    assert run.is_kept
    assert workspace.interrupted == []
    assert workspace.reconstruct(source, ["--fps=4"]).out != run.out, "other settings would begin anew there"
    workspace.runs.runs[-1].kill()
    part = run.finish(run.copy())
    assert part.arguments == ("--fps=5", "--finish")
    assert part.out.name == "long_so_far"
    wait(workspace, lambda: part.status == "done")
    assert run.is_kept, "it was copied"
    # To choose the video again, or to press Continue, is the same.
    assert workspace.reconstruct(source, ["--fps=5"]) is run
    wait(workspace, lambda: run.status == "done")
    assert not run.is_kept


def test_a_run_that_does_not_stop_in_time_is_ended(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    assert runs._PATIENCE_S < 10
    monkeypatch.setattr(runs, "_PATIENCE_S", 0.2)
    run = workspace.reconstruct(workspace.folder / "long_deaf.mp4", [])
    wait(workspace, has_begun(run))
    run.stop()
    wait(workspace, lambda: run.status == "stopped")
    assert not run.is_kept


def test_a_run_that_waits_is_taken_out_of_the_queue(workspace: Workspace) -> None:
    asked = [workspace.reconstruct(workspace.folder / f"{name}.mp4", []) for name in ("long", "good", "good")]
    asked[1].stop()
    assert [workspace.runs.place(run) for run in asked] == [0, 0, 1]
    assert asked[1].out != asked[2].out
    wait(workspace, has_begun(asked[0]))
    asked[0].kill()
    wait(workspace, lambda: asked[2].status == "done")
    assert [run.status for run in asked] == ["failed", "stopped", "done"]
    assert "exit code -9" in asked[0].sentence


def test_what_a_killed_run_left_is_gone_on_with(workspace: Workspace) -> None:
    source = workspace.folder / "long.mp4"
    first = workspace.reconstruct(source, ["--fps=5"])
    wait(workspace, has_begun(first))
    assert workspace.interrupted == []
    workspace.runs.close()  # the window ends
    wait(workspace, lambda: first.status == "failed")
    assert workspace.interrupted == [first.out]
    again = workspace.reconstruct(source, ["--fps=5"])
    assert (again.out, again.command) == (first.out, first.command)
    beside = workspace.reconstruct(source, [])
    assert beside.out.name == "long_2"


def test_a_name_is_never_an_option_nor_leads_out(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workspace.folder)
    assert Workspace(Path()).folder == workspace.folder
    run = workspace.reconstruct(workspace.folder / "--overwrite.mp4", [])
    assert Path(run.command.split()[2]).is_absolute()
    for name in ("...mp4", "uploads.mp4", "masks.mp4", "a b/ü?.mp4"):
        out = workspace.new_result(workspace.folder / name)
        assert out.parent == workspace.results
        assert out.name not in ("..", "uploads", "masks")


def test_only_what_is_in_the_folder_is_opened(workspace: Workspace, tmp_path: Path) -> None:
    folder, secret = workspace.folder, tmp_path / "secret.mp4"
    secret.write_bytes(b"x")
    (folder / "sub").mkdir()
    (folder / "sub" / "in.mp4").write_bytes(b"x")
    (folder / "link.mp4").symlink_to(secret)
    (folder / "out").symlink_to(tmp_path)
    assert workspace.inside("sub/in.mp4").samefile(folder / "sub" / "in.mp4")
    for name in ("../secret.mp4", str(secret), "link.mp4", "out/secret.mp4", "/etc/passwd", "sub/../../secret.mp4"):
        with pytest.raises(InputError, match="is not in"):
            workspace.inside(name)
    with pytest.raises(InputError, match=r"there is no none\.mp4"):
        workspace.inside("none.mp4")
    for name in ("a\0b", "x" * 5000):
        with pytest.raises(InputError, match="cannot look for"):
            workspace.inside(name)
    assert workspace.videos == []


def test_videos_and_folders_of_images_are_listed(workspace: Workspace) -> None:
    folder = workspace.folder
    for name in ("b.mp4", "a.MKV", "notes.txt"):
        (folder / name).write_bytes(b"x")
    for name, file in (("images", "0001.png"), ("texts", "a.txt"), ("result", "provenance.json")):
        (folder / name).mkdir()
        (folder / name / file).write_bytes(b"{")
    (folder / "result" / "0001.png").write_bytes(b"x")
    assert [path.name for path in workspace.videos] == ["a.MKV", "b.mp4", "images"]
    assert workspace.finished == [], "one that is damaged"
    if os.getuid():
        (folder / "images").chmod(0)
        assert [path.name for path in workspace.videos] == ["a.MKV", "b.mp4"]
        (folder / "images").chmod(0o700)
