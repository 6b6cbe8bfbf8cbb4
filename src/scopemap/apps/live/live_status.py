"""What is shown of a live session: in JSON, in a line of the terminal, and in a folder that the window reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from scopemap.runner.watched import RunWatch

if TYPE_CHECKING:
    from scopemap.apps.coverage.live_map import LiveCoverage
    from scopemap.engine.odometry import Step
    from scopemap.runner.reconstructor import Reconstructor

_WORDS = {"lost": "lost: move back slowly", "starting": "starting: hold still and look at tissue"}


@dataclass(frozen=True)
class LiveStatus:
    """How a live session is.

    state : what it does. reason : why it is lost, or "". frame : number of the last one, -1: none. frames_per_s and
    latency_ms, its median and its 95th percentile : of the last 300 frames, from a frame's time to its pose. read,
    dropped : frames of the source. tracked, lost : frames since the last reset. map : number of the map. scale_known.
    snapshot : the last one's file, or "". full : whether the surface takes no more.
    """

    state: Literal["starting", "tracking", "lost", "paused", "ended"]
    reason: str
    frame: int
    frames_per_s: float
    latency_ms: int
    latency_p50_ms: int
    latency_p95_ms: int
    read: int
    dropped: int
    tracked: int
    lost: int
    map: int
    scale_known: bool
    snapshot: str
    full: bool

    @property
    def words(self) -> str:
        """What it does, for people."""
        return _WORDS.get(self.state, self.state)

    @property
    def line(self) -> str:
        """The main facts, for a terminal."""
        latency = f"latency {self.latency_p50_ms} ms (95 % below {self.latency_p95_ms})"
        full = ", surface full" if self.full else ""
        drops = f"{self.dropped} of {self.read} frames dropped"
        return f"{self.words}: {self.frames_per_s} frames/s, {latency}, {drops}, submap {self.map + 1}{full}"

    @property
    def facts(self) -> dict[str, str]:
        """What is known beside `words`, by name, for the window; what there is nothing to say of is left out."""
        facts = {
            "why": self.reason,
            "latency": f"{self.latency_p50_ms} ms (95 % below {self.latency_p95_ms} ms)",
            "frames": f"{self.frames_per_s} per second; {self.dropped} of {self.read} dropped",
            "tracked": f"{self.tracked}, lost {self.lost}, submap {self.map + 1}",
            "scale": "known" if self.scale_known else "unknown: compare shapes, not sizes",
            "surface": "full: no more tissue is added; forget all to start a new one" if self.full else "",
            "snapshot": self.snapshot,
        }
        return {name: fact for name, fact in facts.items() if fact}


class ShownSession:
    """Observes a session and shows it in `folder` (`result/run_view.py`), with the map of what was not seen so far.

    writes : whether a result is written at the end.
    """

    def __init__(self, folder: Path, covered: LiveCoverage, *, writes: bool) -> None:
        self._folder, self._covered, self._writes = folder, covered, writes
        self._watch: RunWatch | None = None
        self._of: Reconstructor | None = None

    def watch(self, status_now: Callable[[], LiveStatus]) -> RunWatch:
        """Return the context in which the session is shown whose status a function returns."""
        covered = self._covered

        def live() -> tuple[str, dict[str, str]]:
            status, coverage = status_now(), covered.shown.words
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
