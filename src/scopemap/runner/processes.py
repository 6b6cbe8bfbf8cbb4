"""Tasks in processes of their own, with a time limit: one that fails, hangs or dies takes no other with it."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

import cv2

from scopemap.engine.errors import ScopemapError

THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Variables of the environment that bound the threads of a process."""

_PROCESSES = multiprocessing.get_context("spawn")  # forked, the threads of the networks would be missing


@dataclass(frozen=True)
class Outcome:
    """What became of a task.

    value : what it returned, None where it failed. fault : why it failed, in one line, or "". seconds : of all its
    attempts. attempts : how many there were.
    """

    value: Any
    fault: str
    seconds: float
    attempts: int


NEW = Outcome(None, "", 0.0, 0)
"""Of a task that nobody has begun."""


@dataclass(frozen=True)
class ProcessLimits:
    """Bounds of tasks: processes at once, seconds for one attempt (None: any), and further attempts where one dies."""

    processes: int
    seconds: float | None = None
    retries: int = 0

    def allow_another(self, outcome: Outcome) -> bool:
        """Whether a task that has failed may be tried again."""
        return bool(outcome.fault) and outcome.attempts <= self.retries


def run_in_processes(
    call: Callable[[Any], Any],
    tasks: Iterable[Any],
    limits: ProcessLimits,
    started: Callable[[int], None] = lambda number: None,
) -> Generator[tuple[int, Outcome], None, None]:
    """Yield (number, outcome) of each task, as they end; each process does one task after the other.

    call : a function of a module. tasks : taken one by one, as processes are free. started : called with the number of
    a task when a process begins it. One that takes longer than its limit, or raises a `ScopemapError`, is not tried
    again. Closed early, or where this process ends, all processes end.
    """
    new, failed = ((number, task, NEW) for number, task in enumerate(tasks)), deque[tuple[int, Any, Outcome]]()
    idle: list[_WorkerProcess] = []
    busy: list[_WorkerProcess] = []
    try:
        while True:
            while len(busy) < limits.processes and (due := next(new, None) or (failed and failed.popleft())):
                worker = idle.pop() if idle else _WorkerProcess(call, threads_of_each(limits.processes))
                started(due[0])
                worker.begin(*due)
                busy.append(worker)
            if not busy:
                return
            for worker in _ready(busy, limits.seconds):
                busy.remove(worker)
                outcome, again = worker.end(limits.seconds)
                if worker.process.is_alive():
                    idle.append(worker)
                if again and limits.allow_another(outcome):
                    failed.append((worker.number, worker.task, outcome))
                else:
                    yield worker.number, outcome
    finally:
        for worker in idle + busy:
            worker.kill()


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads_of_each(processes: int) -> int:
    """Return how many threads each of so many processes may use that share this machine."""
    return max(1, usable_cores() // processes)


def _ready(busy: list[_WorkerProcess], limit_s: float | None) -> list[_WorkerProcess]:
    """Return the workers that have answered, have died or are over time, after waiting for the first of them."""
    now, left_s = time.monotonic(), None
    if limit_s is not None:
        left_s = max(min(worker.begun + limit_s for worker in busy) - now, 0.0)
    answered = wait([worker.connection for worker in busy], left_s)
    over = (lambda worker: False) if limit_s is None else (lambda worker: time.monotonic() >= worker.begun + limit_s)
    return [worker for worker in busy if worker.connection in answered or over(worker)]


class _WorkerProcess:
    """A process that does tasks."""

    def __init__(self, call: Callable[[Any], Any], threads: int) -> None:
        self.connection, theirs = _PROCESSES.Pipe()
        self.number, self.begun = 0, 0.0
        self.task: Any = None
        self._before = NEW
        self.process = _PROCESSES.Process(target=_serve, args=(theirs, call, threads), daemon=True)
        # A script that the process imports first may load numpy before scopemap.
        with _environment({name: str(threads) for name in THREADS} | {"OPENBLAS_NUM_THREADS": "1"}):
            self.process.start()
        theirs.close()

    def begin(self, number: int, task: Any, before: Outcome) -> None:
        """Give the process a task, with the outcome of the attempts before."""
        self.number, self.task, self.begun, self._before = number, task, time.monotonic(), before
        with suppress(BrokenPipeError):  # it has died: `end` says so
            self.connection.send(task)

    def end(self, limit_s: float | None) -> tuple[Outcome, bool]:
        """Return the outcome of the present task, and whether another attempt may help; a process over time ends."""
        again, value = True, None
        if self.connection.poll():
            try:
                value, fault, again = self.connection.recv()
            except (EOFError, OSError):
                self.process.join()
                fault = _cause_of_death(self.process.exitcode or 0)
        else:
            self.kill()
            fault, again = f"took longer than {limit_s:g} s", False
        seconds = self._before.seconds + time.monotonic() - self.begun
        return Outcome(value, fault, seconds, self._before.attempts + 1), again

    def kill(self) -> None:
        """End the process, whatever it does."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def _serve(connection: Connection, call: Callable[[Any], Any], threads: int) -> None:
    """Do the tasks that come, until there are no more: the main function of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the first one decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    faulthandler.enable()
    cv2.setNumThreads(threads)
    with suppress(EOFError):
        while True:
            connection.send(attempt(call, connection.recv()))


def attempt(call: Callable[[Any], Any], task: Any) -> tuple[Any, str, bool]:
    """Return what a task returns, "" or why it failed, and whether another attempt may help."""
    try:
        return call(task), "", True
    except ScopemapError as error:
        return None, " ".join(str(error).split()), False
    except Exception as error:  # a fault of the program must not end the other tasks
        traceback.print_exc()
        return None, f"{type(error).__name__}: {' '.join(str(error).split())[:300]}", True


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    signal.raise_signal(signal.SIGTERM)


def _cause_of_death(code: int) -> str:
    if code >= 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name if -code in list(signal.Signals) else f"signal {-code}"
    return f"its process was ended by {name}" + (" (out of memory?)" if name == "SIGKILL" else "")


@contextmanager
def _environment(wanted: dict[str, str]) -> Iterator[None]:
    """Set variables of the environment that are not set, for processes that start meanwhile."""
    new = {name: value for name, value in wanted.items() if name not in os.environ}
    os.environ.update(new)
    try:
        yield
    finally:
        for name in new:
            del os.environ[name]
