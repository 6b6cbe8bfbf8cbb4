"""Progress of runs and renderings on stderr: a bar, or a line every ten seconds where there is no terminal."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import typer

if TYPE_CHECKING:
    from scopemap.odometry import Step

    _Show = Callable[[str, int, int | None, str, str], None]
    """Takes what is done, items done, all items or None, text after the bar, line where there is no terminal."""

_SECONDS_BETWEEN_LINES = 10.0
_COMPILING = "compiling kernels, once"
# Time per frame after the last one (adjustment, fusion, writing) over that until then, typical of the default preset.
_SHARE_AFTERWARDS = 0.5


class RunProgress(NamedTuple):
    """What a run calls: observers with each step (none if silent), `progress` before the first and after the last."""

    observers: tuple[Callable[[Step], None], ...]
    progress: Callable[[str, int, int], None]


@contextmanager
def run_progress(total: int | None, *, silent: bool) -> Iterator[RunProgress]:
    """Yield what shows the progress of a run of `total` frames."""
    if silent:
        yield RunProgress((), lambda doing, done, total: None)
        return
    state = _State(total)
    with _display("tracking", "preparing") as show:

        def observe(step: Step) -> None:
            state.add(step)
            show("tracking", state.done, total, f"{state.speed}{state.text}", state.line)

        def progress(doing: str, done: int, frames: int) -> None:
            if doing == "resuming":
                state.resume(done)
                show(doing, done, total, "", f"resuming after {done} frames")
                return
            line = f"{doing} frame {done} of {frames}" if frames else doing
            show(doing, done, frames or None, "", line)

        yield RunProgress((observe,), progress)


@contextmanager
def count_progress(doing: str, done: str, *, silent: bool) -> Iterator[Callable[[int, int | None], None] | None]:
    """Yield a function that shows (frames done, all frames or None) in these words; None if `silent`."""
    if silent:
        yield None
        return
    with _display(doing) as show:
        yield lambda count, total: show(doing, count, total, "", f"{done} {count}{_of(total)} frames")


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


def _of(total: int | None) -> str:
    return f" of {total}" if total else ""


class _State:
    """Counts frames as they pass."""

    def __init__(self, total: int | None) -> None:
        self.started, self.done, self.lost, self.text = time.perf_counter(), 0, 0, ""
        self._total, self._first = total, 1
        self._maps = Counter[int]()

    @property
    def speed(self) -> str:
        """Frames per second since the first one, without start-up, and the time left until the result is written.

        "" before the second one.
        """
        if self.done <= self._first:
            return ""
        rate = (self.done - self._first) / max(time.perf_counter() - self.started, 1e-9)
        frames_left = max(self._total - self.done, 0) + _SHARE_AFTERWARDS * self._total if self._total else 0
        left = f", about {frames_left / rate:.0f} s left" if self._total else ""
        return f"{rate:.1f} frames/s{left}, "

    @property
    def line(self) -> str:
        return f"frame {self.done}{_of(self._total)}: {self.speed}{self.text}"

    def resume(self, done: int) -> None:
        """Go on after so many frames."""
        self.done, self._first = done, done + 1

    def add(self, step: Step) -> None:
        if self.done < self._first:
            self.started = time.perf_counter()
        self.done += 1
        if step.track.status == "lost":
            self.lost += 1
            self.text = f"lost: {step.track.reason}"
        else:
            self._maps[step.track.map] += 1
            elsewhere = self._maps.total() - max(self._maps.values())
            counts = ((self.lost, "lost"), (elsewhere, "in other maps"))
            counted = ", ".join(f"{count} {words}" for count, words in counts if count)
            self.text = "ok" + (f", {counted} so far" if counted else "")
