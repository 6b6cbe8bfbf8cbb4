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
# What is done after the last frame, in its order, and the share of that time that is left when it begins. Of 141
# results the adjustment took .25 (median; 80 % of them .06 to .48), surfaces .50 (.33 to .78), textures .22 (.09 to
# .36), by their `seconds`; writing and the report are not in these: by hand.
_LEFT_WHEN = {
    "adjusting keyframes": 1.0,
    "fusing": 0.75,
    "texturing": 0.25,
    "writing": 0.06,
    "writing the report": 0.05,
}
# Of what is counted in a phase: from then on its own pace tells more than how long tracking took. By hand.
_LEAST_COUNTED = 0.1

TRACKING_AGAIN = "tracking again"
"""With this begins what a run says when it begins again at its first frame."""


def of_all(total: int | None) -> str:
    """Return " of" so many; "" where their number is unknown."""
    return f" of {total}" if total else ""


class ProgressMeter:
    """Counts the frames of a run; total : their number, None: unknown.

    adjusts : whether keyframes are adjusted after the last frame, and frames fused then.
    """

    def __init__(self, total: int | None, *, adjusts: bool = True) -> None:
        self._share_afterwards = _SHARE_AFTERWARDS if adjusts else _SHARE_UNADJUSTED
        self.started, self.done, self.lost, self.text = time.perf_counter(), 0, 0, ""
        self._total, self._first = total, 1
        self._maps = Counter[int]()
        self._last_s, self._phase, self._phase_s = self.started, "", self.started
        self._share_done = 0.0

    @property
    def time_left(self) -> str:
        """The time until the result is written, with a comma; "" before the second frame.

        Also "" while frames are tracked whose number is unknown. Frames per second are reported once, for the whole
        run: tracking alone is faster.
        """
        if self._phase:
            return self._time_left_afterwards
        if self.done <= self._first or not self._total:
            return ""
        rate = (self.done - self._first) / max(time.perf_counter() - self.started, 1e-9)
        frames_left = max(self._total - self.done, 0) + self._share_afterwards * self._total
        return f"about {frames_left / rate:.0f} s left, "

    @property
    def _time_left_afterwards(self) -> str:
        """As `time_left`, after the last frame: by how long tracking took, and by how much of a phase is done."""
        spent_s, left = time.perf_counter() - self._phase_s, _LEFT_WHEN[self._phase]
        later = max((share for share in _LEFT_WHEN.values() if share < left), default=0.0)
        is_counted, is_tracked = self._share_done > _LEAST_COUNTED, self.done > self._first
        phase_s = spent_s / self._share_done if is_counted else 0.0
        if is_tracked:
            tracking_s = (self._last_s - self.started) * self.done / (self.done - self._first)
            all_s = self._share_afterwards * tracking_s
        else:  # a run that was resumed after its last frame
            all_s = phase_s / (left - later)
        if is_counted:
            return f"about {phase_s - spent_s + later * all_s:.0f} s left, "
        if not is_tracked:
            return ""
        is_in_time = spent_s < (left - later) * all_s
        left_s = left * all_s - spent_s if is_in_time else later * all_s
        return f"{'about' if is_in_time else 'at least'} {max(left_s, 1):.0f} s left, "

    @property
    def line(self) -> str:
        """The last frame, the time left, and how tracking goes."""
        return f"frame {self.done}{of_all(self._total)}: {self.time_left}{self.text}"

    def words(self, doing: str, done: int, frames: int) -> str:
        """Return what is done outside of tracking, as `Progress` is called with it; a resumed run counts on."""
        if doing != self._phase:
            self._phase, self._phase_s = doing if doing in _LEFT_WHEN else "", time.perf_counter()
        self._share_done = done / frames if frames else 0.0
        if doing.startswith(TRACKING_AGAIN):
            self.started, self.done, self.lost, self._first = time.perf_counter(), 0, 0, 1
            self._maps.clear()
        if doing == "resuming":
            self.done, self._first = done, done + 1
            return f"resuming after {done} frames"
        counted = f"{doing} frame {done} of {frames}" if frames else doing
        return ": ".join(filter(None, (counted, self.time_left.rstrip(", "))))

    def add(self, step: Step) -> None:
        """Count the next frame."""
        if self.done < self._first:
            self.started = time.perf_counter()
        self.done += 1
        self._last_s, self._phase = time.perf_counter(), ""
        if step.track.status == "lost":
            self.lost += 1
            self.text = f"lost: {step.track.reason}"
        else:
            self._maps[step.track.map] += 1
            elsewhere = self._maps.total() - max(self._maps.values())
            counts = ((self.lost, "lost"), (elsewhere, "in other submaps"))
            counted = ", ".join(f"{count} {words}" for count, words in counts if count)
            self.text = "tracked" + (f" (so far {counted})" if counted else "")
