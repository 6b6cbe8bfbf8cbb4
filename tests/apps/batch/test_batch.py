"""`scopemap batch`: the same results as single runs, whatever fails, dies or is done in parts."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import scopemap.apps.batch.command as batch_command
from scopemap.apps.batch.batch import folder_names
from scopemap.apps.batch.command import videos_of
from scopemap.input.inputs import named_inputs
from scopemap.report.batch_page import BatchRow, write_batch_page
from tests.support.front_door import call, refused
from tests.support.result_files import batch_rows, compared_files
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

QUICK = ["--set", "mapping.triangulate_depth=false"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three phantoms, and a video that is none."""
    folder = tmp_path_factory.mktemp("archive")
    for number in range(3):
        write_tiny(folder / f"colon {number}", frames=4 + number)
    (folder / "poisoned.mp4").write_bytes(b"\0" * 1000)
    return folder


@pytest.fixture(scope="module")
def done(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, list[int]]:
    """A batch by two processes of which one is killed in the middle of a run; its exit code; whom it was."""
    out, killed = tmp_path_factory.mktemp("done") / "out", list[int]()
    watcher = threading.Thread(target=_kill_first, args=(out, killed), daemon=True)
    watcher.start()
    code = call("batch", folder, "--out", out, "--workers", 2, "--quiet", *QUICK)
    watcher.join(5)
    return out, code, killed


def _kill_first(out: Path, killed: list[int]) -> None:
    """Kill the process that first begins to write a result."""
    until = time.monotonic() + 120
    while not killed and time.monotonic() < until:
        for lock in out.glob("*/.unfinished/process"):
            if (pid := lock.read_text().split()[:1]) and not killed:
                killed.append(int(pid[0]))
                os.kill(killed[0], signal.SIGKILL)
        time.sleep(0.005)


def test_results_are_those_of_single_runs_and_failures_are_named(
    folder: Path, done: tuple[Path, int, list[int]], tmp_path: Path
) -> None:
    out, code, killed = done
    assert (code, len(killed)) == (1, 1)
    rows = batch_rows(out / "batch.csv")
    assert {name: row["status"] for name, row in rows.items()} == {
        **{f"colon_{number}": "done" for number in range(3)},
        "poisoned": "failed",
    }
    assert "reading the video" in rows["poisoned"]["reason"]
    assert [rows[f"colon_{number}"]["frames"] for number in range(3)] == ["4", "5", "6"]
    single = tmp_path / "single"
    assert call("run", folder / "colon 0", "--out", single, "--quiet", *QUICK) == 0
    expected, found = compared_files(single), compared_files(out / "colon_0")
    assert sorted(found) == sorted(expected)
    assert [name for name in expected if found[name] != expected[name]] == []
    assert (out / "colon_0" / "report.html").stat().st_size > 10_000


def test_a_part_is_every_nth_video_with_a_table_of_its_own(folder: Path, tmp_path: Path) -> None:
    inputs = "".join(f"{folder}/colon {number},\n" for number in range(3))
    (tmp_path / "table.csv").write_text(f"input,tracking.keyframe_every\n{inputs}")
    asked = ("batch", tmp_path / "table.csv", "--out", tmp_path / "out", "--quiet", *QUICK)
    assert call(*asked, "--part", "2/3") == 0
    assert list(batch_rows(tmp_path / "out" / "batch-2-of-3.csv")) == ["colon_1"]
    rows = batch_rows(tmp_path / "out" / "batch.csv")
    assert {name: row["status"] for name, row in rows.items()} == {
        **{"colon_0": "waiting", "colon_1": "done", "colon_2": "waiting"}
    }


def test_two_parts_at_once_give_one_table(folder: Path, tmp_path: Path) -> None:
    """As two jobs of an array; the part that ends last writes the rows of both."""
    words = ["batch", str(folder / "colon*"), "--out", str(tmp_path / "out"), "--workers", "1", "--quiet", *QUICK]
    command = [sys.executable, "-m", "scopemap", *words]
    jobs = [subprocess.Popen([*command, "--part", f"{number}/2"]) for number in (1, 2)]
    assert [job.wait() for job in jobs] == [0, 0]
    shares = [list(batch_rows(tmp_path / "out" / f"batch-{number}-of-2.csv")) for number in (1, 2)]
    assert shares == [["colon_0", "colon_2"], ["colon_1"]]
    rows = batch_rows(tmp_path / "out" / "batch.csv")
    assert [(name, row["status"]) for name, row in rows.items()] == [(f"colon_{number}", "done") for number in range(3)]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("colon_*/**/*")}
    assert call(*words) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("colon_*/**/*")} == before


def test_a_restart_does_nothing_twice(folder: Path, done: tuple[Path, int, list[int]]) -> None:
    out = done[0]
    before = {path: path.stat().st_mtime_ns for path in out.glob("colon_*/**/*")}
    assert call("batch", folder / "colon*", "--out", out, "--workers", 2, "--quiet", *QUICK) == 0
    assert {path: path.stat().st_mtime_ns for path in out.glob("colon_*/**/*")} == before
    assert sorted(batch_rows(out / "batch.csv")) == ["colon_0", "colon_1", "colon_2", "poisoned"]


def test_other_settings_do_not_pass_for_the_same(
    folder: Path, done: tuple[Path, int, list[int]], capfd: pytest.CaptureFixture[str]
) -> None:
    out = done[0]
    before = compared_files(out / "colon_0")
    assert call("batch", folder / "colon 0", "--out", out, "--frames", "0:3", *QUICK) == 1
    assert "a result of another input or of other settings" in capfd.readouterr().err
    assert compared_files(out / "colon_0") == before
    assert call("batch", folder / "colon 0", "--out", out, "--quiet", *QUICK) == 0


