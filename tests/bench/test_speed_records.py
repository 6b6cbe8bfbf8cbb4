"""Measurements of the speed of clips: kept, measured again, compared."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from scopemap.cli.app import app
from scopemap.engine.errors import InputError
from scopemap_bench import speed_records
from scopemap_bench.cli import speed as command
from scopemap_bench.speed import Speed, StageTime
from scopemap_bench.speed_records import as_json, read_speeds

STAGES = {
    "masks": StageTime(ms=20.0, ratio=2.0, share=0.2, thread="preprocess"),
    "fusion": StageTime(ms=80.0, ratio=8.0, share=0.8, thread="main"),
}
PHANTOM = Speed(None, "", 60, "default", (320, 256), 10.0, 200.0, 150.0, STAGES)
CLIP = replace(PHANTOM, video="clips/colon.mp4", selection="30:90", preset="realtime")


def _kept(file: Path, *speeds: Speed) -> Path:
    file.write_text(json.dumps(as_json(speeds)), encoding="utf-8")
    return file


def _words(*words: object) -> Result:
    return CliRunner().invoke(app, ["bench", "speed", *map(str, words)])


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> dict[str | None, list[Speed]]:
    """Return what runs of each video are to find, the next one first; what was asked for is under "asked"."""
    planned: dict[str | None, list[Any]] = {None: [], "clips/colon.mp4": [], "asked": []}

    @contextmanager
    def timed_runs(video: str | None, *asked: object) -> Iterator[Callable[[], Speed]]:
        planned["asked"].append((video, *asked[:1], asked[1].preset, *asked[2:]))  # type: ignore[attr-defined]
        yield lambda: planned[video].pop(0)

    monkeypatch.setattr(speed_records, "timed_runs", timed_runs)
    monkeypatch.setattr(command, "timed_runs", timed_runs)
    return planned


def _folder(tmp_path: Path) -> Path:
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips/colon.mp4").touch()
    return tmp_path


def test_measurements_are_kept(tmp_path: Path) -> None:
    file = _kept(tmp_path / "speed.json", PHANTOM, CLIP)
    assert read_speeds(file) == [PHANTOM, CLIP]
    assert [speed.clip for speed in read_speeds(file)] == ["phantom", "colon.mp4 30:90"]
    for text in ('{"video": 3}', "3", "[3]", "[]", '[{"stages": {}, "size": [1, 2]}]'):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="measurements"):
            read_speeds(file)


def test_slower_stages_are_named() -> None:
    assert CLIP.slower_than(CLIP, 0.25) == []
    slower = replace(CLIP, stages=STAGES | {"masks": replace(STAGES["masks"], ratio=3.0)})
    assert [line.partition(":")[0] for line in slower.slower_than(CLIP, 0.25)] == ["masks"]
    assert CLIP.slower_than(slower, 0.25) == []
    whole = replace(CLIP, cpu_ms=2 * CLIP.cpu_ms)
    assert [line.partition(":")[0] for line in whole.slower_than(CLIP, 0.25)] == ["whole process"]
    assert slower.slower_than(CLIP, 0.25, whole=True) == []
    assert len(whole.slower_than(CLIP, 0.25, whole=True)) == 1
    unknown = replace(CLIP, stages={"fusion": STAGES["fusion"]})
    assert CLIP.slower_than(unknown, 0.25)[0].startswith("masks: ")
    with pytest.raises(InputError, match="with 59 frames of colon"):
        CLIP.slower_than(replace(CLIP, frames=59), 0.25)


def test_a_clip_is_measured_and_printed(runs: dict[str | None, list[Any]], tmp_path: Path) -> None:
    runs["clips/colon.mp4"] = [CLIP, CLIP]
    words = ("clips/colon.mp4", "--frames", "30:90", "--preset", "realtime", "--data", tmp_path)
    assert "fusion" in _words(*words).stdout
    assert json.loads(_words(*words, "--json").stdout) == as_json([CLIP])
    assert runs["asked"] == 2 * [("clips/colon.mp4", slice(30, 90), "realtime", tmp_path)]


def test_all_clips_of_a_file_are_measured_again(runs: dict[str | None, list[Any]], tmp_path: Path) -> None:
    file, data = _kept(tmp_path / "speed.json", PHANTOM, CLIP), _folder(tmp_path)
    slow = replace(CLIP, stages=STAGES | {"masks": replace(STAGES["masks"], ratio=3.0)})
    runs[None], runs["clips/colon.mp4"] = [PHANTOM, PHANTOM], [CLIP, slow]
    same = _words("--compare", file, "--data", data)
    assert (same.exit_code, same.stderr) == (0, "")
    assert "phantom, colon.mp4 30:90: no stage is more than 10% slower" in same.stdout
    assert runs["asked"] == [
        (None, slice(None), "default", data),
        ("clips/colon.mp4", slice(30, 90), "realtime", data),
    ]
    slower = _words("--compare", file, "--data", data, "--json")
    assert slower.exit_code == 1
    assert slower.stderr == "slower: colon.mp4 30:90: masks: 3.00 of the calibration, before 2.00\n"
    assert json.loads(slower.stdout) == as_json([PHANTOM, slow])


def test_what_is_not_here_is_named_and_left_out(runs: dict[str | None, list[Any]], tmp_path: Path) -> None:
    runs[None] = [PHANTOM]
    answer = _words("--compare", _kept(tmp_path / "speed.json", PHANTOM, CLIP), "--data", tmp_path)
    assert (answer.exit_code, answer.stderr) == (0, f"not compared: clips/colon.mp4 is not in {tmp_path}\n")
    assert "phantom: no stage is more" in answer.stdout
    alone = _words("--compare", _kept(tmp_path / "speed.json", CLIP))
    assert isinstance(alone.exception, InputError)
    assert "--data names another" in alone.stderr


def test_one_run_decides_unless_it_is_slower_as_a_whole(runs: dict[str | None, list[Any]], tmp_path: Path) -> None:
    file, slow = _kept(tmp_path / "speed.json", PHANTOM), replace(PHANTOM, cpu_ms=2 * PHANTOM.cpu_ms)
    for found, code in (([PHANTOM], 0), ([slow, PHANTOM, PHANTOM], 0), ([slow, PHANTOM, slow], 1)):
        runs[None] = list(found)
        answer = _words("--compare", file, "--whole")
        assert (answer.exit_code, runs[None]) == (code, [])
        assert ("slower: phantom: whole process: 40.00 of the calibration, before 20.00" in answer.stderr) == bool(code)


@pytest.mark.parametrize("words", [("--whole",), ("x.mp4", "--compare", "y"), ("--compare", "y", "--frames", "0:5")])
def test_words_that_do_not_fit_are_refused(words: tuple[str, ...]) -> None:
    assert _words(*words).exit_code == 2
