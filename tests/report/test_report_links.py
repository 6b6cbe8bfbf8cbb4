"""The report's page in a real browser: what was measured, blind spots, and the links of the surface and its frames."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.report.page import keep_measurements, write_report
from tests.support.drawn_run import CAMERA, IN_RESULT, draw_run, pose_of, tube
from tests.support.front_door import call
from tests.support.opened_page import IN_A_BROWSER, Opened, chromium

pytestmark = IN_A_BROWSER
HAND = (0x10, 0x10, 0x10)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


def click(opened: Opened, selector: str, x: float, y: float) -> None:
    box = opened.page.locator(selector).bounding_box()
    opened.page.locator(selector).click(position={"x": x * box["width"], "y": y * box["height"]})
    opened.page.wait_for_timeout(200)


def until(condition: Callable[[], bool], what: str) -> None:
    """Wait for a condition; what : it is, for the error."""
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end, f"not within 30 s: {what}"
        time.sleep(0.05)


def marked(opened: Opened, selector: str) -> int:
    """How many pixels of an element have the colour of marks."""
    return int((np.abs(opened.picture(selector) - HAND).max(-1) < 12).sum())


def shown_at(picture: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Where a pixel (2,) of a frame is in what is seen of its picture, px: as large as fits in the middle."""
    size, camera = np.array(picture.shape[1::-1]), np.array([CAMERA.width, CAMERA.height])
    scale = (size / camera).min()
    return np.asarray((size - scale * camera) / 2 + scale * (pixel + 0.5))


