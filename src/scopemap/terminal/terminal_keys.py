"""Single keys of the terminal, without Enter."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def terminal_keys(actions: Mapping[str, Callable[[], None]]) -> Iterator[bool]:
    """Context in which a key calls its action, from a thread; yields False where there is no terminal to read from.

    Ctrl-C stays what it is. The terminal is afterwards as it was.
    """
    try:
        import termios
        import tty

        terminal = sys.stdin.fileno() if sys.stdin.isatty() else None
    except (ImportError, ValueError, AttributeError):  # Windows, or no standard input
        terminal = None
    if terminal is None:
        yield False
        return
    before, ended = termios.tcgetattr(terminal), threading.Event()
    thread = threading.Thread(target=_read, args=(terminal, actions, ended), name="keys", daemon=True)
    tty.setcbreak(terminal)
    try:
        thread.start()
        yield True
    finally:
        ended.set()
        thread.join()
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def _read(terminal: int, actions: Mapping[str, Callable[[], None]], ended: threading.Event) -> None:
    import os
    import select

    while not ended.is_set():
        if not select.select([terminal], [], [], 0.2)[0]:
            continue
        keys = os.read(terminal, 16).decode(errors="ignore")
        if not keys:
            return
        for key in keys:
            if key in actions:
                actions[key]()
