"""What the processes of tests do: functions of a module that imports little."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from scopemap.errors import InputError


def act(task: tuple[str, Path]) -> tuple[int, str]:
    """Do what the first word says; the file counts the attempts."""
    what, file = task
    with file.open("a") as attempts:
        attempts.write("x")
    if what == "die" or (what == "die once" and file.stat().st_size == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "hang":
        time.sleep(60)
    if what == "refuse":
        raise InputError("reading it: refused\n  in two lines")
    if what == "fault":
        raise ZeroDivisionError("of its own")
    return os.getpid(), os.environ.get("NUMBA_NUM_THREADS", "")
