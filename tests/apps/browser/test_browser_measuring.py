"""Measuring in the window: what is listed is sent as a table and removed, and a measured distance is the reference."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

from scopemap.apps.browser.result_page import ResultPage
from scopemap.report.measured_by_hand import read_measurements
from tests.apps.browser.test_browser_result_page import KNOWN, click
from tests.support.drawn_run import draw_run
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