def middle_of_change(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Where two pictures differ much, in the mean, px."""
    rows, columns = np.nonzero(np.abs(after - before).max(-1) > 60)
    return float(columns.mean()), float(rows.mean())


def test_a_click_on_the_surface_shows_the_nearest_frame_that_saw_the_place(browser: Any, tmp_path: Path) -> None:
    opened = Opened(browser, write_report(draw_run(tmp_path))[0])
    opened.slide(4)
    opened.page.locator("#look").select_option("through")
    opened.page.wait_for_timeout(200)
    before = marked(opened, "#scene")
    click(opened, "#scene", 0.7, 0.45)
    said, _, number = opened.text("#place-note").rstrip(".").rpartition(" ")
    assert said == "The nearest frame that saw this place is"
    frame = int(number)
    # Later cameras are nearer; those of the other submap are elsewhere.
    assert 4 < frame < IN_RESULT
    opened.wait("shown", str(frame))
    opened.page.locator("#look").select_option("overview")
    until(lambda: marked(opened, "#scene") > before, "the mark")
    # Beside the surface there is nothing, and the mark goes.
    click(opened, "#scene", 0.01, 0.01)
    assert opened.text("#place-note") == "There is no surface here."
    assert opened.complaints == []


def test_a_click_on_a_picture_marks_the_place_on_the_surface(browser: Any, tmp_path: Path) -> None:
    opened = Opened(browser, write_report(draw_run(tmp_path))[0])
    opened.slide(12)
    later = opened.picture("#video")
    opened.slide(6)
    scene, pictures = opened.picture("#scene"), [opened.picture(f"#{name}") for name in ("video", "depth")]
    pixel = np.array([55.0, 44.0])
    clicked = shown_at(later, pixel)
    click(opened, "#depth", *(clicked / later.shape[1::-1]))
    assert opened.text("#place-note") == ""
    assert np.abs(opened.picture("#scene") - scene).max() > 100
    for name, before in zip(("video", "depth"), pictures, strict=True):
        np.testing.assert_allclose(middle_of_change(before, opened.picture(f"#{name}")), clicked, atol=4)
    # In a later frame the same place is at another pixel.
    opened.slide(12)
    depth_mm = render_mesh(tube(), CAMERA, pose_of(6)).depth_mm[44, 55]
    place = transform(inverse(pose_of(12)) @ pose_of(6), CAMERA.unproject(pixel)[None] * depth_mm)
    expected = shown_at(later, CAMERA.project(place)[0])
    assert np.abs(expected - clicked).max() > 8
    np.testing.assert_allclose(middle_of_change(later, opened.picture("#video")), expected, atol=4)
    # Of a lost frame it is unknown where it looks.
    opened.slide(IN_RESULT)
    click(opened, "#video", 0.5, 0.7)
    assert opened.text("#place-note") == "This frame has no pose: where it looks is unknown."
    assert opened.complaints == []


def test_the_page_says_where_to_measure_and_does_not(browser: Any, tmp_path: Path) -> None:
    opened = Opened(browser, write_report(draw_run(tmp_path))[0])
    assert "open this result in the window: run scopemap view" in opened.text("#by-hand")
    assert not opened.page.locator("#measured").is_visible()
    assert not opened.page.locator("#by-hand :is(button, input, textarea)").count()


def test_lengths_have_scale_bars_where_sizes_are_known(browser: Any, tmp_path: Path) -> None:
    folder = draw_run(tmp_path, scale={"known": True, "measured": True, "source": "measured depth"})
    opened = Opened(browser, write_report(folder)[0])
    opened.slide(6)
    assert opened.text("#scene-scale") == "10 mm at the middle of the surface"
    opened.page.locator("#look").select_option("through")
    until(lambda: opened.text("#scene-scale").endswith(" mm at 21 mm"), "the scale at the frame's depth")
    has_bar = "canvases => canvases.map(c => c.getContext('2d').getImageData(12, 230, 1, 1).data[0])"
    assert opened.page.locator("#submap-list canvas").evaluate_all(has_bar) == [255, 255]
    near, _, far = (float(number) for number in opened.page.locator("#depth-note i").all_inner_texts())
    assert 0 < near < far < 90
    assert opened.page.locator("footer a").first.get_attribute("href") == "summary.png"
    assert opened.complaints == []


def test_only_a_list_of_measurements_is_kept(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    with pytest.raises(InputError, match="no list of measurements"):
        keep_measurements(folder, b"{}")


def test_what_is_not_measurable_and_cards_of_segments_are_whole_sentences(browser: Any, tmp_path: Path) -> None:
    from tests.apps.browser.test_browser_segments import in_two_segments

    folder = in_two_segments(draw_run(tmp_path))
    height = {"what": "height", "value": 0.4716, "low": 0.0, "high": 10.912345, "unit": "mm"}
    kept = {"kind": "lesion", "name": "Polyp", "folder": ".", "frame": 4, "points": [[1, 2]], "reference": None}
    kept |= {"reference_mm": None, "found": [height], "command": "", "world": [[0, 0, 1]]}
    keep_measurements(folder, json.dumps([kept]).encode())
    opened = Opened(browser, write_report(folder)[0])
    assert opened.page.locator("#measured tbody tr").all_inner_texts() == [
        "1. Polyp, frame 4\theight\tnot measurable\t0 to 10.9 mm"
    ]
    cards = opened.page.locator("#submap-list small").all_inner_texts()
    assert len(cards) == 3  # the result, its other submap, its other segment
    assert not any(card.rstrip().endswith(",") or ", ," in card for card in cards)
    assert opened.complaints == []


def test_blind_spots_are_listed_and_shown(browser: Any, tmp_path: Path) -> None:
    page = write_report(draw_run(tmp_path))[0]
    assert not Opened(browser, page).page.locator("#coverage").is_visible()
    assert call("coverage", tmp_path) == 0
    facts, opened = json.loads((tmp_path / "coverage" / "coverage.json").read_text()), Opened(browser, page)
    assert opened.text("#coverage-share") == facts["statement"]
    largest = min(100.0, 100 * facts["blind_spots"][0]["area"] / (facts["total"]["share"] * facts["total"]["area"]))
    first = opened.page.locator("#spot-list button").first.inner_text()
    assert first.startswith(f"1. {largest:.0f} % of what was not seen, at ")
    assert "unit" not in first  # the scale is unknown
    assert opened.page.locator("#spot-words").is_visible()
    assert opened.page.locator("#coverage-map").evaluate("image => image.naturalWidth") == 960
    row, before = facts["blind_spots"][0]["frame"], opened.picture("#scene")
    opened.page.locator("#spot-list button").first.click()
    opened.wait("shown", str(row))
    assert np.abs(opened.picture("#scene") - before).max() > 100  # a cross on the surface
    assert opened.complaints == []
    # Of a cavity without blind spots no list is offered, and no colon is named.
    facts |= {"kind": "cavity", "blind_spots": []}
    (tmp_path / "coverage" / "coverage.json").write_text(json.dumps(facts))
    opened = Opened(browser, write_report(tmp_path)[0])
    assert not opened.page.locator("#spot-words").is_visible()
    assert "synthetic cavities" in opened.text("#coverage-basis")
