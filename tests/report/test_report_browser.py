"""The report's page in a real browser without a display: what is drawn, what moves, what is asked of a network."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.report.page import keep_measurements, write_comparison, write_report
from scopemap.result.result import Result
from tests.support.drawn_run import FRAMES, IN_FIRST_MAP, IN_RESULT, draw_run, draw_textured_run, drawn_result, pose_of
from tests.support.opened_page import DESKTOP, IN_A_BROWSER, PHONE, Opened, chromium

pytestmark = IN_A_BROWSER
LIGHT_GROUND, DARK_GROUND = (0xE4, 0xE9, 0xF0), (0x0A, 0x0F, 0x15)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(draw_run(tmp_path_factory.mktemp("run")))[0]


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


def test_reasons_are_in_plain_words_with_options_in_a_small_line(browser: Any, tmp_path: Path) -> None:
    camera = drawn_result().provenance["camera"] | {"source": "70 deg", "origin": "assumed"}
    opened = Opened(browser, write_report(draw_run(tmp_path, camera=camera))[0])
    lens = opened.page.locator("#reasons li", has_text="The lens is assumed")
    plain, exact = lens.inner_text().split("\n")
    assert plain.endswith("the ratio of depth to width may be wrong. Calibrate.")
    assert exact == "Files and options: Calibrate (--camera), or run again with --fov or --scope."
    assert lens.locator("small").inner_text() == exact
    reasons = opened.page.locator("#reasons li").all()
    assert len(reasons) > 2
    for reason in reasons:
        assert not any(word in reason.inner_text().split("\n")[0] for word in ("--", ".csv"))
    assert opened.complaints == []


def test_sizes_by_a_reference_that_was_forgotten_are_marked(browser: Any, tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    corners, by_own = [[[20.0, 20.0], [60.0, 44.0]], None], [[[24.0, 45.0], [40.0, 45.0]], 5.0]
    found = [{"what": "straight", "value": 18.2, "low": 16.0, "high": 21.0, "unit": "mm"}]
    both = [
        {"folder": ".", "frame": 4, "points": corners[0], "reference": ends, "reference_mm": length_mm}
        | {"found": found, "command": "", "world": [[0.0, 0.0, 40.0], [5.0, 0.0, 40.0]]}
        for ends, length_mm in (corners[1:] * 2, by_own)
    ]
    keep_measurements(folder, json.dumps(both).encode())
    opened = Opened(browser, write_report(folder)[0])
    rows = opened.page.locator("#measured tbody tr")
    assert rows.nth(0).inner_text().startswith("1. Distance, frame 4\t")
    assert rows.nth(1).locator("th").inner_text() == "2. Distance, frame 4 by an earlier reference"
    assert rows.locator("nth=0").get_attribute("class") in (None, "")
    assert rows.nth(1).get_attribute("class") == "earlier"


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
