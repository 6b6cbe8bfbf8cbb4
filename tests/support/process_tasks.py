"""What the processes of tests do: functions of a module that imports little."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from scopemap.engine.errors import InputError

WHATS = ["work", "die", "refuse", "hang", "die once", "fault"]
LIMIT_S = 12.0
FAULTS = ["", "", "reading it: refused in two lines", "took longer than 12 s", "", "ZeroDivisionError: of its own"]
"""How they fail, with two attempts of 12 s; the second in the words of what runs it."""


def act(task: tuple[str, Path]) -> tuple[int, str]:
    """Do what the first word says; the file counts the attempts."""
    what, file = task
    with file.open("a") as attempts:
        attempts.write("x")
    if what == "die" or (what == "die once" and file.stat().st_size == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "hang":
        time.sleep(120)
    if what == "refuse":
        raise InputError("reading it: refused\n  in two lines")
    if what == "fault":
        raise ZeroDivisionError("of its own")
    return os.getpid(), os.environ.get("NUMBA_NUM_THREADS", "")


def threads_of_openblas(_: object) -> str:
    """Return how many threads OpenBLAS was told to use."""
    return os.environ.get("OPENBLAS_NUM_THREADS", "")


def soon(what: Callable[[], bool]) -> bool:
    """Whether something comes true within a minute."""
    until = time.monotonic() + 60
    while not (true := what()) and time.monotonic() < until:
        time.sleep(0.05)
    return true
