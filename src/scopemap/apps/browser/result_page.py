"""The page of a result: whether it can be trusted, its surface, its frames, sizes, what was not seen, and its files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scopemap.apps.browser.files_part import FilesPart
from scopemap.apps.browser.frame_images import FrameImages
from scopemap.apps.browser.frame_part import FramePart
from scopemap.apps.browser.measure_part import MeasurePart
from scopemap.apps.browser.next_steps import NextRun, arguments_again
from scopemap.apps.browser.run_page import RunPage
from scopemap.apps.browser.shown_result import ShownResult
from scopemap.apps.browser.surface_part import SurfacePart
from scopemap.apps.browser.unseen_part import UnseenPart
from scopemap.apps.browser.verdict_part import VerdictPart
from scopemap.apps.browser.workspace import in_time
from scopemap.result.result import Result
from scopemap.result.run_input import find_input
from scopemap.result.run_view import view_folder

if TYPE_CHECKING:
    from viser import SceneClickEvent

    from scopemap.apps.browser.window import BrowserWindow
    from scopemap.apps.browser.workspace import Workspace

_BACK = "Back to the start"
_WHOLE = "Whole surface"
_STOP = "Stop measuring"


class ResultPage:
    """A finished result; workspace : where runs are started from here, None: nowhere."""

    def __init__(self, folder: Path, workspace: Workspace | None = None) -> None:
        self._run, self._workspace = Result(folder).checked(), workspace
        self._frames: FramePart | None = None

    def open(self, window: BrowserWindow) -> None:
        """Make the elements."""
        self._window, gui = window, window.gui
        self._shown = shown = ShownResult(window, self._run, self._workspace)
        shown.add_headline()
        shown.add_note()
        self._ways = gui.add_button_group("", self._ways_now())
        self._ways.on_click(lambda event: window.do(self._go, self._ways.value))
        shown.follow(measuring=self._show_ways)
        images, tabs = FrameImages(shown), gui.add_tab_group()
        with tabs.add_tab("Verdict"):
            VerdictPart(shown, self._run_again)
            self._add_ways_on()
        with tabs.add_tab("Surface"):
            SurfacePart(shown)
            gui.add_divider()
            UnseenPart(shown)
        with tabs.add_tab("Frames"):
            self._frames = FramePart(shown, images)
        with tabs.add_tab("Measure"):
            self._measure = MeasurePart(shown, images)
        with tabs.add_tab("Files"):
            FilesPart(shown)
        window.scene.on_click()(self._clicked)
        shown.show_row(shown.row)
        shown.look_at_all()

    def tick(self) -> None:
        """Nothing changes by itself."""

    def close(self) -> None:
        """End what plays, and what takes clicks."""
        self._window.scene.remove_click_callback(self._clicked)
        if self._frames is not None:
            self._frames.close()

    def _clicked(self, event: SceneClickEvent) -> None:
        """Take a click in the scene; called by a thread of the server."""
        self._window.do(self.click, np.array(event.ray_origin), np.array(event.ray_direction))

    def click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Take a click by its ray, (3,) each, in the world of the submap that is shown, mm."""
        ray, frames = self._measure.picture.ray(origin, direction), self._frames
        pick = None if ray is None else self._shown.surface.pick(*ray)
        assert frames is not None
        if pick is None:
            self._shown.note("There is no surface there.")
        elif self._measure.mode == "Look":
            frames.list_that_saw(pick)
        else:
            self._measure.add(pick)

    def _add_ways_on(self) -> None:
        """Make the buttons that lead to other pages."""
        workspace, gui, window = self._workspace, self._window.gui, self._window
        if workspace is None:
            return
        here = self._run.folder.resolve()
        others = {path.name: path for path in workspace.finished if path.resolve() != here}
        if others:
            names = list(others)
            titles = [f"result {n}" for n in range(1, len(names) + 1)] if window.anonymous else names
            chosen = gui.add_dropdown("Other result", titles)
            button = gui.add_button("Compare with it")
            window.on_button(button, lambda: self._compare(others[names[titles.index(chosen.value)]]))

    def _ways_now(self) -> tuple[str, ...]:
        # Not more than two: they stay in one row, and the tabs where they are.
        first = _WHOLE if self._workspace is None else _BACK
        return (first, _STOP) if self._shown.measuring else (first,)

    def _show_ways(self) -> None:
        if self._ways.options != self._ways_now():
            self._ways.options = self._ways_now()

    def _go(self, way: str) -> None:
        if way == _BACK:
            self._window.start()
        elif way == _WHOLE:
            self._shown.look_at_all()
        else:
            self._measure.stop()

    def _compare(self, other: Path) -> None:
        from scopemap.apps.browser.compare_page import ComparePage

        self._window.show(ComparePage(*in_time(self._run.folder, other)))

    def _run_again(self, again: NextRun, value: str) -> None:
        """Start this run with one more option, and show it."""
        workspace, window = self._workspace, self._window
        assert workspace is not None
        source = find_input(self._run.folder)
        arguments = [*arguments_again(self._run, again.option), *again.arguments(value)]
        run = workspace.reconstruct(source, arguments)
        page = RunPage(
            run,
            view_folder(run.out),
            again.label(value) if window.anonymous else f"{source.name}, {again.label(value).lower()}",
            lambda: window.show(ResultPage(run.out, workspace)),
            lambda: window.show(ResultPage(self._run.folder, workspace)),
            lambda: workspace.runs.place(run),
        )
        window.show(page)
