"""StandingStill: a tracker whose camera never moves, the score of doing nothing."""

from __future__ import annotations

import numpy as np

from scopemap.frame import Frame
from scopemap.tracking.track import FrameTracker, Track

_MIN_USABLE_SHARE = 0.1  # of the image, the default of our own tracker


class StandingStill(FrameTracker):
    """A `FrameTracker` that returns the first pose for every frame.

    Frames with too few usable pixels are lost, as they are for the other methods, so that coverage is comparable. A
    trajectory without motion has no scale: Sim(3) alignment may refuse it; errors without alignment, or with the origin
    alone, are measured.
    """

    def __init__(self) -> None:
        self._first: int | None = None

    def track(self, frame: Frame) -> Track:
        """Return the identity; "lost" where less than a tenth of the image is usable."""
        share = float(frame.valid.mean())
        reference = frame.index if self._first is None else self._first
        if share < _MIN_USABLE_SHARE:
            return Track(frame.index, "lost", f"only {share:.0%} of the image is usable", np.eye(4), reference)
        if self._first is None:
            self._first = frame.index
            return Track(frame.index, "initial", "fixes the world", np.eye(4), frame.index)
        return Track(frame.index, "ok", "", np.eye(4), reference)

    def needs_keyframe(self) -> bool:
        """Return False: it uses no keyframes."""
        return False

    def insert_keyframe(self, frame: Frame, *, measured: bool) -> bool:
        """Return False: it uses no keyframes."""
        return False
