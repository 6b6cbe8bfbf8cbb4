"""Loading of the libraries that a command needs: without the garbage collector, which finds nothing there."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading() -> Iterator[None]:
    """Do not look for garbage meanwhile, and not among what was loaded later on.

    Python would look through all modules again and again: a fifth of the time of their import, and 0.1 s each time
    that a run trims its memory.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
