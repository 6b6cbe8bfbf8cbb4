"""Measuring by hand in the report's page, in a real browser: what it finds, keeps and lists."""

from __future__ import annotations

import csv
import json
import re
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_run import FRAMES, IN_RESULT, draw_run
from front_door import call
from test_report_browser import CHROMIUM, DESKTOP, Opened, chromium

from scopemap.apps.measure.measure import measure
from scopemap.engine.errors import InputError
from scopemap.report.page import keep_measurements, write_report

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)")
_ENDS = ("value", "low", "high")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


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
