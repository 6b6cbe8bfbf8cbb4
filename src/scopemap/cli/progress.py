"""Progress of runs and renderings on stderr: a bar, or a line every ten seconds where there is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rich.progress import Progress

    from scopemap.pipeline import Step

_SECONDS_BETWEEN_LINES = 10.0


@contextmanager
def run_progress(total: int | None, *, silent: bool) -> Iterator[tuple[Callable[[Step], None], ...]]:
    """Yield the observers (one, or none if `silent`) that show the progress of a run of `total` frames."""
    if silent:
        yield ()
        return
    state = _State(total)
    if not sys.stderr.isatty():
        lines = _Lines()

        def write(step: Step) -> None:
            state.add(step)
            lines.write(state.line, last=state.done == total)

        yield (write,)
        return
    with _bar("tracking", "{task.fields[rate]}", "{task.fields[state]}") as bar:
        # Before the first frame the camera may be estimated, kernels compiled and networks loaded.
        task = bar.add_task("tracking", total=total, rate="", state="preparing")

        def show(step: Step) -> None:
            state.add(step)
            rate = "" if state.rate is None else f"{state.rate:.1f} frames/s"
            bar.update(task, advance=1, rate=rate, state=state.text)

        yield (show,)


@contextmanager
def count_progress(doing: str, done: str, *, silent: bool) -> Iterator[Callable[[int, int | None], None] | None]:
    """Yield a function that shows (frames done, all frames or None) in these words; None if `silent`."""
    if silent:
        yield None
    elif sys.stderr.isatty():
        with _bar(doing) as bar:
            task = bar.add_task(doing, total=None)
            yield lambda count, total: bar.update(task, completed=count, total=total)
    else:
        lines = _Lines()
        yield lambda count, total: lines.write(f"{done} {count}{_of(total)} frames", last=count == total)


def _bar(doing: str, *fields: str) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(doing), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), *map(TextColumn, fields))
    return Progress(*columns, console=Console(stderr=True))


def _of(total: int | None) -> str:
    return f" of {total}" if total else ""


class _State:
    """Counts frames as they pass."""

    def __init__(self, total: int | None) -> None:
        self.started, self.done, self.lost, self.text = time.perf_counter(), 0, 0, ""
        self._total = total

    @property
    def rate(self) -> float | None:
        """Frames per second since the first one, without start-up; None before the second."""
        return (self.done - 1) / max(time.perf_counter() - self.started, 1e-9) if self.done > 1 else None

    @property
    def line(self) -> str:
        speed = ""
        if self.rate is not None:
            left = f", {max(self._total - self.done, 0) / self.rate:.0f} s left" if self._total else ""
            speed = f"{self.rate:.1f} frames/s{left}, "
        return f"frame {self.done}{_of(self._total)}: {speed}{self.text}"

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


class _Lines:
    """Writes a line if the last one was ten seconds ago."""

    def __init__(self) -> None:
        self._written = time.perf_counter()

    def write(self, line: str, *, last: bool) -> None:
        now = time.perf_counter()
        if last or now - self._written >= _SECONDS_BETWEEN_LINES:
            self._written = now
            typer.echo(line, err=True)
