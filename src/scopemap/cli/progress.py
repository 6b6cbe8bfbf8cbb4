"""Progress of runs and renderings on stderr: a bar, or a line every ten seconds where there is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from scopemap.pipeline import Step

_SECONDS_BETWEEN_LINES = 10.0


@contextmanager
def run_progress(total: int | None, *, silent: bool) -> Iterator[tuple[Callable[[Step], None], ...]]:
    """Yield the observers (one, or none if `silent`) that show the progress of a run of `total` frames."""
    if silent:
        yield ()
        return
    state = _State(total)
    # Before the first frame the camera may be estimated, kernels compiled and networks loaded.
    with _display("tracking", "preparing") as show:

        def observe(step: Step) -> None:
            state.add(step)
            show(state.done, total, f"{state.speed}{state.text}", state.line)

        yield (observe,)


@contextmanager
def count_progress(doing: str, done: str, *, silent: bool) -> Iterator[Callable[[int, int | None], None] | None]:
    """Yield a function that shows (frames done, all frames or None) in these words; None if `silent`."""
    if silent:
        yield None
        return
    with _display(doing) as show:
        yield lambda count, total: show(count, total, "", f"{done} {count}{_of(total)} frames")


@contextmanager
def _display(doing: str, text: str = "") -> Iterator[Callable[[int, int | None, str, str], None]]:
    """Yield a function of (frames done, all frames or None, text after the bar, line where there is no terminal)."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        last = TextColumn("{task.fields[text]}")
        columns = (TextColumn(doing), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), last)
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task(doing, total=None, text=text)
            yield lambda done, total, text, _: bar.update(task, completed=done, total=total, text=text)
        return
    written = time.perf_counter()

    def write(done: int, total: int | None, _: str, line: str) -> None:
        nonlocal written
        now = time.perf_counter()
        if done == total or now - written >= _SECONDS_BETWEEN_LINES:
            written = now
            typer.echo(line, err=True)

    yield write


def _of(total: int | None) -> str:
    return f" of {total}" if total else ""


class _State:
    """Counts frames as they pass."""

    def __init__(self, total: int | None) -> None:
        self.started, self.done, self.lost, self.text = time.perf_counter(), 0, 0, ""
        self._total = total

    @property
    def speed(self) -> str:
        """Frames per second since the first one, without start-up, and the time left; "" before the second."""
        if self.done < 2:
            return ""
        rate = (self.done - 1) / max(time.perf_counter() - self.started, 1e-9)
        left = f", {max(self._total - self.done, 0) / rate:.0f} s left" if self._total else ""
        return f"{rate:.1f} frames/s{left}, "

    @property
    def line(self) -> str:
        return f"frame {self.done}{_of(self._total)}: {self.speed}{self.text}"

    def add(self, step: Step) -> None:
        if self.done == 0:
            self.started = time.perf_counter()
        self.done += 1
        if step.track.status == "lost":
            self.lost += 1
            self.text = f"lost: {step.track.reason}"
        else:
            self.text = "ok" + (f", {self.lost} lost so far" if self.lost else "")
        if self.done == self._total:
            # Seconds to minutes in which no frame passes.
            self.text += "; adjusting, fusing and writing"
