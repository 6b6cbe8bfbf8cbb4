"""Progress of runs and renderings on stderr: a bar, or a line every ten seconds where there is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import typer

from scopemap.report.progress_meter import ProgressMeter, of_all

if TYPE_CHECKING:
    from scopemap.engine.odometry import Step

    _Show = Callable[[str, int, int | None, str, str], None]
    """Takes what is done, items done, all items or None, text after the bar, line where there is no terminal."""

_SECONDS_BETWEEN_LINES = 10.0
_COMPILING = "compiling kernels, once"


class ProgressDisplay(NamedTuple):
    """What a run calls: observers with each step (none if silent), `progress` before the first and after the last."""

    observers: tuple[Callable[[Step], bool | None], ...]
    progress: Callable[[str, int, int], None]


def both(
    one: Callable[[str, int, int], None], other: Callable[[str, int, int], None]
) -> Callable[[str, int, int], None]:
    """Return the progress that tells two."""

    def tell(doing: str, done: int, frames: int) -> None:
        one(doing, done, frames)
        other(doing, done, frames)

    return tell


@contextmanager
def run_progress(total: int | None, *, silent: bool, adjusts: bool = True) -> Iterator[ProgressDisplay]:
    """Yield what shows the progress of a run of `total` frames; adjusts : as of `ProgressMeter`."""
    if silent:
        yield ProgressDisplay((), lambda doing, done, total: None)
        return
    meter = ProgressMeter(total, adjusts=adjusts)
    with _display("tracking", "preparing") as show:

        def observe(step: Step) -> None:
            meter.add(step)
            show("tracking", meter.done, total, f"{meter.time_left}{meter.text}", meter.line)

        def progress(doing: str, done: int, frames: int) -> None:
            line = meter.words(doing, done, frames)
            left = meter.time_left.rstrip(", ")
            show(doing, done, total if doing == "resuming" else frames or None, left, line)

        yield ProgressDisplay((observe,), progress)


@contextmanager
def count_progress(doing: str, done: str, *, silent: bool) -> Iterator[Callable[[int, int | None], None] | None]:
    """Yield a function that shows (frames done, all frames or None) in these words; None if `silent`."""
    if silent:
        yield None
        return
    with _display(doing) as show:
        yield lambda count, total: show(doing, count, total, "", f"{done} {count}{of_all(total)} frames")


@contextmanager
def _display(doing: str, text: str = "") -> Iterator[_Show]:
    """Yield what shows a count: in a bar, or as a line where there is no terminal."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
        )
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task(doing, total=None, text=text)
            with _kernels_told(lambda name: bar.update(task, text=f"{_COMPILING}: {name}")):
                yield lambda doing, done, total, text, _: bar.update(
                    task, description=doing, completed=done, total=total, text=text
                )
        return
    written, shown, told = time.perf_counter(), doing, False

    def tell_once(_: str) -> None:
        nonlocal told
        if not told:
            told = True
            typer.echo(_COMPILING, err=True)

    def write(doing: str, done: int, total: int | None, _: str, line: str) -> None:
        nonlocal written, shown
        now = time.perf_counter()
        if done == total or doing != shown or now - written >= _SECONDS_BETWEEN_LINES:
            written, shown = now, doing
            typer.echo(line, err=True)

    with _kernels_told(tell_once):
        yield write


@contextmanager
def _kernels_told(tell: Callable[[str], None]) -> Iterator[None]:
    """Call `tell` with the name of each kernel that is compiled because no cache holds it.

    One after the other: numba's compiler holds a lock.
    """
    if "numba" not in sys.modules:  # nothing will be compiled, and importing it takes time
        yield
        return
    from numba.core import event

    class Teller(event.Listener):
        def on_start(self, event: event.Event) -> None:
            tell(event.data["dispatcher"].py_func.__name__)

        def on_end(self, event: event.Event) -> None:
            pass

    with event.install_listener("numba:compile", Teller()):
        yield
