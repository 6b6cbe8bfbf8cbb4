"""Shows a live session to whoever looks into a folder (`result/run_view.py`): what it does, how fast, and its steps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

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
            words, facts = words_and_facts(session.state(), covered.shown.words)
            return "writing the result" if words == "ended" and self._writes else words, facts

        self._watch = RunWatch(None, folder=self._folder, live=live, drawn=lambda: covered.shown.png)
        return self._watch

    def observe(self, step: Step, reconstructor: Reconstructor) -> None:
        """Show a step; what was seen before a reset is forgotten."""
        assert self._watch is not None
        if self._of is not None and reconstructor is not self._of:
            self._watch.forget()
        self._of = reconstructor
        self._watch(step)


def words_and_facts(state: dict[str, Any], coverage: str) -> tuple[str, dict[str, str]]:
    """Return what a session does, and what is known of it by name; coverage : what was not seen, in words."""
    latency = f"{state['latency_p50_ms']} ms (95 % below {state['latency_p95_ms']} ms)"
    facts = {
        "why": state["reason"],
        "latency": latency,
        "frames": f"{state['frames_per_s']} per second; {state['dropped']} of {state['read']} dropped",
        "tracked": f"{state['tracked']}, lost {state['lost']}, submap {state['map'] + 1}",
        "scale": "known" if state["scale_known"] else "unknown: compare shapes, not sizes",
        "surface": "full: no more tissue is added; forget all to start a new one" if state["full"] else "",
        "snapshot": state["snapshot"],
        "coverage": coverage,
    }
    return state["words"], {name: fact for name, fact in facts.items() if fact}
