"""A window beside a command that runs in a terminal: in a process of its own, so that it cannot slow the run down.

The window's process (`scopemap app --watch`) writes lines to the command: first where it is, then the names of buttons
that were pressed. The command writes one line at its end: "done", or "failed: " and why. What is shown is read from the
folder of the view.
"""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from scopemap.engine.errors import InputError

DONE = "done"
FAILED = "failed: "
_NOT_INSTALLED = "the window in the browser needs viser: pip install 'scopemap[app]'"


def check_installed() -> None:
    """Raise `InputError` where viser is not installed."""
    if importlib.util.find_spec("viser") is None:
        raise InputError(_NOT_INSTALLED)


@contextmanager
def window_beside(
    out: Path | None,
    view: Path,
    actions: Mapping[str, Callable[[], None]],
    arguments: tuple[str, ...] = (),
    say: Callable[[str], None] = print,
) -> Iterator[None]:
    """Context in which a window shows what a run writes to `view`, and its result in `out` afterwards until Ctrl-C.

    actions : called by the names of the window's buttons; there may be more of them later. arguments : further ones of
    `scopemap app`. say : is told where the window is. Raises `InputError` where viser is not installed.
    """
    check_installed()
    command = [sys.executable, "-m", "scopemap", "app", "--watch", str(view), *arguments]
    command += [] if out is None else ["--result", str(out)]
    # Ctrl-C is the command's.
    window = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
    to_window, lines = window.stdin, window.stdout
    assert to_window is not None
    assert lines is not None

    def listen() -> None:
        for line in lines:
            name = line.strip()
            if name in actions:
                actions[name]()
            elif name.startswith("http"):
                say(f"look at {name} in a browser of this machine")

    threading.Thread(target=listen, name="window", daemon=True).start()

    def tell(line: str) -> None:
        with suppress(OSError):  # the window was closed
            to_window.write(f"{line}\n")
            to_window.flush()

    try:
        yield
        tell(DONE)
        say("the window stays until Ctrl-C")
        _wait(window)
    except BaseException as error:
        tell(f"{FAILED}{error}")
        raise
    finally:
        window.terminate()
        window.wait()


def _wait(window: subprocess.Popen[str]) -> None:
    """Wait until the window ends, or for Ctrl-C or SIGTERM, after which the caller tidies up."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with suppress(KeyboardInterrupt):
            window.wait()
    finally:
        signal.signal(signal.SIGTERM, before)


def lines_of_input() -> Iterator[str]:
    """Yield the lines of standard input, for a thread that may still wait for one when the process ends."""
    # Not `sys.stdin`: Python would want to close it.
    with open(0, encoding="utf-8", errors="replace", closefd=False) as lines:
        yield from lines
