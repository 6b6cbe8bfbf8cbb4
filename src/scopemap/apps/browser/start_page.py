"""The first page: choose a video, see what it is, start the run."""

from __future__ import annotations

import shutil
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING

from scopemap.apps.browser.run_page import RunPage
from scopemap.apps.browser.workspace import Workspace
from scopemap.result.run_view import view_folder

if TYPE_CHECKING:
    from scopemap.apps.browser.window import Window


class StartPage:
    """Videos of the workspace, one that is sent, the demonstration; and results that are there."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace

    def open(self, window: Window) -> None:
        """Make the elements."""
        self._window, gui = window, window.gui
        gui.add_markdown("### A surface from an endoscope video")
        window.on(gui.add_button("Try the demonstration"), self._demo)

    def tick(self) -> None:
        """Nothing changes by itself."""

    def close(self) -> None:
        """Nothing was begun."""

    def _demo(self) -> None:
        clip = self._workspace.results / "demonstration"
        clip.mkdir(parents=True, exist_ok=True)
        for name in ("colon.mp4", "camera.yaml"):
            with as_file(files("scopemap.apps.demo") / "clip" / name) as packaged:
                shutil.copyfile(packaged, clip / name)
        self._start(clip / "colon.mp4", ["--camera", str(clip / "camera.yaml")])

    def _start(self, source: Path, arguments: list[str]) -> None:
        from scopemap.apps.browser.result_page import ResultPage

        run = self._workspace.reconstruct(source, arguments)
        back = lambda: self._window.show(StartPage(self._workspace))  # noqa: E731
        finished = lambda: self._window.show(ResultPage(run.out, self._workspace))  # noqa: E731
        page = RunPage(run, view_folder(run.out), source.name, finished, back, lambda: self._workspace.runs.place(run))
        self._window.show(page)
