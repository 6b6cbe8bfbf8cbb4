"""A live stream in the window: what is shown while it goes on, and what its buttons do."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import pytest

from scopemap.apps.browser.live_page import open_live
from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.run_page import RunPage
from scopemap.apps.browser.window import BrowserWindow
from scopemap.apps.browser.workspace import Workspace
from scopemap.apps.live.live_status import LiveStatus
from scopemap.engine.errors import InputError
from scopemap.result.result import Result
from scopemap.result.run_view import look, read_map, read_pictures, read_progress, view_folder
from tests.apps.live.test_live import write_video
from tests.support.front_door import call
from tests.support.tiny_phantom import write_tiny
from tests.support.window_without_browser import element, press, seen_by_someone, until, words

pytestmark = pytest.mark.slow

PATIENCE_S = 240.0
STATUS = LiveStatus(
    state="lost",
    reason="too dark",
    frame=3,
    frames_per_s=14.5,
    latency_ms=71,
    latency_p50_ms=70,
    latency_p95_ms=99,
    read=40,
    dropped=2,
    tracked=30,
    lost=8,
    map=1,
    scale_known=False,
    snapshot="",
    full=False,
)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of three minutes: a phantom of 6 frames there and back, again and again."""
    folder = tmp_path_factory.mktemp("live")
    files = sorted(write_tiny(folder / "phantom", frames=6).glob("*_color.png"))
    pictures = [cv2.imread(str(file)) for file in files]
    write_video(folder / "clip.mp4", 150 * (pictures + pictures[::-1]))
    return folder / "clip.mp4"


def wait_for(is_so: Callable[[], Any]) -> Any:
    """Wait until something is so, and return it."""
    end = time.monotonic() + PATIENCE_S
    while not (found := is_so()) and time.monotonic() < end:
        time.sleep(0.05)
    assert found
    return found


def test_facts_of_a_session_are_words() -> None:
    assert STATUS.words == "lost: move back slowly"
    assert STATUS.line.startswith(
        "lost: move back slowly: 14.5 frames/s, latency 70 ms (95 % below 99), 2 of 40 frames"
    )
    assert STATUS.facts == {
        "why": "too dark",
        "latency": "70 ms (95 % below 99 ms)",
        "frames": "14.5 per second; 2 of 40 dropped",
        "tracked": "30, lost 8, submap 2",
        "scale": "unknown: compare shapes, not sizes",
    }
    full = replace(STATUS, full=True, scale_known=True, reason="", snapshot="a.png").facts
    assert list(full) == ["latency", "frames", "tracked", "scale", "surface", "snapshot"]
    assert full["scale"] == "known"


