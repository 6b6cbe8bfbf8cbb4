"""Progress of runs and renderings: a bar with rate, time left and state; plain lines where there is no terminal."""

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
    """Yield the observers (one, or none if `silent`) that show how a run of `total` frames goes, on stderr."""
    if silent:
        yield ()
    elif not sys.stderr.isatty():
        yield (_Lines(total),)
    else:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn("tracking"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[state]}"),
        )
        with Progress(*columns, console=Console(stderr=True)) as bar:
            # An unknown camera is looked for, kernels are compiled, networks loaded, before a frame passes.
            task, state = bar.add_task("", total=total, rate="", state="preparing"), _State(total)

            def show(step: Step) -> None:
                state.add(step)
                rate = "" if state.rate is None else f"{state.rate:.1f} frames/s"
                bar.update(task, advance=1, rate=rate, state=state.text)

            yield (show,)


class _State:
    """Counts frames as they pass."""

    def __init__(self, total: int | None) -> None:
        self.started, self.done, self.lost, self.text = time.perf_counter(), 0, 0, ""
        self._total = total

    @property
    def rate(self) -> float | None:
        """Frames per second since the first one, which waits for all that is prepared; None so far."""
        return (self.done - 1) / max(time.perf_counter() - self.started, 1e-9) if self.done > 1 else None

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
            # Keyframes are adjusted, depth fused, files written: seconds to minutes in which no frame passes.
            self.text += "; adjusting, fusing and writing"


class _Lines:
    """One line now and then."""

    def __init__(self, total: int | None) -> None:
        self._total, self._state, self._last = total, _State(total), time.perf_counter()

    def __call__(self, step: Step) -> None:
        self._state.add(step)
        state, now = self._state, time.perf_counter()
        if now - self._last < _SECONDS_BETWEEN_LINES and state.done != self._total:
            return
        self._last = now
        speed = ""
        if state.rate is not None:
            left = "" if not self._total else f", {max(self._total - state.done, 0) / state.rate:.0f} s left"
            speed = f"{state.rate:.1f} frames/s{left}, "
        total = f" of {self._total}" if self._total else ""
        typer.echo(f"frame {state.done}{total}: {speed}{state.text}", err=True)


@contextmanager
def count_progress(doing: str, done: str, *, silent: bool) -> Iterator[Callable[[int, int | None], None] | None]:
    """Yield what shows (frames done, in all or None) on stderr, in these words; None if `silent`."""
    if silent:
        yield None
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress

        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task(doing, total=None)
            yield lambda count, total: bar.update(task, completed=count, total=total)
    else:
        yield _CountLines(done)


class _CountLines:
    """One line now and then."""

    def __init__(self, done: str) -> None:
        self._done, self._last = done, time.perf_counter()

    def __call__(self, count: int, total: int | None) -> None:
        now = time.perf_counter()
        if now - self._last >= _SECONDS_BETWEEN_LINES or count == total:
            self._last = now
            typer.echo(f"{self._done} {count}{f' of {total}' if total else ''} frames", err=True)
