"""Ctrl-C and SIGTERM while a run lasts: the first asks it to finish with what it has, the second ends it at once."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from scopemap.engine.odometry import Step

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Context in which the first signal ends a run early, once a frame was tracked; any other ends the program.

    exit_code : 130 after Ctrl-C, 143 after SIGTERM, 0 without a signal. stop : called at the first one, for a run that
    waits for frames. keeps : the run ends without a result, to be resumed (`RunStopped`).
    """

    def __init__(self, stop: Callable[[], None] = lambda: None, *, keeps: bool = False) -> None:
        self._stop, self._keeps = stop, keeps
        self.exit_code = 0
        self._tracking = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        self._before = {number: signal.signal(number, self._handle) for number in _SIGNALS}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def observe(self, step: Step) -> bool:
        """Note that there is something to write, and return whether the run shall end; observes `reconstruct`."""
        self._tracking = True
        if self.exit_code and self._keeps:
            from scopemap.runner.observers import RunStopped

            raise RunStopped
        return self.exit_code != 0

    def _handle(self, number: int, frame: FrameType | None) -> None:
        again, self.exit_code = self.exit_code != 0, 128 + number
        if again or not self._tracking:
            typer.echo("scopemap: stopped, nothing was written", err=True)
            raise SystemExit(self.exit_code)
        done = "kept" if self._keeps else "written"
        typer.echo(f"stopping after this frame; what was tracked is {done}; once more ends it at once", err=True)
        self._stop()
