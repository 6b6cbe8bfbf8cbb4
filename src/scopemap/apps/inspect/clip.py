"""The measures of a whole video as arrays over its frames, and findings about segments of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scopemap.apps.inspect.frame_measures import FrameMeasures
from scopemap.input.picture_difference import LEAST_DIFFERENCE

_NAMED = 4
Severity = Literal["error", "warning", "info"]

Segment = tuple[int, int]
"""First and last position of frames that follow each other; positions count from 0, as `--frames` does."""


@dataclass(frozen=True)
class Finding:
    """A fault or an assumption: its severity, a short code, one sentence."""

    severity: Severity
    code: str
    message: str


@dataclass(frozen=True)
class VideoFinding(Finding):
    """One finding: `advice` is the option in full, or ""; `segments` are its frames, empty: the whole video."""

    advice: str = ""
    segments: tuple[Segment, ...] = ()


def segments_of(flags: np.ndarray, least: int = 1, gap: int = 0, part: np.ndarray | None = None) -> tuple[Segment, ...]:
    """Return where `flags` (N,) bool is True for `least` frames or more; up to `gap` False between two are bridged.

    part : (N,) numbers of the parts of a video that the frames are of; no segment is of two parts.
    """
    true = np.flatnonzero(flags)
    breaks = np.diff(true) > gap + 1
    if part is not None:
        breaks |= np.diff(part[true]) > 0
    found = np.split(true, np.flatnonzero(breaks) + 1) if true.size else []
    return tuple((int(one[0]), int(one[-1])) for one in found if one[-1] - one[0] + 1 >= least)


def covered(segments: Sequence[Segment], count: int) -> np.ndarray:
    """Return (count,) bool: which frames are in any of the segments."""
    flags = np.zeros(count, bool)
    for first, last in segments:
        flags[first : last + 1] = True
    return flags


@dataclass(frozen=True)
class Clip:
    """The frames that were read: their measures, whether time stamps are the video's own, and the selection.

    count : frames of the selection, read or not; those that were read where only reading on would tell.
    """

    measures: tuple[FrameMeasures, ...]
    stamped: bool
    selection: slice
    count: int

    def __len__(self) -> int:
        return len(self.measures)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return one measure, a name of `FrameMeasures`, of all frames, (N,)."""
        return np.array([getattr(measures, name) for measures in self.measures])

    @property
    def step(self) -> int:
        """From one position that was read to the next."""
        return int(self.selection.step or 1)

    @property
    def steps_s(self) -> np.ndarray:
        """Time from each frame to the next that was read, (N - 1,) s, per position between; unreadable ones count."""
        return np.diff(self["time_s"]) / np.maximum(np.diff(self["position"]), 1)

    @property
    def rate_hz(self) -> float:
        """Usual number of frames per second in the video; 0 where it is unknown."""
        steps_s = self.steps_s
        usual_s = float(np.median(steps_s)) if steps_s.size else 0.0
        return 1 / usual_s if usual_s > 0 else 0.0

    @property
    def repeats(self) -> np.ndarray:
        """Which frames repeat the last one that was no repeat, (N,) bool; blank frames repeat nothing."""
        return (self["change"] < LEAST_DIFFERENCE) & ~self["blank"]

    def segments(self, flags: np.ndarray, seconds: float = 0.0, least: int = 1, gap: int = 0) -> tuple[Segment, ...]:
        """Return the segments of `flags` (N,) bool that last `seconds` and have at least `least` frames."""
        return segments_of(flags, max(least, round(seconds * self.rate_hz / self.step)), gap, self["part"])

    def finding(
        self, severity: Severity, code: str, message: str, segments: tuple[Segment, ...], advice: str = ""
    ) -> VideoFinding:
        """Return a finding about segments of the frames that were read.

        In `message` "{frames}" stands for their number and positions, "{positions}" for the positions alone. In
        `advice` "{selection}" stands for the option that leaves them out.
        """
        places = tuple((self.measures[a].position, self.measures[b].position) for a, b in segments)
        named = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in places[:_NAMED])
        named += f" and {len(places) - _NAMED} more" if len(places) > _NAMED else ""
        count = sum(last - first + 1 for first, last in segments)
        message = message.replace("{frames}", f"{count} frame{'s' * (count != 1)} ({named})")
        message = message.replace("{positions}", named)
        return VideoFinding(severity, code, message, advice.replace("{selection}", self._selecting(segments)), places)

    def _selecting(self, segments: tuple[Segment, ...]) -> str:
        """Return the option that leaves out segments of the frames that were read, in words; "" if nothing is left."""
        parts = segments_of(~covered(segments, len(self)))
        if not parts:
            return ""
        first, last = max(parts, key=lambda part: part[1] - part[0])
        start = self.selection.start if first == 0 else self.measures[first].position
        stop = self.selection.stop if last == len(self) - 1 else self.measures[last + 1].position
        bounds = f"{start or ''}:{'' if stop is None else stop}" + (f":{self.step}" if self.step > 1 else "")
        what = "leave them out with" if len(parts) == 1 else "the longest part without them:"
        return f"{what} --frames {bounds}"
