"""Measuring in the window: references, lesions, what is listed is sent as a table and removed."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from scopemap.apps.browser.result_page import ResultPage
from scopemap.report.measured_by_hand import read_measurements
from tests.apps.browser.test_browser_result_page import KNOWN, click
from tests.support.drawn_run import draw_run
from tests.support.front_door import call
from tests.support.shown_window import shown_window

pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")


def test_any_measurement_is_removed_and_all_are_sent_as_a_table(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, scale=KNOWN)
    page = ResultPage(folder)
    with shown_window() as shown:
        shown.show(page)
        shown.choose("ButtonGroup", "Measure", "Distance")
        for number, pixel in enumerate(((60.0, 44.0), (50.0, 40.0)), 1):
            click(shown, page, (20.0, 20.0))
            click(shown, page, pixel)
            shown.until(lambda number=number: len(read_measurements(folder)) == number)  # type: ignore[misc]
        first, second = read_measurements(folder)
        shown.until(lambda: "/page/measured/1/words" in shown.nodes)
        shown.press("Download as a table")
        rows = list(csv.DictReader(io.StringIO(shown.sent["measurements.csv"].decode())))
        assert [(row["number"], row["what"]) for row in rows[::2]] == [("1", "straight"), ("2", "straight")]
        value = second["found"][0]["value"]
        assert rows[2]["value"] == f"{value:.3g}"
        assert rows[2]["pixels"] == " ".join(f"{x},{y}" for x, y in second["points"])
        shown.press("Remove 1")
        assert read_measurements(folder) == [second] != [first]
        assert "/page/measured/1/words" not in shown.nodes
        assert shown.nodes["/page/measured/0/words"].text.startswith(f"{value:.2g} (")
        shown.press("Remove 1")
        assert read_measurements(folder) == []
        assert "/page/measured/0/words" not in shown.nodes
        assert "Remove 1" not in shown.labels()


def test_a_measured_distance_becomes_the_reference_where_sizes_are_known(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, scale=KNOWN)
    page = ResultPage(folder)
    with shown_window() as shown:
        shown.show(page)
        shown.choose("ButtonGroup", "Measure", "Distance")
        # Too short for a reference, which is said at once.
        for pixel in ((24.0, 45.0), (28.0, 45.0)):
            click(shown, page, pixel)
        shown.until(lambda: len(read_measurements(folder)) == 1)
        shown.element("Text", "Length of this line").value = "5"
        shown.press("Use as reference")
        assert "10 px are needed" in shown.window._error.content
        assert len(read_measurements(folder)) == 1
        for pixel in ((24.0, 45.0), (40.0, 45.0)):
            click(shown, page, pixel)
        shown.until(lambda: len(read_measurements(folder)) == 2)
        shown.element("Text", "Length of this line").value = "5"
        shown.press("Use as reference")
        assert "Sizes are in mm by your reference (5 mm)." in shown.words
        click(shown, page, (20.0, 20.0))
        click(shown, page, (60.0, 44.0))
        shown.until(lambda: "--reference-mm 5" in shown.words)
        # Sizes by a reference that was forgotten say so, on the surface and in the table.
        shown.until(lambda: shown.nodes["/page/measured/2/words"].text.endswith(") mm"))
        shown.press("Forget the reference")
        assert shown.nodes["/page/measured/2/words"].text.endswith(") mm, by an earlier reference")
        assert shown.nodes["/page/measured/1/words"].text.endswith(") mm")
        shown.press("Download as a table")
        rows = list(csv.DictReader(io.StringIO(shown.sent["measurements.csv"].decode())))
        assert {(row["number"], row["note"]) for row in rows} == {
            ("1", ""),
            ("2", ""),
            ("3", "by an earlier reference"),
        }


def test_without_a_scale_two_points_become_the_reference(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    page = ResultPage(folder)
    with shown_window() as shown:
        shown.show(page)
        shown.choose("ButtonGroup", "Measure", "Distance")
        click(shown, page, (24.0, 45.0))
        click(shown, page, (40.0, 45.0))
        assert shown.next_click.startswith("Distance: press Use as reference")
        assert "Sizes are unknown: compare shapes" in shown.words
        shown.element("Text", "Length of this line").value = "5"
        shown.press("Use as reference")
        assert "Sizes are in mm by your reference (5 mm)." in shown.words
        assert "Sizes are unknown" not in shown.words
        assert shown.nodes["/page/reference/words"].text == "5 mm"
        # It is there when the result is opened again.
        page = ResultPage(folder)
        shown.show(page)
        assert "Sizes are in mm by your reference (5 mm)." in shown.words
        assert shown.nodes["/page/reference/words"].text == "5 mm"
        shown.choose("ButtonGroup", "Measure", "Area")
        for pixel in ((20.0, 20.0), (60.0, 20.0), (60.0, 44.0)):
            click(shown, page, pixel)
        shown.press("Measure the area")
        shown.until(lambda: "--reference-mm 5" in shown.words)
        assert "mm²" in shown.words
        assert "mm2" not in shown.words
        assert "by an earlier reference" not in shown.words
        # Another reference: what was measured by the one before is marked.
        shown.choose("ButtonGroup", "Measure", "Distance")
        shown.press("Forget the reference")
        assert "Forget the reference" not in shown.labels()
        assert "The reference is forgotten." in shown.words
        assert "/page/reference/words" not in shown.nodes
        for pixel in ((24.0, 45.0), (44.0, 45.0)):
            click(shown, page, pixel)
        shown.element("Text", "Length of this line").value = "five"
        shown.press("Use as reference")
        assert "Type the length in mm, such as 2.5." in shown.words
        # Without a length it is not a reference by oversight.
        shown.element("Text", "Length of this line").value = ""
        shown.press("Use as reference")
        assert "If it is not known, press again" in shown.words
        assert "/page/reference/words" not in shown.nodes
        shown.press("Use as reference")
        assert "Sizes are in multiples of your reference." in shown.words
        assert "by an earlier reference" in shown.words
        assert shown.nodes["/page/reference/words"].text == "reference"


def test_a_lesion_is_that_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = draw_run(tmp_path, scale=KNOWN)
    page = ResultPage(folder)
    with shown_window() as shown:
        shown.show(page)
        shown.choose("Slider", "Frame", 4)
        shown.choose("ButtonGroup", "Measure", "Lesion")
        assert "the view is now that of frame 4" in shown.words
        corners = ((52.0, 26.0), (64.0, 26.0), (64.0, 38.0), (52.0, 38.0))
        for pixel in corners:
            click(shown, page, pixel)
        # What takes points back stays in its place when there are none.
        shown.choose("ButtonGroup", "Points", "Clear")
        assert shown.element("ButtonGroup", "Points").visible
        for pixel in corners:
            click(shown, page, pixel)
        shown.choose("Text", "Name of the lesion", "polyp 1")
        shown.press("Measure the lesion")
        shown.until(lambda: "largest diameter" in shown.words)
        outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        assert f'--lesion "{outline}"' in shown.words
        capsys.readouterr()
        assert call("measure", folder, "--frame", 4, "--lesion", outline, "--json") == 0
        facts = json.loads(capsys.readouterr().out)["measures"]
        # It is kept by its name, and there when the result is opened again.
        (kept,) = read_measurements(folder)
        assert (kept["kind"], kept["name"], kept["found"]) == ("lesion", "polyp 1", facts)
        shown.show(ResultPage(folder))
        assert f"1. polyp 1 (frame 4)\n- {facts[0]['what']}: " in shown.words
        assert shown.nodes["/page/measured/0/words"].text.startswith("polyp 1: ")
