"""The report shows what was kept in the window: a lesion by its name, and the reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scopemap.apps.browser.hand_measures import Reference, reference_as_kept
from scopemap.apps.browser.lesion_part import lesion_by_hand
from scopemap.apps.browser.shown_surface import ShownSurface
from scopemap.apps.measure.hand_measure import add_measurement
from scopemap.report.page import write_report
from scopemap.result.result import Result
from tests.apps.browser.test_browser_measures import picked
from tests.report.test_report_browser import browser  # noqa: F401
from tests.report.test_report_links import shown_at
from tests.support.drawn_run import draw_run
from tests.support.opened_page import IN_A_BROWSER, Opened

pytestmark = IN_A_BROWSER


def test_a_lesion_and_the_reference_are_in_the_report(browser: Any, tmp_path: Path) -> None:  # noqa: F811
    folder = draw_run(tmp_path)
    write_report(folder)
    surface = ShownSurface(Result(folder))
    first, second = picked(surface, (24.0, 45.0), (40.0, 45.0))
    reference = Reference((first, second), 5.0)
    add_measurement(folder, reference_as_kept(surface, reference))
    corners = picked(surface, (52.0, 26.0), (64.0, 26.0), (64.0, 38.0), (52.0, 38.0))
    lesion = lesion_by_hand(surface, 4, corners, reference, "polyp at the fold")
    add_measurement(folder, lesion)
    opened = Opened(browser, folder / "report.html")
    assert opened.text("#advice").endswith("Sizes are in mm by your reference (5 mm).")
    rows = [text.split("\t") for text in opened.page.locator("#measured tbody tr").all_inner_texts()]
    assert rows[0][0].startswith("Reference, frame ")
    assert rows[0][1:] == ["length", "5 mm, as stated", ""]
    assert rows[1][:2] == ["1. polyp at the fold, frame 4", "largest diameter"]
    found = lesion.found[0]
    assert rows[1][2] == f"{found.value:.3g} mm"
    assert rows[1][3] == f"{found.low:.3g} to {found.high:.3g} mm, wide mainly because of {found.why}"
    assert opened.page.locator("#measured-command-list").text_content() == lesion.command(".")
    # Chosen, it is shown in its frame.
    plain = opened.picture("#scene")
    opened.page.locator("#measured button").nth(1).click()
    opened.wait("shown", "4")
    assert np.abs(opened.picture("#scene") - plain).max() > 100
    video = opened.picture("#video")
    x, y = np.round(shown_at(video, np.array([52.0, 32.0]))).astype(int)
    assert np.ptp(video[y, x - 5 : x + 6].max(-1)) > 60  # the outline's left side, white between black
    assert opened.complaints == []
