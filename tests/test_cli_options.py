"""Texts of the command line turned into values, and the lines of progress."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import pytest

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


@pytest.mark.parametrize("text", ["", "7", "a:b", "1:2:3:4", "1 : 2", "0:10:-1", "1.5:3"])
def test_no_slices(text: str) -> None:
    with pytest.raises(SettingsError, match="START:STOP"):
        parse_slice(text)


def test_sizes_and_ranges() -> None:
    assert parse_size("320x256") == (320, 256)
    assert parse_near_far("13.5:100") == (13.5, 100.0)
    for text in ("320", "320X256", "320x-1", "x", "320x256x3"):
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


def test_no_number_is_no_range() -> None:
    assert math.isnan(parse_near_far("nan:10")[0])  # refused where the range is checked: test_depth_anchor.py


# ---- progress, where there is no terminal


def _step(status: str = "ok", reason: str = "") -> SimpleNamespace:
    return SimpleNamespace(track=SimpleNamespace(status=status, reason=reason))


def test_silent_progress_has_no_observer() -> None:
    with run_progress(10, silent=True) as observers:
        assert observers == ()


def test_progress_without_a_terminal_is_a_line_at_the_end(capfd: pytest.CaptureFixture[str]) -> None:
    with run_progress(3, silent=False) as observers:
        for step in (_step(), _step("lost", "too dark"), _step()):
            observers[0](step)  # type: ignore[arg-type]
    out, err = capfd.readouterr()
    assert out == ""
    assert re.fullmatch(
        r"frame 3 of 3: [\d.]+ frames/s, 0 s left, ok, 1 lost so far; adjusting, fusing and writing\n", err
    )


@pytest.mark.parametrize("total", [100, None])
def test_progress_comes_now_and_then(
    total: int | None, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock.now)
    with run_progress(total, silent=False) as observers:
        for _ in range(25):
            clock.now += 1.0
            observers[0](_step("lost", "too dark"))  # type: ignore[arg-type]
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"frame {n}" + " of 100" * (total is not None) for n in (10, 20)]
    assert all("1.0 frames/s" in line and line.endswith("lost: too dark") for line in lines)
    assert all(("90 s left" in line or "80 s left" in line) == (total is not None) for line in lines)


def test_what_is_prepared_before_the_first_frame_slows_no_rate(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock.now)
    with run_progress(100, silent=False) as observers:
        clock.now = 60.0
        observers[0](_step())  # type: ignore[arg-type]
        for _ in range(20):
            clock.now += 0.5
            observers[0](_step())  # type: ignore[arg-type]
    lines = capfd.readouterr().err.splitlines()
    assert lines == ["frame 1 of 100: ok", "frame 21 of 100: 2.0 frames/s, 40 s left, ok"]
