"""The report's page in a real browser without a display: what is drawn, what moves, what is asked of a network."""

from __future__ import annotations

import csv
import json
import re
import shlex
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_run import FRAMES, IN_FIRST_MAP, IN_RESULT, draw_run, draw_textured_run, pose_of
from front_door import call

from scopemap.apps.measure.measure import measure
from scopemap.engine.errors import InputError
from scopemap.report.page import keep_measurements, write_comparison, write_report
from scopemap.result.result import Result

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)")

DESKTOP, PHONE = (1280, 800), (390, 844)
# Without a graphics card: WebGL on the processor.
ARGUMENTS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
_ENDS = ("value", "low", "high")
LIGHT_GROUND, DARK_GROUND = (0xE4, 0xE9, 0xF0), (0x0A, 0x0F, 0x15)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        yield started
        started.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(draw_run(tmp_path_factory.mktemp("run")))[0]


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


def off(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return np.asarray(np.abs(picture - colour).max(-1) > 24)


@pytest.mark.parametrize(
    ("size", "theme", "ground"),
    [(DESKTOP, "light", LIGHT_GROUND), (PHONE, "dark", DARK_GROUND), (PHONE, "light", LIGHT_GROUND)],
)
def test_it_opens_silently_and_draws_the_mesh(
    browser: Any, report: Path, size: tuple[int, int], theme: str, ground: tuple[int, int, int]
) -> None:
    opened = Opened(browser, report, size, theme)
    scene = opened.picture("#scene")
    middle = scene[len(scene) // 4 : -len(scene) // 4, scene.shape[1] // 4 : -scene.shape[1] // 4]
    assert off(middle, ground).mean() > 0.15
    tissue = middle[off(middle, ground)]
    assert np.median(tissue[:, 0] - tissue[:, 2]) > 20  # red and yellow rings
    assert not off(scene[2:7, 20:-20], ground).any()
    assert opened.page.evaluate("document.documentElement.scrollWidth") == size[0]
    assert opened.complaints == []
    assert [url for url in opened.requests if not url.startswith("data:")] == [report.resolve().as_uri()]


def test_the_surface_has_its_texture(browser: Any, tmp_path: Path) -> None:
    seen = Opened(browser, write_report(draw_textured_run(tmp_path))[0]).picture("#rendered")[10:-10, 20:-20]
    green = seen[..., 1] - seen[..., 2]
    assert np.median(green[:, :80]) > 30 > -30 > np.median(green[:, -80:])


def test_the_verdict_is_seen_without_scrolling(browser: Any, report: Path) -> None:
    for size in (DESKTOP, PHONE):
        opened = Opened(browser, report, size)
        box = opened.page.locator("#word").bounding_box()
        assert box["y"] + box["height"] < 200
        assert opened.text("#word") == "Doubtful"
        assert opened.text("#advice").endswith("Sizes are unknown: compare shapes, do not measure.")
        reasons = opened.page.locator("#reasons li").all_inner_texts()
        assert f"58 % of the frames are in the result ({IN_RESULT} of {FRAMES})" in reasons[0]
        assert reasons[1] == "A warning."  # the run's own, and nowhere else on the page
        opened.page.locator("#details summary").first.click()
        assert opened.text("body").lower().count("a warning") == 1


def test_the_slider_moves_frame_and_frustum(browser: Any, report: Path) -> None:
    opened = Opened(browser, report)
    before, scene = opened.picture("#video"), opened.picture("#scene")
    assert opened.frustum() == pytest.approx(pose_of(0)[:3, 3], abs=1e-3)
    opened.slide(9)
    assert opened.text("#frame-title") == "Frame 9 · 0.36 s"
    assert opened.frustum() == pytest.approx(pose_of(9)[:3, 3], abs=1e-3)
    assert np.abs(opened.picture("#video") - before).mean() > 5
    assert off(opened.picture("#scene") - scene, (0, 0, 0)).mean() > 0.005
    assert "in the result" in opened.page.locator("#slider").get_attribute("aria-valuetext")


def test_the_surface_is_rendered_where_the_video_shows_it(browser: Any, report: Path) -> None:
    opened = Opened(browser, report)
    opened.page.locator("#mask").uncheck()
    opened.slide(6)
    video, rendered = opened.picture("#video"), opened.picture("#rendered")
    inside = np.s_[10:-10, 30:-10]
    ring = video[inside][..., 1] > np.median(video[inside][..., 1])
    also = rendered[inside][..., 1] > np.median(rendered[inside][..., 1])
    assert (ring == also).mean() > 0.85
    assert float(opened.text("#residual-note").split()[2]) < 2
    residual = opened.picture("#residual")[inside]
    assert np.median(residual) > 225  # white: both depths agree


def test_a_lost_frame_says_so(browser: Any, report: Path) -> None:
    opened = Opened(browser, report)
    opened.slide(IN_RESULT + 1)
    assert opened.text("#frame-status") == "Camera lost: too blurred"
    assert opened.page.evaluate("document.documentElement.dataset.frustum") == ""
    assert opened.page.locator("#rendered").get_attribute("aria-label") == "camera lost"


def test_a_frame_without_a_picture_shows_one_of_its_own_submap(browser: Any, tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    for index in (IN_RESULT, *range(IN_RESULT - 2, IN_RESULT)):
        Result(folder).picture_file(index).unlink()  # then the nearest to the last of the result is of a lost frame
    opened = Opened(browser, write_report(folder)[0])
    opened.slide(IN_RESULT - 1)
    assert opened.text("#video-note") == f"of frame {IN_RESULT - 3}"
    assert opened.page.locator("#rendered").get_attribute("aria-label") != "camera lost"


def test_another_submap_is_shown_by_its_frames_and_by_its_button(browser: Any, report: Path) -> None:
    opened = Opened(browser, report)
    pictures = [opened.picture(f"#submap-list button:nth-child({k}) canvas") for k in (1, 2)]
    assert all(off(picture, LIGHT_GROUND).mean() > 0.1 for picture in pictures)
    opened.slide(FRAMES - 1)
    assert opened.text("#submap").startswith("Submap 1")
    assert opened.page.locator("#submap-list button").nth(1).get_attribute("aria-pressed") == "true"
    opened.page.locator("#submap-list button").first.click()
    opened.wait("shown", "0")
    assert opened.text("#submap") == "The result"
    opened.page.locator("#submap-list button").nth(1).click()
    opened.wait("shown", str(FRAMES - IN_FIRST_MAP))


def test_keys_move_the_slider_and_turn_the_surface(browser: Any, report: Path) -> None:
    opened = Opened(browser, report)
    opened.page.locator("#slider").focus()
    for key, row in (("ArrowRight", 1), ("ArrowUp", 2), ("ArrowLeft", 1), ("PageUp", 11), ("End", FRAMES - 1)):
        opened.page.keyboard.press(key)
        opened.wait("shown", str(row))
    opened.slide(0)
    opened.page.locator("#scene").focus()
    for key in ("ArrowLeft", "-", "0"):
        before = opened.picture("#scene")
        opened.page.keyboard.press(key)
        opened.wait("shown", "0")
        assert off(opened.picture("#scene") - before, (0, 0, 0)).mean() > 0.01


def test_the_wheel_scrolls_the_page_until_the_surface_is_clicked(browser: Any, report: Path) -> None:
    opened = Opened(browser, report)
    page, box = opened.page, opened.page.locator("#scene").bounding_box()
    scrolled = "() => window.scrollY"

    def wheel(delta: int) -> tuple[bool, bool]:
        """Turn the wheel over the surface; return whether the page scrolled, and whether the surface changed."""
        top, before = page.evaluate(scrolled), opened.picture("#scene")
        page.mouse.wheel(0, delta)
        page.wait_for_timeout(300)
        has_scrolled = page.evaluate(scrolled) != top
        page.evaluate("top => window.scrollTo(0, top)", top)
        return has_scrolled, bool(np.abs(opened.picture("#scene") - before).max() > 24)

    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert wheel(60) == (True, False)
    page.keyboard.down("Control")
    assert wheel(60) == (False, True)
    page.keyboard.up("Control")
    page.mouse.down()
    page.mouse.up()
    assert wheel(60) == (False, True)
    page.mouse.move(2, 2)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert wheel(60) == (True, False)
    assert "the wheel after a click or with Ctrl" in opened.text("#surface .hint:not(.touch)")
    assert opened.complaints == []


def test_colours_views_and_curves_can_be_chosen(browser: Any, report: Path) -> None:
    opened = Opened(browser, report)
    before = opened.picture("#scene")
    for choice, legend in (("1", "0 %"), ("2", "0\n0.5")):
        opened.page.locator("#paint").select_option(choice)
        opened.wait("shown", "0")
        assert opened.text("#scene-legend").startswith(legend)
        assert off(opened.picture("#scene") - before, (0, 0, 0)).mean() > 0.05
    for look in ("behind", "through"):
        opened.page.locator("#look").select_option(look)
        opened.wait("shown", "0")
        assert off(opened.picture("#scene") - before, (0, 0, 0)).mean() > 0.2
    curve = opened.page.locator(".curve canvas").first
    box = curve.bounding_box()
    curve.click(position={"x": 34 + 0.55 * (box["width"] - 40), "y": 50})
    opened.wait("shown", str(round(0.55 * (FRAMES - 1))))


def test_dark_follows_the_system_and_the_button(browser: Any, report: Path) -> None:
    opened = Opened(browser, report, theme="dark")
    dark = opened.picture("#details").mean()
    opened.page.locator("#theme").click()
    opened.wait("shown", "0")
    assert opened.picture("#details").mean() > dark + 120
    assert not off(opened.picture("#scene")[2:7, 20:-20], LIGHT_GROUND).any()


def test_everything_has_a_name_for_a_screen_reader(browser: Any, report: Path) -> None:
    opened = Opened(browser, report)
    nameless = opened.page.evaluate(
        """() => [...document.querySelectorAll('canvas, input, select, button')]
        .filter(e => e.getAttribute('aria-hidden') !== 'true')
        .filter(e => !(e.getAttribute('aria-label') || e.innerText || (e.labels && e.labels.length)))
        .map(e => e.outerHTML)"""
    )
    assert nameless == []
    assert opened.page.locator("h1, h2, h3").count() >= 10
    assert opened.page.evaluate("document.documentElement.lang") == "en"


def test_several_runs_are_chosen_by_name(browser: Any, tmp_path: Path, report: Path) -> None:
    other = draw_run(tmp_path / "other", surface={"coverage_mean": 0.3, "coverage_least": 0.1})
    write_comparison([report.parent, other], ["ours", "theirs"], tmp_path / "compare.html")
    opened = Opened(browser, tmp_path / "compare.html")
    assert opened.text("#name") == "ours"
    opened.page.locator("#run").select_option("1")
    opened.wait("shown", "0")
    assert (opened.text("#name"), opened.text("#word")) == ("theirs", "Not usable")
    assert opened.complaints == []


# ---- measuring by hand


def measured_in_both(opened: Opened, folder: Path, number: int) -> tuple[str, dict[str, list[float]]]:
    """Run the command that the page states beside a measurement; return its words, and what both gave, by name."""
    words = opened.page.locator("#measures li").nth(number).inner_text()
    command = shlex.split(words[words.index("scopemap measure") :])
    given = dict(zip(command[3::2], command[4::2], strict=True))
    pixels = {name: np.array([p.split(",") for p in given[name].split()], float) for name in given if "m" not in name}
    reference, mm = pixels.get("--reference"), given.get("--reference-mm")
    frame = int(given["--frame"])
    exact = measure(folder / command[2], frame, pixels["--points"], reference, None if mm is None else float(mm))
    # The page does not say what makes an interval wide.
    assert words.startswith(f"Frame {frame}: " + "; ".join(str(replace(one, why="")) for one in exact))
    rows = csv.DictReader(opened.page.locator("#csv").input_value().splitlines())
    found = {row["what"]: row for row in rows if row["number"] == str(number + 1)}
    for one in exact:
        # As few digits as the interval is worth.
        assert [found[one.what][end] for end in _ENDS] == [f"{float(f'{getattr(one, end):.3g}'):.15g}" for end in _ENDS]
    values = {one["what"]: one for one in saved(opened)[number]["found"]}
    return words, {one.what: [values[one.what][end] / getattr(one, end) for end in _ENDS] for one in exact}


def saved(opened: Opened) -> list[dict[str, Any]]:
    """Return what the page hands over as JSON, with all digits."""
    with opened.page.expect_download() as download:
        opened.page.locator("#save-json").click()
    return list(json.loads(Path(download.value.path()).read_text(encoding="utf-8")))


def click(opened: Opened, selector: str, *shares: tuple[float, float]) -> None:
    box = opened.page.locator(selector).bounding_box()
    for x, y in shares:
        opened.page.locator(selector).click(position={"x": x * box["width"], "y": y * box["height"]})
        opened.page.wait_for_timeout(100)


def test_measuring_by_hand_agrees_with_the_command(browser: Any, tmp_path: Path) -> None:
    folder = draw_run(tmp_path, scale={"known": True, "measured": True, "source": "measured depth"})
    opened = Opened(browser, write_report(folder)[0])
    opened.slide(6)
    assert opened.text("#scene-scale") == "10 mm at the middle of the surface"
    opened.page.locator("#look").select_option("through")
    opened.page.wait_for_timeout(100)
    assert opened.text("#scene-scale").endswith(" mm at 21 mm")
    opened.page.locator("#look").select_option("overview")
    has_bar = "canvases => canvases.map(c => c.getContext('2d').getImageData(12, 230, 1, 1).data[0])"
    assert opened.page.locator("#submap-list canvas").evaluate_all(has_bar) == [255, 255]
    near, _, far = (float(number) for number in opened.page.locator("#depth-note i").all_inner_texts())
    assert 0 < near < far < 90
    assert opened.page.locator("footer a").first.get_attribute("href") == "summary.png"
    opened.page.locator("#pick-distance").click()
    click(opened, "#video", (0.3, 0.4), (0.62, 0.7))
    opened.wait("measures", "1")
    opened.page.locator("#pick-area").click()
    click(opened, "#depth", (0.4, 0.2), (0.6, 0.3), (0.63, 0.5), (0.5, 0.4))
    opened.page.keyboard.press("Enter")
    opened.wait("measures", "2")
    opened.page.locator("#pick-distance").click()
    click(opened, "#scene", (0.45, 0.5), (0.55, 0.56))
    opened.wait("measures", "3")
    opened.page.locator("#pick-reference").click()
    click(opened, "#rendered", (0.35, 0.6), (0.45, 0.7))
    opened.page.locator("#reference-mm").fill("5")
    opened.page.locator("#pick-area").click()
    click(opened, "#residual", (0.4, 0.2), (0.6, 0.3), (0.55, 0.5))
    opened.page.locator("#close-area").click()
    opened.wait("measures", "4")
    for number in range(4):
        words, ratios = measured_in_both(opened, folder, number)
        assert ("--reference-mm 5" in words) == (number == 3)
        assert set(ratios) == ({"area"} if number in (1, 3) else {"straight", "along the surface"})
        np.testing.assert_allclose(list(ratios.values()), 1, rtol=1e-9)
    with opened.page.expect_download() as kept:
        opened.page.locator("#save-json").click()
    kept.value.save_as(folder / "measurements.json")
    assert len(json.loads((folder / "measurements.json").read_text())) == 4
    again = Opened(browser, write_report(folder)[0])
    assert again.page.locator("#measures li").all_inner_texts() == opened.page.locator("#measures li").all_inner_texts()
    assert opened.complaints == again.complaints == []


def test_what_is_not_measurable_and_cards_of_segments_are_whole_sentences(browser: Any, tmp_path: Path) -> None:
    from test_browser_segments import in_two_segments

    folder = in_two_segments(draw_run(tmp_path))
    height = {"what": "height", "value": 0.4716, "low": 0.0, "high": 10.912345, "unit": "mm"}
    kept = {"kind": "lesion", "name": "Polyp", "folder": ".", "frame": 4, "points": [[1, 2]], "reference": None}
    kept |= {"reference_mm": None, "found": [height], "command": "", "world": [[0, 0, 1]]}
    keep_measurements(folder, json.dumps([kept]).encode())
    opened = Opened(browser, write_report(folder)[0])
    assert "Polyp, frame 4: height: not measurable (0 to 10.9 mm)" in opened.text("#measures li")
    assert '"0.472","0","10.9","mm"' in opened.page.locator("#csv").input_value()
    cards = opened.page.locator("#submap-list small").all_inner_texts()
    assert len(cards) == 3  # the result, its other submap, its other segment
    assert not any(card.rstrip().endswith(",") or ", ," in card for card in cards)
    assert opened.complaints == []


def test_points_on_the_surface_are_measured_where_a_frame_sees_the_reference_too(browser: Any, tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    opened = Opened(browser, write_report(folder)[0])
    opened.page.locator("#pick-reference").click()
    click(opened, "#video", (0.3, 0.7), (0.4, 0.6))
    opened.slide(IN_RESULT - 1)
    opened.page.locator("#pick-distance").click()
    click(opened, "#scene", (0.45, 0.5), (0.55, 0.56))
    opened.wait("measures", "1")
    _, ratios = measured_in_both(opened, folder, 0)
    np.testing.assert_allclose(list(ratios.values()), 1, rtol=1e-9)
    # Where a submap lies beside another one is unknown: neither the reference nor a first point counts there.
    click(opened, "#video", (0.3, 0.4))
    opened.slide(FRAMES - 1)
    click(opened, "#video", (0.3, 0.4))
    assert opened.text("#hand-note") == "1 point"
    click(opened, "#video", (0.62, 0.7))
    assert opened.text("#hand-note") == "Not measured: this frame does not see the reference."
    assert opened.complaints == []


def test_blind_spots_are_listed_and_shown(browser: Any, tmp_path: Path) -> None:
    page = write_report(draw_run(tmp_path))[0]
    assert not Opened(browser, page).page.locator("#coverage").is_visible()
    assert call("coverage", tmp_path) == 0
    facts, opened = json.loads((tmp_path / "coverage" / "coverage.json").read_text()), Opened(browser, page)
    assert opened.text("#coverage-share").startswith(
        f"Not seen: {100 * facts['total']['share']:.0f} % (90 % interval: "
    )
    assert opened.page.locator("#coverage-map").evaluate("image => image.naturalWidth") == 900
    row, before = facts["blind_spots"][0]["frame"], opened.picture("#scene")
    opened.page.locator("#spot-list button").first.click()
    opened.wait("shown", str(row))
    assert np.abs(opened.picture("#scene") - before).max() > 100  # a cross on the surface
    assert opened.complaints == []


def test_without_a_scale_a_reference_is_the_unit(browser: Any, tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    opened = Opened(browser, write_report(folder)[0])
    opened.slide(FRAMES - 1)  # in maps/1
    opened.page.locator("#pick-distance").click()
    assert opened.text("#hand-note").startswith("Sizes are unknown: first choose Reference")
    opened.page.locator("#pick-reference").click()
    click(opened, "#video", (0.3, 0.7), (0.36, 0.64))
    assert re.search(r"reference is \d\.\d px long: 10 px are needed", opened.text("#hand-note"))
    click(opened, "#video", (0.3, 0.7), (0.4, 0.6))
    opened.page.locator("#pick-distance").click()
    click(opened, "#video", (0.3, 0.4), (0.62, 0.7))
    opened.wait("measures", "1")
    told = opened.text("#hand-note")
    words, ratios = measured_in_both(opened, folder, 0)
    # What was found is said where it is seen without scrolling.
    assert words.startswith(told)
    note = opened.page.locator("#hand-note").bounding_box()
    assert 0 < note["y"] < note["y"] + note["height"] < DESKTOP[1]
    assert "scopemap measure maps/1" in words
    assert "times the reference" in words
    np.testing.assert_allclose(list(ratios.values()), 1, rtol=1e-9)
    with opened.page.expect_download() as download:
        opened.page.locator("#save-json").click()
    keep_measurements(folder, Path(download.value.path()).read_bytes())
    assert json.loads((folder / "measurements.json").read_text())[0]["folder"] == "maps/1"
    again = Opened(browser, write_report(folder)[0])
    assert again.page.locator("#measures li").all_inner_texts() == [words]
    with pytest.raises(InputError, match="no list of measurements"):
        keep_measurements(folder, b"{}")
