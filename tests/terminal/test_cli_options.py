"""Texts of the command line turned into values, and the lines of progress."""

from __future__ import annotations

import re
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from scopemap.engine.errors import SettingsError
from scopemap.report.progress_meter import ProgressMeter
from scopemap.terminal import progress
from scopemap.terminal.options import (
    parse_box,
    parse_memory,
    parse_near_far,
    parse_part,
    parse_settings,
    parse_size,
    parse_slice,
)
from scopemap.terminal.progress import run_progress


@pytest.mark.parametrize(
    ("parse", "text", "expected"),
    [
        (parse_slice, "0:100", slice(0, 100, None)),
        (parse_slice, "-50:", slice(-50, None, None)),
        (parse_slice, "5:-5:3", slice(5, -5, 3)),
        (parse_size, "320x256", (320, 256)),
        (parse_near_far, "13.5:100", (13.5, 100.0)),
        (parse_part, "3/10", (3, 10)),
        (parse_memory, "1.5G", 1500),
        (parse_box, "0,0,300,40", (0, 0, 300, 40)),
    ],
)
def test_texts_become_values(parse: Callable[[str], object], text: str, expected: object) -> None:
    assert parse(text) == expected


@pytest.mark.parametrize(
    ("parse", "words", "texts"),
    [
        (parse_slice, "START:STOP", ["9" * 23 + ":", ":" + "9" * 5000, "", "7", "a:b", "1:2:3:4", "1 : 2", "0:10:-1"]),
        (parse_size, "320x256", ["9" * 5000 + "x3", "320", "320X256", "320x-1", "x", "320x256x3"]),
        (parse_near_far, "10:100", ["13", "a:b", "1:2:3", ":"]),
        (parse_part, "K/N", ["0/3", "4/3", "1", "a/b", "1/0"]),
        (parse_memory, "2GB", ["2", "GB", "-1GB", "2TB", "9" * 5000 + "GB"]),
        (parse_box, "X,Y,WIDTH,HEIGHT", ["1,2,3", "1,2,3,x", "-1,2,3,4"]),
    ],
)
def test_other_texts_are_one_sentence(parse: Callable[[str], object], words: str, texts: list[str]) -> None:
    for text in texts:
        with pytest.raises(SettingsError, match=words) as caught:
            parse(text)
        assert len(str(caught.value)) < 300 or parse is parse_near_far


def test_settings_are_json_where_they_can_be() -> None:
    pairs = ["a=1", "b=2.5", "c=true", "d=[1, 2]", "e=dis", "f=files:/x=y", "g=", 'h="quoted"', "i=null"]
    expected = {"a": 1, "b": 2.5, "c": True, "d": [1, 2], "e": "dis", "f": "files:/x=y", "g": "", "h": "quoted"}
    assert parse_settings(pairs) == expected | {"i": None}
    assert parse_settings(["a=1", "a=2"]) == {"a": 2}
    assert isinstance(parse_settings(["c=true"])["c"], bool)


@pytest.mark.parametrize("value", ["[" * 100_000, "9" * 5000, '{"a":' * 100_000])
def test_values_that_no_parser_takes_are_a_sentence(value: str) -> None:
    with pytest.raises(SettingsError, match=r"cannot read the setting 'tracking\.levels=") as caught:
        parse_settings([f"tracking.levels={value}"])
    assert len(str(caught.value)) < 300


# ---- progress, where there is no terminal


def _step(status: str = "ok", reason: str = "", number: int = 0) -> SimpleNamespace:
    return SimpleNamespace(track=SimpleNamespace(status=status, reason=reason, map=number))


def test_lost_frames_and_those_of_other_maps_are_counted_apart(capfd: pytest.CaptureFixture[str]) -> None:
    with run_progress(6, silent=False) as (observers, _):
        for step in (_step(), _step(), _step("lost", "dark"), _step(number=1), _step(number=1), _step(number=1)):
            observers[0](step)  # type: ignore[arg-type]
    out, err = capfd.readouterr()
    assert out == ""
    line = r"frame 6 of 6: about \d+ s left, tracked \(so far 1 lost, 2 in other submaps\)"
    assert re.fullmatch(line, err.splitlines()[-1])
    with run_progress(10, silent=True) as shown:
        assert shown.observers == ()


@pytest.mark.parametrize("total", [100, None])
def test_progress_comes_now_and_then_and_preparing_takes_no_time_of_the_rest(
    total: int | None, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock.now)
    with run_progress(total, silent=False) as (observers, _):
        clock.now = 60.0
        for _ in range(21):
            observers[0](_step("lost", "too dark"))  # type: ignore[arg-type]
            clock.now += 0.5
    of, left = (" of 100", "about 90 s left, ") if total else ("", "")
    assert capfd.readouterr().err.splitlines() == [
        f"frame 1{of}: lost: too dark",
        f"frame 21{of}: {left}lost: too dark",
    ]


def test_each_phase_after_tracking_says_about_how_long_the_rest_takes(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock.now)
    meter = ProgressMeter(None)
    for _ in range(101):
        meter.add(_step())  # type: ignore[arg-type]
        clock.now += 1.0
    assert meter.time_left == ""  # their number is unknown
    clock.now -= 1.0
    # Tracking took 100 s and the rest takes about as long.
    assert meter.words("adjusting keyframes", 0, 0) == "adjusting keyframes: about 101 s left"
    clock.now += 20
    assert meter.time_left == "about 81 s left, "
    clock.now += 20  # longer than its share
    assert meter.time_left == "at least 76 s left, "
    assert meter.words("fusing", 1, 100) == "fusing frame 1 of 100: about 76 s left"
    clock.now += 10  # now by its own pace, 20 s, and a quarter of 101 s for what follows
    assert meter.words("fusing", 50, 100) == "fusing frame 50 of 100: about 35 s left"
    meter.words("fusing", 100, 100)
    for phase in ("texturing", "writing", "writing the report"):
        assert "s left" in meter.words(phase, 0, 0)
        clock.now += 1000
        assert meter.time_left.startswith("at least ")
    # Of a run that was resumed after its last frame only what is counted tells.
    resumed = ProgressMeter(100)
    resumed.words("resuming", 100, 0)
    assert resumed.words("adjusting keyframes", 0, 0) == "adjusting keyframes"
    resumed.words("fusing", 1, 100)
    clock.now += 10
    assert resumed.words("fusing", 50, 100) == "fusing frame 50 of 100: about 20 s left"
    # Nothing is known of a run that begins again.
    meter.words("tracking again, lens b", 0, 0)
    assert meter.words("preparing", 0, 0) == "preparing"
    with run_progress(3, silent=False) as (observers, tell):
        for _ in range(3):
            observers[0](_step())  # type: ignore[arg-type]
            clock.now += 30
        tell("texturing", 0, 0)
    assert capfd.readouterr().err.splitlines()[-1] == "texturing: about 22 s left"