def test_a_report_that_is_missing_is_written_without_another_run(
    folder: Path, done: tuple[Path, int, list[int]]
) -> None:
    """As where the process dies between the result and its report."""
    out = done[0]
    record = out / "records" / "colon_1.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"status": "started"}))
    (out / "colon_1" / "report.html").unlink()
    provenance = (out / "colon_1" / "provenance.json").stat().st_mtime_ns
    assert call("batch", folder / "colon 1", "--out", out, "--quiet", *QUICK) == 0
    assert (out / "colon_1" / "report.html").is_file()
    assert (out / "colon_1" / "provenance.json").stat().st_mtime_ns == provenance


def test_a_dry_run_estimates_and_leaves_nothing(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    capfd.readouterr()
    assert call("batch", folder, "--out", tmp_path / "out", "--dry-run", "--workers", 1, "--json", *QUICK) == 0
    found = {one["name"]: one for one in json.loads(capfd.readouterr().out)}
    assert not (tmp_path / "out").exists()
    assert [found[f"colon_{number}"]["frames"] for number in range(3)] == [4, 5, 6]
    assert found["colon_2"]["video_s"] == pytest.approx(6 / 30)
    assert found["colon_2"]["input_bytes"] == sum(p.stat().st_size for p in (folder / "colon 2").iterdir())
    assert found["colon_2"]["seconds"] > 0
    assert found["colon_2"]["result_bytes"] > 1e6
    assert "reading the video" in found["poisoned"]["fault"]


def test_folders_have_unique_names_that_every_system_takes(tmp_path: Path) -> None:
    paths = ["a/x.mp4", "b/x.mp4", "b/X.avi", "b/../c/.. ;rm -rf.mp4", "index.html", "ä b.mkv", "-out.mp4"]
    paths += ["CON/" + "l" * 300]
    (tmp_path / "list.txt").write_text("\n".join(paths) + "\n# a comment\n\na/x.mp4\n", encoding="utf-8")
    names = folder_names(named_inputs([str(tmp_path / "list.txt")]))
    assert len({name.lower() for name in names}) == len(paths)
    assert all(re.fullmatch(r"\w[\w.-]{0,95}", name) and len(name.encode()) < 255 for name in names)
    assert names[0] == "a_x"
    assert "index.html" not in names


def test_folders_of_videos_are_looked_through(tmp_path: Path) -> None:
    write_tiny(tmp_path / "deep" / "phantom", frames=2)
    for name in ("one.MP4", "deep/two.avi", "deep/notes.txt", ".hidden/three.mp4", "deep/thumb.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "deep" / "up").symlink_to(tmp_path)
    found = [str(one.path.relative_to(tmp_path)) for one in named_inputs([str(tmp_path)])]
    assert found == ["deep/phantom", "deep/two.avi", "one.MP4"]
    assert [one.path.name for one in named_inputs([str(tmp_path / "**" / "*.avi")])] == ["two.avi"]
    assert [one.path.name for one in named_inputs([str(tmp_path / "gone.mp4")])] == ["gone.mp4"]


def test_a_table_sets_what_is_the_videos_own(tmp_path: Path) -> None:
    table = (
        "input,name,frames,fov,preset,tracking.keyframe_every\na.mp4,first,0:10,,realtime,3\na.mp4,second,10:20,90,,\n"
    )
    (tmp_path / "t.csv").write_text(table)
    first, second = videos_of(named_inputs([str(tmp_path / "t.csv")]), {"fov": "70"}, {"tracking.keyframe_every": 9})
    assert (first.name, first.frames, first.fov_deg) == ("first", slice(0, 10), 70.0)
    assert (first.config.preset, first.config.tracking.keyframe_every) == ("realtime", 3)
    assert (second.name, second.frames, second.fov_deg) == ("second", slice(10, 20), 90.0)
    assert (second.config.preset, second.config.tracking.keyframe_every) == ("default", 9)
    assert first.key() != second.key()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("video\na.mp4\n", "names no column 'input'"),
        ("input,speed\na.mp4,3\n", "unknown column 'speed'"),
        ("input,fov\na.mp4,wide\n", "cannot read the field of view 'wide'"),
        ("input\na.mp4,b\n", "line 2 has more cells"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused(
    text: str, said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "t.csv").write_text(text)
    assert said in refused(capfd, "batch", tmp_path / "t.csv", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_page_escapes_names_and_asks_no_network(tmp_path: Path) -> None:
    rows = [
        BatchRow("<script>alert(1)</script>.mp4", 'a"b', "done", verdict="good", sentence="a < b & c"),
        BatchRow("b", "b", "failed", "<img src=x>"),
        BatchRow("c\udcff", "c"),
    ]
    write_batch_page(rows, tmp_path / "index.html")
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert not any(words in page for words in ("<script", "<img src=x>", "http:", "https:"))
    assert 'src="a%22b/summary.png"' in page
    assert page.index("<h2>b</h2>") < page.index("<h2>a&quot;b</h2>")
    assert "3 videos: 1 waiting, 1 done, 1 failed (1 good)" in page


def test_a_pipe_is_told_what_begins_what_runs_and_what_ends(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_command, "_SECONDS_BETWEEN_LINES", 0.2)  # by default every minute
    assert call("batch", folder / "colon 0", "--out", tmp_path / "out", *QUICK) == 0
    first, *between, last = capfd.readouterr().err.splitlines()
    assert first == "colon_0: started (1 left)"
    assert re.fullmatch(r"colon_0: [a-z ]+, 4 of 4 frames, \d+ s \(0 left\)", last)
    assert between
    assert all(re.fullmatch(r"running: colon_0 for \d+ s", line) for line in between)
