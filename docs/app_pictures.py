"""Pictures of the window in the browser, for docs/app.md and README.md, of the packaged demonstration.

    python docs/app_pictures.py docs/pictures

Writes app.webp, which moves: the choice, the run, its result, a measured distance. Needs the extras `app` and `dev`,
and Chromium.
"""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

# Without a graphics card: WebGL on the processor.
ARGUMENTS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
SIZE = (1100, 690)
SHOWN_WIDTH = 780
MOST_BYTES = 1_000_000
PATIENCE_MS = 300_000
RUN_EVERY_MS = 2500
MOST_OF_RUN = 14
# Where the demonstration shows wall: right of the middle of the scene and below it, in its heights.
REFERENCE = ((-0.026, 0.12), (0.133, 0.22))
MEASURED = ((0.038, 0.22), (-0.106, 0.05))


class Film:
    """Pictures of a page, and how long each is shown, ms."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.pictures: list[Image.Image] = []
        self.lengths_ms: list[int] = []

    def take(self, length_ms: int) -> None:
        """Add the page as it is."""
        shown = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        height = round(SHOWN_WIDTH * shown.height / shown.width)
        self.pictures.append(shown.resize((SHOWN_WIDTH, height), Image.Resampling.LANCZOS))
        self.lengths_ms.append(length_ms)

    def save(self, file: Path) -> None:
        """Write an animated WebP below 1 MB: the quality is what that leaves."""
        for quality in (80, 65, 50, 35, 20):
            self.pictures[0].save(
                file,
                save_all=True,
                append_images=self.pictures[1:],
                duration=self.lengths_ms,
                loop=0,
                quality=quality,
                method=6,
            )
            if file.stat().st_size < MOST_BYTES:
                return
        raise SystemExit(f"{file} has {file.stat().st_size} bytes")


def click(page: Any, shares: tuple[float, float]) -> None:
    """Click on the scene, so far from its middle to the right and down, in its heights."""
    box = page.locator("canvas").first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.click(x + shares[0] * box["height"], y + shares[1] * box["height"])
    page.wait_for_timeout(1500)


def record(page: Any) -> Film:
    """Go from the choice of the demonstration to a measured distance."""
    film = Film(page)
    demonstrate = page.get_by_role("button", name="Try the demonstration")
    demonstrate.wait_for()
    page.wait_for_timeout(4000)
    # viser says that there is no graphics card.
    for close in page.locator(".mantine-Notification-closeButton").all():
        close.click()
    page.wait_for_timeout(1000)
    film.take(1500)
    demonstrate.click()
    page.get_by_text(re.compile("tracking")).first.wait_for()
    verdict = page.get_by_role("tab", name="Verdict")
    while not verdict.is_visible() and len(film.pictures) <= MOST_OF_RUN:
        film.take(700)
        page.wait_for_timeout(RUN_EVERY_MS)
    verdict.wait_for()
    page.wait_for_timeout(6000)
    film.take(3000)
    page.get_by_role("tab", name="Frames").click()
    page.wait_for_timeout(6000)
    film.take(2500)
    page.get_by_role("tab", name="Measure").click()
    page.get_by_role("button", name="Distance").click()
    page.wait_for_timeout(1500)
    for place in REFERENCE:
        click(page, place)
    length = page.locator("label", has_text="Length of this line")
    length.locator("xpath=ancestor::*[.//input][1]//input").fill("10")
    page.wait_for_timeout(1000)
    film.take(2000)
    page.get_by_role("button", name="Use as reference").click()
    page.wait_for_timeout(1500)
    for place in MEASURED:
        click(page, place)
    page.get_by_text(re.compile("along the surface:")).first.wait_for()
    page.wait_for_timeout(1500)
    film.take(5000)
    return film


def main() -> None:
    """Write the pictures to the folder that is named."""
    target, folder = Path(sys.argv[1]), Path(tempfile.mkdtemp())
    window = subprocess.Popen(
        [sys.executable, "-m", "scopemap", "app", str(folder), "--no-browser"], stdout=subprocess.PIPE, text=True
    )
    assert window.stdout is not None
    try:
        url = window.stdout.readline().split()[0]
        with sync_playwright() as driver:
            chromium = driver.chromium.launch(executable_path=shutil.which("chromium"), args=list(ARGUMENTS))
            page = chromium.new_context(viewport={"width": SIZE[0], "height": SIZE[1]}).new_page()
            page.set_default_timeout(PATIENCE_MS)
            page.goto(url)
            record(page).save(target / "app.webp")
    finally:
        window.terminate()
        window.wait()
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
