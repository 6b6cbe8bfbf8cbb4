"""Runs that the window starts: `scopemap run` in a process of its own, one at a time, the others wait in a queue."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from scopemap.engine.errors import reporting
from scopemap.result.checkpoint import has_checkpoint
from scopemap.result.result_folder import LOCK, UNFINISHED, VIEW

Status = Literal["waiting", "running", "done", "failed", "stopped"]
_LOG = "run.log"
_MOST_LOG = 20_000
_SO_FAR = "_so_far.part"
"""What the name of a copy ends in; the ending of a file's name is left out of that of its result."""
_PATIENCE_S = 7.0
"""Seconds after which a run that is stopping is ended: what it does after the last frame is done again."""


@dataclass(eq=False)
class BrowserRun:
    """A run of `scopemap run INPUT --out OUT` with further arguments.

    log : file that takes what it prints. status : where it is. queue : that it is of.
    """

    source: Path
    out: Path
    arguments: tuple[str, ...]
    log: Path
    queue: RunQueue = field(repr=False)
    status: Status = "waiting"
    stopping: bool = False
    _stopped_s: float = 0.0
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

    @property
    def holds_its_folder(self) -> bool:
        """Whether no other run may write to its folder: what was stopped may go on there."""
        return self.status != "failed" and (self.status != "stopped" or self.is_kept)

    @property
    def is_kept(self) -> bool:
        """Whether it can go on after the frames that it has tracked."""
        return has_checkpoint(self.out / UNFINISHED)

    def start(self) -> None:
        """Start the process."""
        words = ["run", str(self.source), "--out", str(self.out), *self.arguments, "--watched"]
        self._process = started(words, self.log, subprocess.DEVNULL)
        self.status = "running"

    def poll(self) -> None:
        """Look whether it has ended."""
        if self.status != "running" or self._process is None:
            return
        if self.stopping and time.monotonic() - self._stopped_s > _PATIENCE_S:
            self.kill()
        if (code := self._process.poll()) is not None:
            self.status = "done" if code == 0 else "stopped" if self.stopping else "failed"

    def stop(self) -> None:
        """Ask it to end after its frame and keep what it has tracked; asked again it only goes on with that."""
        if self.status == "waiting":
            self.status = "stopped"
        elif self._process is not None and self._process.poll() is None and not self.stopping:
            # A second signal would end it with less kept.
            self._process.send_signal(signal.SIGINT)
            self.stopping, self._stopped_s = True, time.monotonic()

    def copy(self) -> Path:
        """Copy what it has kept into the folder of another result, and return that; any thread may call it.

        This one can still go on. Raises `InputError` where the disk is full.
        """
        out = self.queue.new_result(Path(f"{self.out.name}{_SO_FAR}"))
        with reporting(f"cannot copy what {self.out} has kept"):
            shutil.rmtree(out / UNFINISHED, ignore_errors=True)
            shutil.copytree(self.out / UNFINISHED, out / UNFINISHED, ignore=shutil.ignore_patterns(LOCK, VIEW))
        return out

    def finish(self, out: Path) -> BrowserRun:
        """Put a run at the end of the queue that makes a result of what `copy` has put into a folder; return it."""
        return self.queue.ask(self.source, out, (*self.arguments, "--finish"))

    def go_on(self) -> None:
        """Put it into the queue again: it goes on after what it has kept."""
        self.status, self.stopping = "waiting", False
        self.queue.put(self)

    def kill(self) -> None:
        """End it at once; the same run goes on from its last checkpoint. One that is stopping may keep what it has."""
        if self._process is None or self._process.poll() is not None:
            return
        if self.stopping:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(max(0.0, self._stopped_s + _PATIENCE_S - time.monotonic()))
        self._process.kill()
        self._process.wait()


class RunQueue:
    """Runs in the order in which they were asked for, one at a time.

    folder : of their logs. new_result : returns a folder for a result of an input.
    """

    def __init__(self, folder: Path, new_result: Callable[[Path], Path]) -> None:
        self._folder, self.new_result = folder, new_result
        self._waiting: deque[BrowserRun] = deque()
        self.runs: list[BrowserRun] = []
        """All, the last one last."""

    @property
    def running(self) -> BrowserRun | None:
        """The one that is at work."""
        return next((run for run in self.runs if run.status == "running"), None)

    def ask(self, source: Path, out: Path, arguments: Sequence[str]) -> BrowserRun:
        """Put a run at the end of the queue, and return it."""
        run = BrowserRun(source, out, tuple(arguments), self._folder / f"{len(self.runs):03d}" / _LOG, self)
        self.runs.append(run)
        self.put(run)
        return run

    def put(self, run: BrowserRun) -> None:
        """Put a run at the end of the queue."""
        self._waiting.append(run)
        self.tick()

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
