"""A page that is opened in a real browser without a display, what it complains of and what it asks of a network."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

IN_A_BROWSER = [
    pytest.mark.browser,
    pytest.mark.skipif(find_spec("playwright") is None, reason="playwright is not installed"),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)"),
]
"""Marks of a module whose tests need one."""
DESKTOP, PHONE = (1280, 800), (390, 844)
# Without a graphics card: WebGL on the processor.
ARGUMENTS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")


@contextmanager
def chromium() -> Iterator[Any]:
    """Where a Chromium without a screen is open."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        yield started
        started.close()


class Opened:
    """A page that was opened, what it complained of and what it asked for."""

    def __init__(self, browser: Any, file: Path | str, size: tuple[int, int] = DESKTOP, theme: str = "light") -> None:
        viewport = {"width": size[0], "height": size[1]}
        self.page = browser.new_context(viewport=viewport, color_scheme=theme, has_touch=size == PHONE).new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(file if isinstance(file, str) else file.resolve().as_uri())
        self.wait("shown", "0")

    def _heard(self, message: Any) -> None:
        # A screenshot of a WebGL canvas reads its pixels back, and a driver in software sometimes calls that slow.
        # The note is about the screenshot, not about the page.
        if "GPU stall due to ReadPixels" not in message.text:
            self.complaints.append(message.text)

    def wait(self, name: str, value: str) -> None:
        # Polled from here: the page's own policy forbids what `wait_for_function` does.
        end = time.monotonic() + 30
        while self.page.evaluate(f"document.documentElement.dataset.{name}") != value:
            assert time.monotonic() < end, f"{name} did not become {value}"
            self.page.wait_for_timeout(20)
        # Two frames later everything that was asked for is on the screen.
        self.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def slide(self, row: int) -> None:
        self.page.locator("#slider").evaluate("(s, row) => { s.value = row; s.dispatchEvent(new Event('input')) }", row)
        self.wait("shown", str(row))

    def picture(self, selector: str) -> np.ndarray:
        """Return what is seen of an element, (H, W, 3) float."""
        bytes_ = self.page.locator(selector).screenshot()
        return cv2.imdecode(np.frombuffer(bytes_, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(float)

    def frustum(self) -> list[float]:
        return [float(number) for number in self.page.evaluate("document.documentElement.dataset.frustum").split()]

    def text(self, selector: str) -> str:
        return self.page.locator(selector).inner_text()
