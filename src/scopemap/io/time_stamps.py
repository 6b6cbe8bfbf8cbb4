"""Repair of a video's time stamps: those of the stream where they are plausible."""

from __future__ import annotations

# A recording may pause, a time lapse be slow; a stamp that runs ahead by more is of another clock.
_LONGEST_GAP_S, _LONGEST_GAP_FRAMES = 60.0, 10
# AVI and WMV keep the stamps of reordered frames slightly out of order; a clock that goes back by more began anew.
_DISORDER_S = 1.0


class TimeStamps:
    """Repairs stamps while frames are read in order.

    rate_hz : frames per second. A stamp that is missing is put at the rate after the last one that was there. One that
    does not increase is too; where it goes back by more than a second, or runs ahead by more than a minute (ten frames
    of a slow clip), all that follow are moved with it: files that were joined each begin at 0.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz, self._shift_s = rate_hz, 0.0
        self._known = (0, 0.0)
        self._last_s: float | None = None
        self.repaired = 0
        """How many stamps were missing or moved."""
        self.first_repaired: int | None = None
        """Number of the first such frame."""
        self._stated_s: tuple[float, float] | None = None

    @property
    def span_s(self) -> float:
        """Time from the first to the last stamp as the stream has them, s."""
        return 0.0 if self._stated_s is None else self._stated_s[1] - self._stated_s[0]

    def __call__(self, index: int, stamp_s: float | None) -> float:
        """Return when the frame with number `index` was taken, s, by its stamp, s or None."""
        number, known_s = self._known
        time_s = known_s + (index - number) / self._rate_hz
        if stamp_s is not None and self._is_plausible(stamp_s + self._shift_s):
            time_s = stamp_s + self._shift_s
        else:
            if stamp_s is not None and not self._is_disordered(stamp_s + self._shift_s):
                self._shift_s = time_s - stamp_s
            self.first_repaired = index if self.first_repaired is None else self.first_repaired
            self.repaired += 1
        if stamp_s is not None:
            self._known = (index, time_s)
            self._stated_s = (stamp_s if self._stated_s is None else self._stated_s[0], stamp_s)
        self._last_s = time_s
        return time_s

    def _is_plausible(self, time_s: float) -> bool:
        longest_s = max(_LONGEST_GAP_S, _LONGEST_GAP_FRAMES / self._rate_hz)
        return self._last_s is None or 0 < time_s - self._last_s <= longest_s

    def _is_disordered(self, time_s: float) -> bool:
        return self._last_s is not None and -_DISORDER_S <= time_s - self._last_s <= 0
