"""A live stream that the window reconstructs: `scopemap live` in a process of its own."""

from __future__ import annotations

import subprocess
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from scopemap.apps.browser.beside import LIVE_BUTTONS
from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.run_page import RunPage
from scopemap.apps.browser.runs import end_of, started
from scopemap.apps.browser.workspace import Workspace
from scopemap.engine.errors import InputError
from scopemap.result.run_view import view_folder

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_LOG = "live.log"


class LiveRun:
    """A session that is reconstructed as it comes, and written to `out` at its end; `WatchedRun` for its page.

    Lines on its standard input are names of what it does; where that ends, because this process does, it stops.
    """

    def __init__(self, source: str, out: Path, log: Path) -> None:
        self.status, self.out, self._log = "running", out, log
        words = ["live", "--watched", "--out", str(out), "--", source]
        self._process = started(words, log, subprocess.PIPE)

    @property
    def printed(self) -> str:
        """What it has printed so far, the end of it."""
        return end_of(self._log)

    @property
    def sentence(self) -> str:
        """Why it failed: the last line that it printed."""
        lines = [line for line in self.printed.splitlines() if line.strip()]
        return lines[-1].removeprefix("scopemap: ") if lines else "the session ended unexpectedly"

    def poll(self) -> None:
        """Look whether it has ended."""
        if self.status == "running" and (code := self._process.poll()) is not None:
            self.status = "done" if code == 0 else "failed"

    def press(self, name: str) -> None:
        """Have it do what a button names."""
        assert self._process.stdin is not None
        with suppress(OSError):  # it has ended
            self._process.stdin.write(f"{name}\n".encode())
            self._process.stdin.flush()

    def stop(self) -> None:
        """Ask it to end and write what it has."""
        self.press("stop")


def open_live(window: BrowserWindow, workspace: Workspace, source: str) -> None:
    """Reconstruct a live stream, and show it: the number of a camera, a device, or an address.

    Raises `InputError` where a run is going on: there is time for one alone.
    """
    if workspace.runs.running is not None:
        raise InputError("a run is going on, and a live stream needs the whole machine: wait until it has ended")
    workspace.results.mkdir(parents=True, exist_ok=True)
    out = workspace.new_result(Path("live"))
    run = LiveRun(source, out, workspace.logs / _LOG)

    def finished() -> None:
        window.show(ResultPage(out, workspace))

    buttons = {words: partial(run.press, name) for words, name in LIVE_BUTTONS.items()}
    window.show(RunPage(run, view_folder(out), "Live", finished, buttons=buttons))
