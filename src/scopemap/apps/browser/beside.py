"""The run of another command, seen from the window that this process is, and what its buttons are called."""

from __future__ import annotations

import sys
import threading
from contextlib import suppress

from scopemap.terminal.window_beside import DONE, FAILED, lines_of_input

LIVE_BUTTONS = {"Pause or go on": "pause", "Forget all and start again": "reset", "Write a snapshot": "snapshot"}
"""Of a live stream: names of what they do by what is written on them."""


class RunBeside:
    """The run of the command that this process is the window of; `WatchedRun` for its page."""

    printed = ""

    def __init__(self) -> None:
        self.status, self.sentence = "running", "the command has ended"
        self.is_gone = False
        """Whether the command is no more."""
        threading.Thread(target=self._listen, name="command", daemon=True).start()

    def poll(self) -> None:
        """Nothing is to be looked at: the command tells."""

    def press(self, button: str) -> None:
        """Tell the command that a button was pressed."""
        with suppress(OSError):
            sys.stdout.write(f"{button}\n")
            sys.stdout.flush()

    def stop(self) -> None:
        """Ask the command to end and write what it has."""
        self.press("stop")

    def _listen(self) -> None:
        for line in lines_of_input():
            if line.strip() == DONE:
                self.status = "done"
            elif line.startswith(FAILED):
                self.sentence, self.status = line.removeprefix(FAILED).strip(), "failed"
        self.is_gone = True
