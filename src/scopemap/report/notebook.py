"""A run in a notebook: how far it is, in a line below the cell, and then its verdict and its summary picture."""

from __future__ import annotations

import html
import sys
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO

from scopemap.engine.odometry import Step
from scopemap.report.progress_meter import ProgressMeter
from scopemap.result.result import Result

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


def show_summary(result: Result) -> None:
    """Show the verdict on a result and its summary picture below the cell."""
    from IPython.display import HTML, display

    display(HTML(summary_html(result)))  # type: ignore[no-untyped-call]


def summary_html(result: Result) -> str:
    """Return the verdict on a result, with the main facts, and its summary picture."""
    from scopemap.report.facts import report_facts
    from scopemap.report.summary_picture import summary_picture
    from scopemap.result.verdict import verdict

    found, file = verdict(result), BytesIO()
    words = html.escape(f"{found.word}: {found.sentence}")
    summary_picture(report_facts(result)).save(file, "JPEG", quality=88)
    picture = b64encode(file.getvalue()).decode()
    return f'<p>{words}</p><img alt="{words}" src="data:image/jpeg;base64,{picture}" style="max-width: 100%">'
