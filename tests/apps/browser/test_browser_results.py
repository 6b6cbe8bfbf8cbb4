"""The list of results on the first page: which two are compared, in what order, and where messages stand."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from scopemap.apps.browser.start_page import StartPage
from scopemap.apps.browser.window import BrowserWindow
from scopemap.apps.browser.workspace import Workspace
from tests.support.drawn_run import draw_run
from tests.support.window_without_browser import element, elements, press, settle, start_page


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[tuple[BrowserWindow, Workspace]]:
    with start_page(tmp_path) as found:
        yield found


def test_the_result_to_compare_with_is_another_one(
    opened: tuple[BrowserWindow, Workspace], monkeypatch: pytest.MonkeyPatch
) -> None:
    window, workspace = opened
    for day, name in enumerate(("third", "first", "second")):
        folder = draw_run(workspace.folder / name, name=f"{name}.mp4")
        os.utime(folder / "provenance.json", (1e9 + 1e5 * day,) * 2)
    window.show(StartPage(workspace))
    settle(window)
    labels = {label.partition(",")[0]: label for label in element(window, "Result").options}

    def other() -> list[str]:
        return [label.partition(",")[0] for label in element(window, "Compare with").options]

    assert element(window, "Result").value == labels["second"]  # the latest
    assert other() == ["first", "third"]
    assert element(window, "Compare with").value == labels["first"]
    press(window, "Result", labels["first"])
    assert other() == ["second", "third"]
    assert element(window, "Compare with").value == labels["second"]
    press(window, "Compare with", labels["third"])
    press(window, "Result", labels["second"])
    assert (other(), element(window, "Compare with").value) == (["first", "third"], labels["third"])
    # The result that was made earlier is the first, whatever was chosen where.
    asked: list[tuple[Path, ...]] = []
    monkeypatch.setattr(
        "scopemap.apps.browser.compare_page.ComparePage",
        lambda *folders: (asked.append(folders), StartPage(workspace))[1],
    )
    press(window, "Compare the two")
    assert asked == [(workspace.folder / "third", workspace.folder / "second")]


def test_a_message_stands_below_the_button_that_was_pressed(opened: tuple[BrowserWindow, Workspace]) -> None:
    window, workspace = opened
    for name in ("one", "other"):
        draw_run(workspace.folder / name)
    window.show(StartPage(workspace))
    settle(window)
    for name in ("one", "other"):
        (workspace.folder / name / "frames.csv").unlink()

    def below(label: str) -> str:
        shown = elements(window)
        return str(getattr(shown[shown.index(element(window, label)) + 1], "content", ""))

    press(window, "Compare the two")
    assert "frames" in below("Compare the two")
    assert not window._error.visible
    press(window, "Choose this path")
    assert "type the path" in below("Choose this path")
