"""StandingStill: an odometry that never moves, so that every table shows what doing nothing scores."""

from __future__ import annotations

import numpy as np

from scopemap.frame import Frame
from scopemap.tracking import Track

_LEAST_SHARE = 0.1  # of the image, as our own tracker asks by default


class StandingStill:
    """A `FrameTracker` that answers the first pose for every frame that shows anything.

    Frames that the others lose for want of usable pixels are lost here, too: standing still must not win by coverage.
    A trajectory without motion has no scale, so an alignment by Sim(3) may refuse it; errors without alignment, or
    with the origin alone, stand.
    """

    def __init__(self) -> None:
        self._first: int | None = None

    def track(self, frame: Frame) -> Track:
        """Return the identity; "lost" where less than a tenth of the image is usable."""
        share = float(frame.valid.mean())
        reference = frame.index if self._first is None else self._first
        if share < _LEAST_SHARE:
            return Track(frame.index, "lost", f"only {share:.0%} of the image is usable", np.eye(4), reference)
        if self._first is None:
            self._first = frame.index
            return Track(frame.index, "initial", "fixes the world", np.eye(4), frame.index)
        return Track(frame.index, "ok", "", np.eye(4), reference)

    def wants_keyframe(self) -> bool:
        """Return False: nothing is compared with anything."""
        return False

    def adopt(self, frame: Frame, *, measured: bool) -> bool:
        """Return False: a frame is no reference here."""
        return False
