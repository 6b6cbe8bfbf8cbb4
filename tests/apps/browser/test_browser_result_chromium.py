"""The page of a result in a real browser without a display: colours, clicks on the surface, keys of the time line."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.window import BrowserWindow
from tests.support.drawn_run import draw_run
from tests.support.front_door import call

pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)"),
]

# Without a graphics card: WebGL on the processor.
ARGUMENTS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
PATIENCE_S = 180
KNOWN = {"known": True, "source": "a ruler", "measured": True}
BRIGHT = (230, 180, 130)  # of the drawn tube


@pytest.fixture
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        yield started
        started.close()


class Looked:
    """A browser that looks at a window, which runs in a thread."""

    def __init__(self, browser: Any, window: BrowserWindow, size: tuple[int, int]) -> None:
        self.window = window
        self.page = browser.new_context(viewport={"width": size[0], "height": size[1]}).new_page()
        self.page.set_default_timeout(1000 * PATIENCE_S)
        self.requests: list[str] = []
        self.errors: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(window.url)
        self.page.get_by_role("tab", name="Measure").wait_for()

    def until(self, found: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while not found():
            assert time.monotonic() < end, f"not seen: {what}"
            self.page.wait_for_timeout(100)

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def click(self, right: float, down: float) -> None:
        """Click on the scene, so far from its middle, in its heights."""
        box = self.page.locator("canvas").first.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.click(x + right * box["height"], y + down * box["height"])

    @property
    def words(self) -> str:
        return str(self.page.inner_text("body"))

    def picture(self) -> np.ndarray:
        bytes_ = self.page.locator("canvas").first.screenshot()
        return cv2.imdecode(np.frombuffer(bytes_, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


@pytest.fixture
def shown(browser: Any, request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Looked, ResultPage, Path]]:
    folder, window = draw_run(tmp_path, scale=KNOWN), BrowserWindow(0)
    page = ResultPage(folder)
    window.show(page)
    thread = threading.Thread(target=window.run, daemon=True)
    thread.start()
    looked = Looked(browser, window, getattr(request, "param", (1280, 800)))
    yield looked, page, folder
    looked.page.context.close()
    window.stop()
    thread.join(PATIENCE_S)
    window.close()


def test_a_distance_between_two_clicks_is_the_commands(
    shown: tuple[Looked, ResultPage, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    looked, _, folder = shown
    # The time line is below the scene, beside the panel.
    line, panel = (looked.page.locator(f'[data-dock-region="{edge}"]').bounding_box() for edge in ("left", "right"))
    assert line["x"] == 0
    assert line["x"] + line["width"] == panel["x"]
    assert line["y"] > 400
    assert panel["height"] == 800
    looked.tab("Measure")
    looked.page.get_by_role("button", name="Distance").click()
    looked.until(lambda: "Distance: click on the 1st of 2 points" in looked.words, "what to do")
    looked.click(-0.025, 0.05)
    looked.until(lambda: "click on the 2nd of 2 points" in looked.words, "the first point")
    looked.click(0.0375, 0.125)
    looked.until(lambda: "Command of 1" in looked.words, "the distance")
    looked.page.get_by_text("Command of 1").click()
    looked.until(lambda: "--points" in looked.words, "the command")
    command = re.search(r'scopemap measure .*?--points "[^"]*"', looked.words, re.DOTALL)
    assert command is not None
    capsys.readouterr()
    program, *words = shlex.split(command[0].replace("\\\n", " "))
    assert words[1] == str(folder)
    assert (program, call(*words, "--json")) == ("scopemap", 0)
    found = {one["what"]: one["value"] for one in json.loads(capsys.readouterr().out)}
    value = np.format_float_positional(float(f"{found['straight']:.3g}"), trim="-")
    assert f"straight: {value} mm" in looked.words
    assert looked.errors == []
    assert {urlsplit(url).hostname for url in looked.requests if url.startswith("http")} <= {"localhost", "127.0.0.1"}


@pytest.mark.parametrize("shown", [(1400, 900), (800, 1100)], indirect=True)
def test_what_to_click_is_seen_wherever_the_panel_is_scrolled_to(shown: tuple[Looked, ResultPage, Path]) -> None:
    looked, _, _ = shown
    looked.tab("Measure")
    looked.page.get_by_role("button", name="Distance").click()
    looked.until(lambda: "Distance: click on the 1st of 2 points" in looked.words, "what to do")
    scene = looked.page.locator("canvas").first.bounding_box()
    looked.page.evaluate(
        """() => { for (const part of document.querySelectorAll("*")) part.scrollTop = part.scrollHeight; }"""
    )
    shown_words = looked.page.get_by_text("Distance: click on the 1st of 2 points")
    looked.page.wait_for_timeout(500)
    box = shown_words.bounding_box()
    assert scene["x"] <= box["x"] and box["x"] + box["width"] <= scene["x"] + scene["width"]  # noqa: PT018
    assert scene["y"] <= box["y"] and box["y"] + box["height"] <= scene["y"] + scene["height"]  # noqa: PT018
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    # Nothing covers it, and a click goes through it to the scene.
    on_top = """([x, y]) => {
        const words = document.querySelector(".scopemap-next-click");
        words.style.pointerEvents = "auto";
        const found = document.elementFromPoint(x, y) === words;
        words.style.pointerEvents = "";
        return [found, document.elementFromPoint(x, y).tagName];
    }"""
    assert looked.page.evaluate(on_top, list(middle)) == [True, "CANVAS"]


@pytest.mark.parametrize("shown", [(800, 1100)], indirect=True)
def test_colours_are_those_of_the_surface_and_keys_move_the_time_line(shown: tuple[Looked, ResultPage, Path]) -> None:
    looked, _, _ = shown
    looked.tab("Surface")
    looked.page.locator("label", has_text="Shading").first.click()
    looked.page.get_by_role("combobox", name="Colour by").click()
    looked.page.get_by_role("option", name="picture", exact=True).click()
    near = lambda: (np.abs(looked.picture() - BRIGHT).max(-1) <= 2).sum()  # noqa: E731
    looked.until(lambda: near() > 500, "the tissue's own colour")
    looked.tab("Frames")
    slider = looked.page.get_by_role("slider").first
    slider.focus()
    looked.page.keyboard.press("ArrowRight")
    looked.until(lambda: "Frame 1, 0.04 s: tracked" in looked.words, "the next frame by an arrow key")
    slider.blur()
    looked.page.keyboard.press("n")
    looked.until(lambda: "Frame 2, 0.08 s: tracked" in looked.words, "the next frame by N")
    # The panel and the time line are below the scene, which has all of the width.
    box = lambda place: looked.page.locator(place).first.bounding_box()  # noqa: E731
    scene, line, panel = (box(place) for place in ("canvas", '[data-dock-region="left"]', '[data-dock-region="right"]'))
    assert (scene["width"], line["width"], panel["width"]) == (800, 800, 800)
    assert scene["height"] > 200
    assert scene["y"] + scene["height"] <= line["y"] + 1 <= line["y"] + line["height"] <= panel["y"] + 1
    # Nothing is wider than the page.
    assert looked.page.evaluate("document.documentElement.scrollWidth") <= 800
    assert looked.errors == []
