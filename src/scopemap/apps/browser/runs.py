"""Runs that the window starts: `scopemap run` in a process of its own, one at a time, the others wait in a queue."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Status = Literal["waiting", "running", "done", "failed", "stopped"]
_LOG = "run.log"
_MOST_LOG = 20_000
_PATIENCE_S = 10.0
_STOPPED = (130, 143)
"""Exit codes of a run that was stopped, and wrote what it had."""


@dataclass(eq=False)
class BrowserRun:
    """A run of `scopemap run INPUT --out OUT` with further arguments.

    log : file that takes what it prints. status : where it is.
    """

    source: Path
    out: Path
    arguments: tuple[str, ...]
    log: Path
    status: Status = "waiting"
    stopping: bool = False
    _process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    @property
    def command(self) -> str:
        """The command that does the same in a terminal."""
        return shlex.join(["scopemap", "run", str(self.source), "--out", str(self.out), *self.arguments])

    @property
    def printed(self) -> str:
        """What it has printed so far, the end of it."""
        return end_of(self.log)

    @property
    def sentence(self) -> str:
        """Why it failed: the last line that it printed."""
        lines = [line for line in self.printed.splitlines() if line.strip()]
        said = [line for line in lines if line.startswith("scopemap: ")]
        if said:
            return said[-1].removeprefix("scopemap: ")
        code = None if self._process is None else self._process.returncode
        return f"the run ended unexpectedly (exit code {code}); start it again: it goes on where it was"

    def start(self) -> None:
        """Start the process."""
        words = ["run", str(self.source), "--out", str(self.out), *self.arguments, "--watched"]
        self._process = started(words, self.log, subprocess.DEVNULL)
        self.status = "running"

    def poll(self) -> None:
        """Look whether it has ended."""
        if self.status == "running" and self._process is not None and (code := self._process.poll()) is not None:
            finished = (self.out / "provenance.json").is_file()
            if code == 0 or (code in _STOPPED and finished):
                self.status = "done"
            else:
                self.status = "stopped" if self.stopping else "failed"

    def stop(self) -> None:
        """Ask it to end after its frame and write what it has; asked again it only goes on with that."""
        if self._process is not None and self._process.poll() is None:
            if not self.stopping:  # a second signal would end it with nothing written
                self._process.send_signal(signal.SIGINT)
            self.stopping = True
        elif self.status == "waiting":
            self.status = "stopped"

    def kill(self) -> None:
        """End it at once; the same run goes on from its last checkpoint. One that is stopping may write what it has."""
        if self._process is None or self._process.poll() is not None:
            return
        if self.stopping:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_PATIENCE_S)
        # No gentler signal: it would write a result of the frames so far, which nothing can go on from.
        self._process.kill()
        self._process.wait()


class RunQueue:
    """Runs in the order in which they were asked for, one at a time; folder : of their logs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._waiting: deque[BrowserRun] = deque()
        self.runs: list[BrowserRun] = []
        """All, the last one last."""

    @property
    def running(self) -> BrowserRun | None:
        """The one that is at work."""
        return next((run for run in self.runs if run.status == "running"), None)

    def ask(self, source: Path, out: Path, arguments: Sequence[str]) -> BrowserRun:
        """Put a run at the end of the queue, and return it."""
        run = BrowserRun(source, out, tuple(arguments), self._folder / f"{len(self.runs):03d}" / _LOG)
        self.runs.append(run)
        self._waiting.append(run)
        self.tick()
        return run

    def place(self, run: BrowserRun) -> int:
        """Return how many runs come before one that waits."""
        waiting = [other for other in self._waiting if other.status == "waiting"]
        return waiting.index(run) + (self.running is not None) if run in waiting else 0

    def tick(self) -> None:
        """Look at the one that is running, and start the next."""
        for run in self.runs:
            run.poll()
        while self.running is None and self._waiting:
            run = self._waiting.popleft()
            if run.status == "waiting":
                run.start()

    def close(self) -> None:
        """End what is running; what waits does not start."""
        self._waiting.clear()
        for run in self.runs:
            run.kill()


def started(words: Sequence[str], log: Path, stdin: int) -> subprocess.Popen[bytes]:
    """Return the process of `scopemap WORDS`, which prints to a file; stdin : as of `subprocess.Popen`."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as printed:
        return subprocess.Popen(
            [sys.executable, "-m", "scopemap", *words],
            stdin=stdin,
            stdout=printed,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1", "COLUMNS": "120"},
            # Ctrl-C in the window's terminal is the window's.
            start_new_session=True,
        )


def end_of(log: Path) -> str:
    """Return the end of what a process has printed to a file."""
    try:
        return log.read_text(encoding="utf-8", errors="replace")[-_MOST_LOG:]
    except OSError:
        return ""
