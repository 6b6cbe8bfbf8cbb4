"""The window from the choice of a video to the verdict: its pages without a browser, and in Chromium."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap.apps.browser import command
from scopemap.apps.browser.input_page import InputPage
from scopemap.apps.browser.looking import measured_rates
from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.run_page import RunPage
from scopemap.apps.browser.serving import RUN_GOES_ON
from scopemap.apps.browser.start_page import StartPage
from scopemap.apps.browser.window import BrowserWindow
from scopemap.apps.browser.workspace import Workspace, thumbnail
from scopemap.result.result import Result
from scopemap.result.run_view import read_map, view_folder
from scopemap.result.verdict import verdict
from tests.support.drawn_run import IN_RESULT, draw_run
from tests.support.window_without_browser import element, elements, press, settle, start_page, until, words

pytestmark = [pytest.mark.browser, pytest.mark.slow]

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Without a graphics card: WebGL on the processor.
ARGUMENTS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
CLIP = Path(command.__file__).parents[1] / "demo" / "clip" / "colon.mp4"
LIMIT_BYTES = 1_000_000
PATIENCE_S = 240.0
SIZE_SO_FAR = re.compile(r"The surface so far: ([\d,]+) points")


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[tuple[BrowserWindow, Workspace]]:
    with start_page(tmp_path) as found:
        yield found


def test_a_video_that_cannot_be_read_is_a_sentence(opened: tuple[BrowserWindow, Workspace]) -> None:
    window, workspace = opened
    (workspace.folder / "broken.mp4").write_bytes(b"no video at all")
    window.show(StartPage(workspace))
    settle(window)
    press(window, "Video", "broken.mp4")
    until(window, lambda: "reading the video" in words(window))
    assert "it is a text file, not a video" in words(window)
    assert "Traceback" not in words(window)
    assert "Reconstruct" not in words(window)
    press(window, "Back to the start")
    assert isinstance(window._page, StartPage)
    assert "reading the video" not in words(window)


def test_paths_out_of_the_folder_are_refused_in_the_page(opened: tuple[BrowserWindow, Workspace]) -> None:
    window, workspace = opened
    for typed, said in (("../x.mp4", "is not in"), ("/etc/passwd", "is not in"), ("no.mp4", "there is no no.mp4")):
        element(window, "Other path")._impl.value = typed
        press(window, "Choose this path")
        assert said in words(window)
        assert isinstance(window._page, StartPage)
    (workspace.folder / "deep").mkdir()
    shutil.copyfile(CLIP, workspace.folder / "deep" / "clip.mp4")
    element(window, "Other path")._impl.value = "deep/clip.mp4"
    press(window, "Choose this path")
    assert isinstance(window._page, InputPage)


def test_a_result_is_known_by_its_picture(tmp_path: Path) -> None:
    folder = draw_run(tmp_path / "one")
    run = Result(folder)
    seen = [index for index in run.pictured if index < IN_RESULT]
    expected = cv2.imread(str(run.picture_file(seen[len(seen) // 2])))[..., ::-1]
    np.testing.assert_array_equal(thumbnail(folder), expected)
    shutil.rmtree(folder / "frames")
    assert thumbnail(folder).shape == (1, 1, 3)


def test_switches_make_the_command(opened: tuple[BrowserWindow, Workspace]) -> None:
    window, workspace = opened
    for name in ("colon.mp4", "camera.yaml"):
        shutil.copyfile(CLIP.with_name(name), workspace.folder / name)
    window.show(StartPage(workspace))
    settle(window)
    press(window, "Video", "colon.mp4")
    until(window, lambda: "in a terminal" in words(window))
    assert f"--camera={workspace.folder / 'camera.yaml'}" in words(window)
    assert "good: motion, sharpness and texture" in words(window)
    press(window, "Camera", "by its field of view")
    # Nothing looks like a measured value, and what is typed is checked.
    assert element(window, "Field of view, degrees").value == ""
    for typed in ("", "wide", "0", "700"):
        press(window, "Field of view, degrees", typed)
        assert "type the horizontal field of view, 5 to 170 degrees" in words(window)
        assert element(window, "Reconstruct").disabled
    press(window, "Field of view, degrees", "100")
    press(window, "Endoscope", "colonoscope")
    press(window, "Frames", "0:30")
    numbers = ("Most frames per second", "Nearest tissue, mm", "Farthest tissue, mm")
    assert [element(window, label).value for label in numbers] == ["", "", ""]
    press(window, "Most frames per second", "fast")
    assert "type the most frames per second" in words(window)
    press(window, "Most frames per second", " ")
    press(window, "Nearest tissue, mm", "5")
    assert "type both the nearest and the farthest" in words(window)
    assert element(window, "Reconstruct").disabled
    press(window, "Farthest tissue, mm", "80,0")
    assert not element(window, "Reconstruct").disabled
    said = " ".join(words(window).split())
    assert "--scope=colonoscope --fov=100 --frames=0:30 --near-far=5:80" in said
    press(window, "Camera", "/etc/passwd")  # what is not of the list
    assert "choose one of the list" in words(window)
    assert "--fov=100" in words(window)
    page: Any = window._page
    assert page.choice.arguments() == ["--scope=colonoscope", "--fov=100", "--frames=0:30", "--near-far=5:80"]


def test_boxes_to_blacken_are_drawn_on_the_picture(opened: tuple[BrowserWindow, Workspace]) -> None:
    window, workspace = opened
    shutil.copyfile(CLIP, workspace.folder / "colon.mp4")
    window.show(InputPage(workspace, workspace.folder / "colon.mp4", lambda run: None, window.start))
    until(window, lambda: "in a terminal" in words(window))
    page: Any = window._page
    width, height = page._looked.spread.size

    def click(x: float, y: float) -> None:
        """Click on a place of the picture, as shares of its size, from where a browser looks."""
        start = np.array([0.1, 0.2, -0.5])
        place = np.array([x - 0.5, (y - 0.5) * height / width, 1.0])
        event = SimpleNamespace(ray_origin=tuple(start), ray_direction=tuple((place - start) / 3))
        for one in list(window.scene._scene_pointer_cb):
            one.callback(event)
        settle(window)

    click(0.1, 0.1)  # nothing is drawn yet
    press(window, "Draw boxes to blacken", True)
    assert "Click on a corner of the box" in words(window)
    for place in ((0.5, 0.25), (0.25, 0.125)):
        click(*place)
    x, y, w, h = page.choice.redact[0]
    assert page.choice.redact == ((x, y, w, h),)
    np.testing.assert_allclose([x / width, y / height], [0.25, 0.125], atol=1 / height)
    np.testing.assert_allclose([(x + w) / width, (y + h) / height], [0.5, 0.25], atol=2 / height)
    assert f"--redact={x},{y},{w},{h}" in words(window)
    shown = window.scene._handle_from_node_name["/page/to_blacken"].image
    rows, columns = shown.shape[:2]
    assert shown[int(0.13 * rows) : int(0.25 * rows), int(0.26 * columns) : int(0.5 * columns)].max() == 0
    # Beside the picture is on its rim, and no box is larger than the picture.
    for place in ((0.9, 0.9), (1.5, 1.5)):
        click(*place)
    assert len(page.choice.redact) == 2
    page.choice.checked()
    click(0.5, 0.5)
    click(0.5, 0.9)
    assert "make no box" in words(window)
    press(window, "Take back the last box")
    assert page.choice.redact == ((x, y, w, h),)
    press(window, "Draw boxes to blacken", False)
    assert "/page/to_blacken" not in window.scene._handle_from_node_name
    assert not window.scene._scene_pointer_cb
    assert page.choice.redact == ((x, y, w, h),)


def test_a_run_that_dies_is_told_and_goes_on_when_it_is_asked_again(opened: tuple[BrowserWindow, Workspace]) -> None:
    window, workspace = opened
    press(window, "Try the demonstration")
    page: Any = window._page
    assert isinstance(page, RunPage)
    run = workspace.runs.runs[0]
    sizes, kept = list[str](), list[int]()

    def grows() -> bool:
        if (found := SIZE_SO_FAR.search(words(window))) and found[1] not in sizes:
            sizes.append(found[1])
            seen = read_map(view_folder(run.out))
            kept.append(0 if seen is None else len(seen.points))
        return len(sizes) >= 3 or run.status != "running"

    until(window, grows, PATIENCE_S)
    shown = [int(size.replace(",", "")) for size in sizes]
    assert len(shown) >= 3, words(window)
    assert shown == sorted(shown), "the surface grows"
    assert kept == sorted(kept)
    # Another run waits meanwhile, and the start page lists both.
    press(window, "Back to the start")
    later = workspace.reconstruct(CLIP, ["--frames=0:4"])
    until(window, lambda: "colon_2 waits: 1 before it" in words(window))
    assert "colon runs: " in words(window)
    window._page.show_run(run)  # type: ignore[union-attr]
    settle(window)
    assert run._process is not None
    os.kill(run._process.pid, signal.SIGKILL)
    until(window, lambda: "The run has failed" in words(window))
    assert "exit code -9" in words(window)
    assert "start it again: it goes on where it was" in words(window)
    later.stop()
    until(window, lambda: workspace.runs.running is None, PATIENCE_S)
    press(window, "Back to the start")
    assert "has failed" in words(window)
    assert "colon was interrupted" in words(window)
    press(window, "Try the demonstration")
    again = workspace.runs.runs[-1]
    assert (again.out, again.arguments) == (run.out, run.arguments)
    until(window, lambda: isinstance(window._page, ResultPage), PATIENCE_S)
    assert verdict(Result(run.out)).word.capitalize() in words(window)
    # What it took tells how long the next one takes.
    assert len(measured_rates(workspace.finished, "default")) >= 1
    assert measured_rates(workspace.finished, "realtime") == []
    window.show(StartPage(workspace))
    settle(window)
    listed = [re.sub(r", \d{4}-\d\d-\d\d \d\d:\d\d,", "", one) for one in element(window, "Result").options]
    assert listed.count(f"{run.out.name} {verdict(Result(run.out)).word}") == 1
    # A finished run is a result, and no longer among the runs.
    assert f"{run.out.name} done" not in words(window)
    assert not any(getattr(one, "options", ()) == ("Look at it", "Stop") for one in elements(window))


# In Chromium.


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """Where a window on an empty folder is, and the folder."""
    folder = tmp_path / "videos"
    folder.mkdir()
    arguments = [str(folder), "--no-browser", "--upload-limit", str(LIMIT_BYTES / 1e9)]
    program = [sys.executable, "-m", "scopemap", "app", *arguments]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().split()[0], folder
        process.terminate()
        process.wait(60)


@pytest.fixture
def browser() -> Iterator[Any]:
    """One for a test: a page that is left open draws on, and takes the processor from the next test's."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        yield started
        started.close()


