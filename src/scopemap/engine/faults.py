"""Frames that a stage of the pipeline could not process: a few are lost, many end the run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from scopemap.engine.errors import ScopemapError
from scopemap.engine.notices import Notice

_MOST_FAULTS = 3  # by hand: frames that may fail
_MOST_FAULTS_SHARE = 0.05  # by hand: more are no accident


class StageFaults:
    """The frames that one stage could not process; each stage has its own, as a part of the state that it changes."""

    def __init__(self, stage: str) -> None:
        self._stage = stage
        self.frames = self.failed = self.without_depth = 0
        self.first, self.first_without_depth = (-1, ""), -1

    def record(self) -> dict[str, Any]:
        """Return the counts, and which were first, for `resume`, as JSON holds them."""
        blind = {"without_depth": self.without_depth, "first_without_depth": self.first_without_depth}
        return {"frames": self.frames, "failed": self.failed, "first": self.first} | blind

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from a record."""
        self.frames, self.failed, self.first = record["frames"], record["failed"], tuple(record["first"])
        self.without_depth, self.first_without_depth = record["without_depth"], record["first_without_depth"]

    def has_no_depth(self, index: int) -> None:
        """Note a frame to which the network gave no depth."""
        self.first_without_depth = index if not self.without_depth else self.first_without_depth
        self.without_depth += 1

    def noted(self, index: int, error: Exception) -> str:
        """Note the error of a frame and return it in words. Raises it where it is no frame's own, or one of many."""
        if isinstance(error, ScopemapError):
            raise error
        reason = f"{self._stage} failed: {' '.join(str(error).split())[:200] or type(error).__name__}"
        self.first = self.first if self.failed else (index, reason)
        self.failed += 1
        if self.failed > _MOST_FAULTS and self.failed > _MOST_FAULTS_SHARE * self.frames:
            first = "frame {}, {}".format(*self.first)
            error.add_note(f"the run ends at frame {index}: {self.failed} frames failed, first {first}")
            raise error
        return reason


def notices_of_faults(stages: Sequence[StageFaults]) -> list[Notice]:
    """Return what the stages could not process."""
    failed, blind, found = sum(faults.failed for faults in stages), sum(faults.without_depth for faults in stages), []
    if failed:
        index, reason = min(faults.first for faults in stages if faults.failed)
        found.append(Notice("frames-failed", {"frames": failed, "first": index, "reason": reason}))
    if blind:
        first_blind = next(faults.first_without_depth for faults in stages if faults.without_depth)
        found.append(Notice("frames-without-depth", {"frames": blind, "first": first_blind}))
    return found
