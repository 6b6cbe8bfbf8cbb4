"""Shows a live session to whoever looks into a folder (`result/run_view.py`): what it does, how fast, and its steps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from scopemap.runner.watched import RunWatch

if TYPE_CHECKING:
    from scopemap.apps.coverage.live_map import LiveCoverage
    from scopemap.apps.live.live import LiveSession
    from scopemap.engine.odometry import Step
    from scopemap.runner.reconstructor import Reconstructor


class ShownSession:
    """Observes a session and shows it in `folder`, with the map of what was not seen so far.

    writes : whether a result is written at the end.
    """

    def __init__(self, folder: Path, covered: LiveCoverage, *, writes: bool) -> None:
        self._folder, self._covered, self._writes = folder, covered, writes
        self._watch: RunWatch | None = None
        self._of: Reconstructor | None = None

    def watch(self, session: LiveSession) -> RunWatch:
        """Return the context in which the session is shown."""
        covered = self._covered

        def live() -> tuple[str, dict[str, str]]:
            status, coverage = session.status(), covered.shown.words
            words = "writing the result" if status.state == "ended" and self._writes else status.words
            return words, status.facts | ({"coverage": coverage} if coverage else {})

        self._watch = RunWatch(None, folder=self._folder, live=live, drawn=lambda: covered.shown.png)
        return self._watch

    def observe(self, step: Step, reconstructor: Reconstructor) -> None:
        """Show a step; what was seen before a reset is forgotten."""
        assert self._watch is not None
        if self._of is not None and reconstructor is not self._of:
            self._watch.forget()
        self._of = reconstructor
        self._watch(step)
