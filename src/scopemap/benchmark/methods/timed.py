"""TimedTracker: how long an odometry takes by itself, without reading, depth and fusion around it."""

from __future__ import annotations

import time

from scopemap.frame import Frame
from scopemap.tracking import FrameTracker, Track


class TimedTracker:
    """A `FrameTracker` around another one: answers as that one does, and adds up the seconds it took.

    Wall time of `track` and `adopt`, failed calls included, so that preparing a reference counts as well as aligning
    to it. Threads that work on the next frame at the same time take their share of the machine all the same.

    Attributes
    ----------
    track_s, adopt_s : seconds so far.
    """

    def __init__(self, tracker: FrameTracker) -> None:
        self._tracker = tracker
        self.track_s = 0.0
        self.adopt_s = 0.0

    @property
    def seconds(self) -> float:
        """Seconds of both calls so far."""
        return self.track_s + self.adopt_s

    def track(self, frame: Frame) -> Track:
        """Return what the tracker says of a frame; raises what it raises."""
        started = time.perf_counter()
        try:
            return self._tracker.track(frame)
        finally:
            self.track_s += time.perf_counter() - started

    def wants_keyframe(self) -> bool:
        """Return whether the tracker wants the frame that was tracked last as a reference."""
        return self._tracker.wants_keyframe()

    def adopt(self, frame: Frame, *, measured: bool) -> bool:
        """Hand a reference to the tracker; return whether it took it, raise what it raises."""
        started = time.perf_counter()
        try:
            return self._tracker.adopt(frame, measured=measured)
        finally:
            self.adopt_s += time.perf_counter() - started
