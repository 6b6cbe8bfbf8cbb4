"""What is shown of a live session: in JSON, in a line of the terminal, and in the window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
