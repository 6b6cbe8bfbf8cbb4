"""Texts of the command line turned into values, and the lines of progress."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import pytest
from numba import njit

from scopemap.cli import progress
from scopemap.cli.options import parse_near_far, parse_settings, parse_size, parse_slice
from scopemap.cli.progress import run_progress
from scopemap.errors import SettingsError


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0:100", slice(0, 100, None)),
        ("::2", slice(None, None, 2)),
        ("-50:", slice(-50, None, None)),
        ("5:-5:3", slice(5, -5, 3)),
        (":", slice(None, None, None)),
    ],
)
def test_slices(text: str, expected: slice) -> None:
    assert parse_slice(text) == expected


@pytest.mark.parametrize(
    "text", ["9" * 23 + ":", ":" + "9" * 5000, "::" + "9" * 99, "", "7", "a:b", "1:2:3:4", "1 : 2", "0:10:-1", "1.5:3"]
)
def test_no_slices(text: str) -> None:
    with pytest.raises(SettingsError, match="START:STOP"):
        parse_slice(text)


def test_sizes_and_ranges() -> None:
    assert parse_size("320x256") == (320, 256)
    assert parse_near_far("13.5:100") == (13.5, 100.0)
    for text in ("9" * 5000 + "x3", "320", "320X256", "320x-1", "x", "320x256x3"):
        with pytest.raises(SettingsError, match="320x256"):
            parse_size(text)
    for text in ("13", "a:b", "1:2:3", ":"):
        with pytest.raises(SettingsError, match="10:100"):
            parse_near_far(text)


def test_settings_are_json_where_they_can_be() -> None:
    pairs = ["a=1", "b=2.5", "c=true", "d=[1, 2]", "e=dis", "f=files:/x=y", "g=", 'h="quoted"', "i=null"]
    expected = {"a": 1, "b": 2.5, "c": True, "d": [1, 2], "e": "dis", "f": "files:/x=y", "g": "", "h": "quoted"}
    assert parse_settings(pairs) == expected | {"i": None}
    assert parse_settings(["a=1", "a=2"]) == {"a": 2}
    assert isinstance(parse_settings(["c=true"])["c"], bool)


@pytest.mark.parametrize("value", ["[" * 100_000, "9" * 5000, '{"a":' * 100_000])
def test_values_that_no_parser_takes_are_a_sentence(value: str) -> None:
    with pytest.raises(SettingsError, match=r"cannot read the setting 'tracking\.huber=") as caught:
        parse_settings([f"tracking.huber={value}"])
    assert len(str(caught.value)) < 300


def test_no_number_is_no_range() -> None:
    assert math.isnan(parse_near_far("nan:10")[0])  # refused where the range is checked: test_depth_anchor.py


# ---- progress, where there is no terminal


def _step(status: str = "ok", reason: str = "", number: int = 0) -> SimpleNamespace:
    return SimpleNamespace(track=SimpleNamespace(status=status, reason=reason, map=number))


def test_lost_frames_and_those_of_other_maps_are_counted_apart(capfd: pytest.CaptureFixture[str]) -> None:
    with run_progress(6, silent=False) as (observers, _):
        for step in (_step(), _step(), _step("lost", "dark"), _step(number=1), _step(number=1), _step(number=1)):
            observers[0](step)  # type: ignore[arg-type]
    assert capfd.readouterr().err.splitlines()[-1].endswith("ok, 1 lost, 2 in other maps so far")


def test_kernels_that_no_cache_holds_are_told_once(capfd: pytest.CaptureFixture[str]) -> None:
    first, second = njit(lambda x: x + 1), njit(lambda x: x + 2)
    with run_progress(3, silent=False):
        assert (first(1), second(1)) == (2, 3)
        assert first(2) == 3
    assert capfd.readouterr().err == "compiling kernels, once\n"
    third = njit(lambda x: x + 3)
    assert third(1) == 4
    with run_progress(3, silent=False):
        assert third(2) == 5
    assert capfd.readouterr().err == ""


def test_silent_progress_has_no_observer() -> None:
    with run_progress(10, silent=True) as shown:
        assert shown.observers == ()


def test_progress_without_a_terminal_is_a_line_at_the_end(capfd: pytest.CaptureFixture[str]) -> None:
    with run_progress(3, silent=False) as (observers, _):
        for step in (_step(), _step("lost", "too dark"), _step()):
            observers[0](step)  # type: ignore[arg-type]
    out, err = capfd.readouterr()
    assert out == ""
    assert re.fullmatch(r"frame 3 of 3: [\d.]+ frames/s, about \d+ s left, ok, 1 lost so far\n", err)


@pytest.mark.parametrize("total", [100, None])
def test_progress_comes_now_and_then(
    total: int | None, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock.now)
    with run_progress(total, silent=False) as (observers, _):
        for _ in range(25):
            clock.now += 1.0
            observers[0](_step("lost", "too dark"))  # type: ignore[arg-type]
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"frame {n}" + " of 100" * (total is not None) for n in (10, 20)]
    assert all("1.0 frames/s" in line and line.endswith("lost: too dark") for line in lines)
    assert all(("about 140 s left" in line or "about 130 s left" in line) == (total is not None) for line in lines)


def test_what_is_prepared_before_the_first_frame_slows_no_rate(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock.now)
    with run_progress(100, silent=False) as (observers, _):
        clock.now = 60.0
        observers[0](_step())  # type: ignore[arg-type]
        for _ in range(20):
            clock.now += 0.5
            observers[0](_step())  # type: ignore[arg-type]
    lines = capfd.readouterr().err.splitlines()
    assert lines == ["frame 1 of 100: ok", "frame 21 of 100: 2.0 frames/s, about 64 s left, ok"]


def test_what_follows_the_last_frame_is_shown(capfd: pytest.CaptureFixture[str]) -> None:
    with run_progress(2, silent=False) as (observers, tell):
        tell("estimating the focal length", 0, 0)
        for _ in range(2):
            observers[0](_step())  # type: ignore[arg-type]
        tell("adjusting keyframes", 0, 0)
        for done in range(1, 4):
            tell("fusing", done, 3)
        tell("writing", 0, 0)
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == [
        *("estimating the focal length", "frame 1 of 2", "frame 2 of 2", "adjusting keyframes"),
        *("fusing frame 1 of 3", "fusing frame 3 of 3", "writing"),
    ]
