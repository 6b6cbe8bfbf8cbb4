"""How far a run in a notebook is, in a line below the cell."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from scopemap.engine.odometry import Step
from scopemap.report.progress_meter import ProgressMeter

_SECONDS_BETWEEN = 0.5
Progress = Callable[[str, int, int], None]


def in_notebook() -> bool:
    """Return whether this process runs the cells of a notebook."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return shell is not None and hasattr(shell, "kernel")


@contextmanager
def notebook_progress(total: int | None) -> Iterator[tuple[Callable[[Step], None], Progress]]:
    """Yield the observer and the progress of a run of `total` frames that show it in one line below a cell."""
    from IPython.display import display

    meter, shown_s = ProgressMeter(total), time.perf_counter()
    line = display({"text/plain": "preparing"}, raw=True, display_id=True)  # type: ignore[no-untyped-call]

    def show(words: str) -> None:
        line.update({"text/plain": words}, raw=True)

    def observe(step: Step) -> None:
        nonlocal shown_s
        meter.add(step)
        if time.perf_counter() - shown_s > _SECONDS_BETWEEN:
            shown_s = time.perf_counter()
            show(meter.line)

    def progress(doing: str, done: int, frames: int) -> None:
        nonlocal shown_s
        words = meter.words(doing, done, frames)
        if not frames or done == frames or time.perf_counter() - shown_s > _SECONDS_BETWEEN:
            shown_s = time.perf_counter()
            show(words)

    yield observe, progress
    show(f"{meter.done} frames done")
