"""Time stamps of a video, repaired while its frames are read in order."""

from __future__ import annotations

# A recording may pause, a time lapse be slow; a stamp that runs ahead by more is of another clock.
LONGEST_GAP_S = 60.0
_LONGEST_GAP_FRAMES = 10
# AVI and WMV keep the stamps of reordered frames slightly out of order; a clock that goes back by more began again.
_DISORDER_S = 1.0


class TimeStamps:
    """Repairs stamps while frames are read in order.

    rate_hz : frames per second. first : number of the first frame that is read. A stamp that is missing, or does not
    increase, is put at the rate after the last one that was there; those before the first one lead up to it. Where one
    goes back by more than a second, or runs ahead by more than a minute (ten frames of a slow clip), all that follow
    are moved with it: files that were joined each begin at 0.

    repaired, first_repaired : how many stamps were missing or moved, and the number of the first such frame. span_s :
    time from the first to the last stamp as the stream has them, s.
    """

    def __init__(self, rate_hz: float, first: int = 0) -> None:
        self._rate_hz, self._first, self._shift_s, self._known = rate_hz, first, 0.0, (0, 0.0)
        self._last_s: float | None = None
        self._first_stamp_s: float | None = None
        self.repaired, self.span_s = 0, 0.0
        self.first_repaired: int | None = None

    def __call__(self, index: int, stamp_s: float | None) -> float:
        """Return when the frame with number `index` was taken, s, by its stamp, s or None."""
        number, known_s = self._known
        time_s = known_s + (index - number) / self._rate_hz
        longest_s = max(LONGEST_GAP_S, _LONGEST_GAP_FRAMES / self._rate_hz)
        step_s = stamp_s + self._shift_s - self._last_s if stamp_s is not None and self._last_s is not None else None
        if self._first_stamp_s is None:
            # Cut videos have no stamps before the cut: the first one that is there goes on from frame 0.
            self._shift_s = 0.0 if stamp_s is None or index == self._first else time_s - stamp_s
            time_s = time_s if stamp_s is None else stamp_s + self._shift_s
        elif stamp_s is not None and step_s is not None and 0 < step_s <= longest_s:
            time_s = stamp_s + self._shift_s
        else:
            if stamp_s is not None and step_s is not None and not -_DISORDER_S <= step_s <= 0:
                self._shift_s = time_s - stamp_s
            self.first_repaired = index if self.first_repaired is None else self.first_repaired
            self.repaired += 1
        if stamp_s is not None:
            self._known = (index, time_s)
            self._first_stamp_s = stamp_s if self._first_stamp_s is None else self._first_stamp_s
            self.span_s = stamp_s - self._first_stamp_s
        self._last_s = time_s
        return time_s