class Opened:
    """A page that was opened, and what it asked for."""

    def __init__(self, browser: Any, url: str, size: tuple[int, int] = (1280, 800)) -> None:
        self.page = browser.new_context(viewport={"width": size[0], "height": size[1]}).new_page()
        self.page.set_default_timeout(1000 * PATIENCE_S)
        self.requests: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda socket: self.requests.append(socket.url))
        self.page.goto(url)
        self.until(lambda: "Dark" in self.text())

    def text(self) -> str:
        return str(self.page.inner_text("body"))

    def until(self, is_so: Callable[[], object]) -> None:
        # Polled from here: the page's own policy forbids what `wait_for_function` does.
        end = time.monotonic() + PATIENCE_S
        while not is_so():
            assert time.monotonic() < end, self.text()
            self.page.wait_for_timeout(100)

    def press(self, name: str) -> None:
        # Not `click()` of Playwright: it first waits until nothing moves, and the scene is drawn by the processor here,
        # beside a run. A short run ended before.
        button = self.page.get_by_role("button", name=name, exact=True)
        self.until(button.is_enabled)
        button.evaluate("button => button.click()")

    def points(self) -> int:
        found = SIZE_SO_FAR.search(self.text())
        return int(found[1].replace(",", "")) if found else 0


def test_the_demonstration_from_the_button_to_the_verdict(browser: Any, served: tuple[str, Path]) -> None:
    url, folder = served
    first = Opened(browser, url)
    assert "Everything stays on this machine" in first.text()
    first.press("Try the demonstration")
    sizes = list[int]()

    def grows() -> bool:
        points = first.points()
        if points > (sizes[-1] if sizes else 0):
            sizes.append(points)
        return len(sizes) >= 3

    first.until(grows)
    # Another browser, narrower, and the same one reloaded show the run, too.
    second = Opened(browser, url, (800, 700))
    assert second.page.evaluate("document.documentElement.scrollWidth") <= 800
    first.page.reload()
    out = folder / "scopemap" / "colon"
    for one in (first, second):
        one.until(lambda one=one: one.points() >= sizes[-1] or (out / "provenance.json").exists())
    first.until(lambda: (out / "provenance.json").exists())
    word = verdict(Result(out)).word.capitalize()
    for one in (first, second):
        one.until(lambda one=one: word in one.text())
    hosts = {re.sub(r"^(\w+://[^/]+).*", r"\1", asked) for asked in first.requests + second.requests}
    own = url.rstrip("/")
    local = {one for one in hosts if not one.startswith(("data:", "blob:"))}
    assert local == {own, own.replace("http", "ws")}