def test_a_session_that_is_watched_does_what_lines_say(clip: Path, tmp_path: Path) -> None:
    out, view = tmp_path / "out", view_folder(tmp_path / "out")
    program = [sys.executable, "-m", "scopemap", "live", str(clip), "--watched", "--out", str(out), "--quiet"]
    with subprocess.Popen([*program, "--set", "fusion.every=1"], stdin=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None

        def press_line(name: str) -> None:
            process.stdin.write(f"{name}\n")  # type: ignore[union-attr]
            process.stdin.flush()  # type: ignore[union-attr]

        def state() -> Any:
            assert process.poll() is None
            look(view)
            return read_progress(view)

        try:
            wait_for(lambda: state() and state().doing == "tracking" and read_map(view))
            assert read_pictures(view) is not None
            assert re.fullmatch(r"\d+ ms \(95 % below \d+ ms\)", state().facts["latency"])
            press_line("nothing of the kind")
            press_line("pause")
            wait_for(lambda: state().doing == "paused")
            press_line("pause")
            wait_for(lambda: state().doing == "tracking")
            press_line("snapshot")
            snapshot = Path(wait_for(lambda: state().facts.get("snapshot")))
            # Coverage comes in a process of its own, in words and as a picture, and is what the window shows.
            wait_for(lambda: state().facts["coverage"].startswith("Of map 1 until"))
            wait_for(lambda: state() and (view / "coverage.png").is_file())
            last = state().frame
            press_line("reset")
            wait_for(lambda: state().doing == "tracking" and state().frame > last and read_map(view).index[0] > last)
            assert "tracked: " not in state().facts
            press_line("stop")
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
    run = Result(out).checked()
    assert run.trajectory.indices[0] > last
    assert snapshot.name in [file.name for file in (out / "snapshots").iterdir()]
    assert not view.exists()


def test_a_session_whose_window_is_gone_ends_with_its_result(clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    program = [sys.executable, "-m", "scopemap", "live", str(clip), "--watched", "--out", str(out), "--quiet"]
    with subprocess.Popen(program, stdin=subprocess.PIPE) as process:
        try:
            wait_for(lambda: (state := read_progress(view_folder(out))) and state.status)
            process.stdin.close()  # type: ignore[union-attr]
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
    assert Result(out).is_finished


def test_a_stream_in_the_window(clip: Path, tmp_path: Path) -> None:
    with Workspace(tmp_path) as workspace:
        window = BrowserWindow()
        try:
            seen_by_someone(window)
            open_live(window, workspace, str(clip))
            until(window, lambda: "tracked at" in words(window), PATIENCE_S)
            page: Any = window._page
            assert isinstance(page, RunPage)
            assert "95 % below" in words(window)
            press(window, "Pause or go on")
            until(window, lambda: "paused" in words(window), PATIENCE_S)
            press(window, "Pause or go on")
            until(window, lambda: "tracking" in words(window), PATIENCE_S)
            drawn = {"/page/points", "/page/path", "/page/now"}
            until(window, lambda: drawn <= window.scene._handle_from_node_name.keys(), PATIENCE_S)
            press(window, "Stop")
            assert element(window, "Pause or go on").disabled
            until(window, lambda: isinstance(window._page, ResultPage), PATIENCE_S)
            assert Result(tmp_path / "scopemap" / "live").is_finished
            # One at a time.
            run = workspace.reconstruct(clip, [])
            with pytest.raises(InputError, match="a run is going on"):
                open_live(window, workspace, str(clip))
            run.kill()
            workspace.runs.tick()
            open_live(window, workspace, str(tmp_path / "none.mp4"))
            until(window, lambda: "no such file" in words(window), PATIENCE_S)
        finally:
            window.close()


@contextmanager
def in_app(clip: Path, out: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A session with its window beside it: where that is, and the process."""
    program = [sys.executable, "-m", "scopemap", "live", str(clip), "--app", "--out", str(out)]
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    environment = os.environ | {"BROWSER": "true", "TMPDIR": str(out.parent)}
    with subprocess.Popen(program, stderr=subprocess.PIPE, text=True, preexec_fn=heed, env=environment) as process:
        assert process.stderr is not None
        try:
            yield next(word for line in process.stderr for word in line.split() if word.startswith("http")), process
        finally:
            process.kill()


@pytest.mark.browser
def test_a_session_with_its_window_in_a_browser(clip: Path, tmp_path: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    out = tmp_path / "out"
    with in_app(clip, out) as (url, process), playwright.sync_playwright() as driver:
        arguments = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
        browser = driver.chromium.launch(executable_path=chromium, args=arguments)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(1000 * PATIENCE_S)
        page.goto(url)
        page.get_by_text("95 % below").wait_for()
        # A press is lost where the browser, on a loaded machine, has not yet joined the button to the program.
        for patience_s in (30, 60, PATIENCE_S):
            page.get_by_role("button", name="Pause or go on").click()
            with suppress(playwright.TimeoutError):
                page.get_by_text("paused").wait_for(timeout=1000 * patience_s)
                break
        assert page.get_by_text("paused").is_visible()
        page.get_by_role("button", name="Stop").click()
        page.get_by_role("button", name="Stop").wait_for(state="detached")
        wait_for(lambda: Result(out).is_finished)
        browser.close()
        # It stays until Ctrl-C, and leaves nothing behind.
        wait_for(lambda: any("stays until Ctrl-C" in line for line in process.stderr or ()))
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0
    assert list(tmp_path.glob("scopemap-*")) == []


def test_the_port_is_that_of_the_window(clip: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert call("live", clip, "--port", 8080) == 2
    assert "that of --app" in capfd.readouterr().err
