"""The page of a result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from scopemap.apps.browser.workspace import Workspace
from scopemap.result.result import Result
from scopemap.result.verdict import verdict

if TYPE_CHECKING:
    from scopemap.apps.browser.window import Window


class ResultPage:
    """A result; workspace : where runs are started from here, None: nowhere."""

    def __init__(self, folder: Path, workspace: Workspace | None = None) -> None:
        self._run, self._workspace = Result(folder).checked(), workspace

    def open(self, window: Window) -> None:
        """Make the elements."""
        found = verdict(self._run)
        window.gui.add_markdown(f"### {found.word.capitalize()}\n\n{found.advice}")

    def tick(self) -> None:
        """Nothing changes by itself."""

    def close(self) -> None:
        """Nothing was begun."""