def test_a_page_of_a_run_draws_rarely_until_someone_moves_it(browser: Any) -> None:
    window = BrowserWindow()
    page = browser.new_page(viewport={"width": 900, "height": 600})
    count = """seconds => new Promise(ended => {
        let drawn = 0;
        const next = () => { drawn += 1; requestAnimationFrame(next); };
        requestAnimationFrame(next);
        setTimeout(() => ended(drawn), 1000 * seconds);
    })"""
    drawn = {}
    page.goto(window.url)
    page.get_by_text("Dark", exact=True).wait_for()
    page.wait_for_timeout(4000)  # no one touches it
    drawn["start"] = page.evaluate(count, 4)
    page.evaluate(f"document.body.appendChild(document.createElement('i')).id = '{RUN_GOES_ON}'")
    drawn["run"] = page.evaluate(count, 4)
    page.mouse.move(100, 100)
    drawn["moved"] = page.evaluate(count, 2)
    window.close()
    assert drawn["run"] <= 3
    assert drawn["start"] > 2 * drawn["run"]
    assert drawn["moved"] > 2 * drawn["run"]


def test_a_video_is_sent_looked_at_run_and_stopped(browser: Any, served: tuple[str, Path], tmp_path: Path) -> None:
    url, folder = served
    opened = Opened(browser, url)
    large = tmp_path / "large.mp4"
    large.write_bytes(bytes(2 * LIMIT_BYTES))
    chooser = opened.page.locator("input[type=file]")
    chooser.set_input_files(large)
    opened.until(lambda: "at most 1.0 MB are taken" in opened.text())
    # Nothing says that it was taken, and the button takes the next one.
    opened.page.wait_for_timeout(500)
    assert "uploaded successfully" not in opened.text()
    assert "large.mp4 was not taken" in opened.text()
    chooser.set_input_files(CLIP)
    opened.until(lambda: "The same in a terminal" in opened.text())
    assert "scopemap run colon.mp4" in opened.text()
    assert "good: motion, sharpness and texture" in opened.text()
    opened.press("Reconstruct")
    opened.until(lambda: opened.points() > 0)
    opened.press("Stop")
    opened.until(lambda: "What was tracked is kept" in opened.text())
    out = folder / "scopemap" / "colon"
    assert not (out / "provenance.json").exists()
    opened.press("Make a result of these frames")
    part = folder / "scopemap" / "colon_so_far"
    opened.until(lambda: (part / "provenance.json").exists())
    assert Result(part).provenance["interrupted_at_frame"] is not None
    # What was stopped is still there, and goes on.
    opened.until(lambda: "Continue" in opened.text())
    opened.press("Continue")
    opened.until(lambda: (out / "provenance.json").exists())
    assert Result(out).provenance["interrupted_at_frame"] is None
    assert len(Result(out).frames) > len(Result(part).frames)
    word = verdict(Result(out)).word.capitalize()
    opened.until(lambda: word in opened.text())
