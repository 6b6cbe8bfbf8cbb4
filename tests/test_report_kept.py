"""The report shows what was kept in the window: a lesion by its name, and the reference, which it goes on with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drawn_run import draw_run
from test_browser_measures import picked
from test_report_browser import Opened, browser, pytestmark  # noqa: F401

from scopemap.apps.browser.hand_measures import Reference, reference_as_kept
from scopemap.apps.browser.lesion_part import lesion_by_hand
from scopemap.apps.browser.shown_surface import ShownSurface
from scopemap.apps.measure.hand_measure import add_measurement
from scopemap.report.page import write_report
from scopemap.result.result import Result


def test_a_lesion_and_the_reference_are_in_the_report(browser: Any, tmp_path: Path) -> None:  # noqa: F811
    folder = draw_run(tmp_path)
    write_report(folder)
    surface = ShownSurface(Result(folder))
    first, second = picked(surface, (24.0, 45.0), (40.0, 45.0))
    reference = Reference((first, second), 5.0)
    add_measurement(folder, reference_as_kept(surface, reference))
    corners = picked(surface, (52.0, 26.0), (64.0, 26.0), (64.0, 38.0), (52.0, 38.0))
    add_measurement(folder, lesion_by_hand(surface, 4, corners, reference, "polyp at the fold"))
    opened = Opened(browser, folder / "report.html")
    known, lesion = opened.page.locator("#measures li").all_inner_texts()
    assert known.startswith("Reference, 5 mm long, in frame ")
    assert lesion.startswith("polyp at the fold, frame 4: largest diameter: ")
    assert "--lesion" in lesion
    assert opened.text("#advice").endswith("Sizes are in mm by your reference (5 mm).")
    # Without a reference it would ask for one first.
    opened.page.locator("#pick-distance").click()
    assert opened.page.locator("#pick-distance").get_attribute("aria-pressed") == "true"
    assert opened.page.input_value("#reference-mm") == "5"
