"""The strip of the time line: what became of each frame, and which segment it belongs to."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.time_strip import TimeStrip
from scopemap.report.sheet import rgb_of
from scopemap.report.summary_picture import TONES
from scopemap.result.result import Result
from tests.engine.mapping.test_segments import segmented_result
from tests.support.drawn_run import FRAMES, IN_FIRST_MAP, IN_RESULT, draw_run
from tests.support.shown_window import shown_window

pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")

GREEN, BLUE, RED = (rgb_of(colour) for colour in ("#2a9d6f", "#4f86dc", "#d64545"))


def strip_of(run: Result, row: int = 0) -> TimeStrip:
    """The strip of a result of which all frames were used."""
    return TimeStrip(cast(Any, SimpleNamespace(whole=run, rows=list(range(len(run.frames))), row=row)))


def at(picture: np.ndarray, frame: float, frames: int) -> tuple[int, ...]:
    """The colour in the middle of a frame's part."""
    return tuple(picture[9, int((frame + 0.5) * picture.shape[1] / frames)].tolist())


def test_frames_have_the_colours_of_the_report(tmp_path: Path) -> None:
    strip = strip_of(Result(draw_run(tmp_path)), row=3)
    picture = strip.picture()
    assert at(picture, 0, FRAMES) == tuple(GREEN)
    assert at(picture, IN_RESULT - 1, FRAMES) == tuple(GREEN)
    assert at(picture, IN_RESULT, FRAMES) == tuple(RED)
    assert at(picture, FRAMES - IN_FIRST_MAP, FRAMES) == tuple(BLUE)
    # The frame that is shown is marked, and no other.
    marked = np.flatnonzero((picture[9] == 0).all(-1))
    assert abs(marked.mean() / picture.shape[1] * FRAMES - 3.5) < 0.1
    assert all(words in strip.legend for words in ("in the result", "in another submap", "lost"))
    assert "rotation only" not in strip.legend


def test_segments_have_the_colour_of_their_verdict_and_are_apart() -> None:
    strip = strip_of(segmented_result(), row=79)
    picture = strip.picture()
    bad, good = tuple(rgb_of(TONES["bad"])), tuple(rgb_of(TONES["good"]))
    assert (at(picture, 10, 80), at(picture, 40, 80), at(picture, 70, 80)) == (bad, good, good)
    for border in (20, 60):
        assert tuple(picture[9, border * picture.shape[1] // 80].tolist()) == (255, 255, 255)
    assert "segment, not usable" in strip.legend
    assert "in the result" not in strip.legend


def test_the_time_line_goes_with_its_page(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    with shown_window() as shown:
        for _ in range(2):
            shown.show(ResultPage(folder))
            assert len(shown.window.gui._panel_handle_from_uuid) == 1
        before = shown.handles("Image")[0].image
        shown.choose("Slider", "Frame", 9)
        assert (shown.handles("Image")[0].image != before).any()
