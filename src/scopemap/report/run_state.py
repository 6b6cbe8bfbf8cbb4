"""The progress of a run in words, for the terminal and a notebook."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scopemap.engine.odometry import Step

# Time per frame after the last one (adjustment, fusion, writing) over that until then: `seconds` in provenance.json of
# six real clips have .7 to 2.2, most of them 1; and where nothing is adjusted.
_SHARE_AFTERWARDS = 1.0
_SHARE_UNADJUSTED = 0.05

TRACKING_AGAIN = "tracking again"
"""With this begins what a run says when it begins again at its first frame."""


def of_all(total: int | None) -> str:
    """Return " of" so many; "" where their number is unknown."""
    return f" of {total}" if total else ""


class RunState:
    """Counts the frames of a run; total : their number, None: unknown.

    adjusts : whether keyframes are adjusted after the last frame, and frames fused then.
    """

    def __init__(self, total: int | None, *, adjusts: bool = True) -> None:
        self._share_afterwards = _SHARE_AFTERWARDS if adjusts else _SHARE_UNADJUSTED
        self.started, self.done, self.lost, self.text = time.perf_counter(), 0, 0, ""
        self._total, self._first = total, 1
        self._maps = Counter[int]()

    @property
    def time_left(self) -> str:
        """The time until the result is written; "" before the second frame, and where the number of frames is unknown.

        Frames per second are reported once, for the whole run: tracking alone is faster.
        """
        if self.done <= self._first or not self._total:
            return ""
        rate = (self.done - self._first) / max(time.perf_counter() - self.started, 1e-9)
        frames_left = max(self._total - self.done, 0) + self._share_afterwards * self._total
        return f"about {frames_left / rate:.0f} s left, "

    @property
    def line(self) -> str:
        """The last frame, the time left, and how tracking goes."""
        return f"frame {self.done}{of_all(self._total)}: {self.time_left}{self.text}"

    def words(self, doing: str, done: int, frames: int) -> str:
        """Return what is done outside of tracking, as `Progress` is called with it; a resumed run counts on."""
        if doing.startswith(TRACKING_AGAIN):
            self.started, self.done, self.lost, self._first = time.perf_counter(), 0, 0, 1
            self._maps.clear()
        if doing == "resuming":
            self.done, self._first = done, done + 1
            return f"resuming after {done} frames"
        return f"{doing} frame {done} of {frames}" if frames else doing

    def add(self, step: Step) -> None:
        """Count the next frame."""
        if self.done < self._first:
            self.started = time.perf_counter()
        self.done += 1
        if step.track.status == "lost":
            self.lost += 1
            self.text = f"lost: {step.track.reason}"
        else:
            self._maps[step.track.map] += 1
            elsewhere = self._maps.total() - max(self._maps.values())
            counts = ((self.lost, "lost"), (elsewhere, "in other submaps"))
            counted = ", ".join(f"{count} {words}" for count, words in counts if count)
            self.text = "tracked" + (f" (so far {counted})" if counted else "")
