"""The measures of a whole video as arrays over its frames, and findings about stretches of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scopemap.inspection.frame_measures import FrameMeasures
from scopemap.io.datasets import checking

_NAMED = 4

Stretch = tuple[int, int]
"""First and last position of frames that follow each other; positions count from 0, as `--frames` does."""


@dataclass(frozen=True)
class VideoFinding(checking.Finding):
    """One finding: `advice` is the option in full, or ""; `stretches` are its frames, empty: the whole video."""

    advice: str = ""
    stretches: tuple[Stretch, ...] = ()


def stretches_of(flags: np.ndarray, least: int = 1, gap: int = 0) -> tuple[Stretch, ...]:
    """Return where `flags` (N,) bool is True for `least` frames or more; up to `gap` False between two are bridged."""
    true = np.flatnonzero(flags)
    if not true.size:
        return ()
    cuts = [0, *(i for i, (a, b) in enumerate(pairwise(true), start=1) if b - a > gap + 1), len(true)]
    found = ((int(true[a]), int(true[b - 1])) for a, b in pairwise(cuts))
    return tuple((first, last) for first, last in found if last - first + 1 >= least)


def covered(stretches: Sequence[Stretch], count: int) -> np.ndarray:
    """Return (count,) bool: which frames are in any of the stretches."""
    flags = np.zeros(count, bool)
    for first, last in stretches:
        flags[first : last + 1] = True
    return flags


def worded(stretches: Sequence[Stretch]) -> str:
    """Return the stretches in words, those after the fourth counted."""
    named = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in stretches[:_NAMED])
    return named + (f" and {len(stretches) - _NAMED} more" if len(stretches) > _NAMED else "")


@dataclass(frozen=True)
class Clip:
    """The frames that were read: their measures, whether time stamps are the video's own, and the selection."""

    measures: tuple[FrameMeasures, ...]
    stamped: bool
    selection: slice

    def __len__(self) -> int:
        return len(self.measures)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return one measure, a name of `FrameMeasures`, of all frames, (N,)."""
        return np.array([getattr(measures, name) for measures in self.measures])

    @property
    def is_whole(self) -> bool:
        """Whether all of the video was to be read."""
        return (self.selection.start or 0, self.selection.stop, self.step) == (0, None, 1)

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

    def stretches(self, flags: np.ndarray, seconds: float, least: int, gap: int = 0) -> tuple[Stretch, ...]:
        """Return the stretches of `flags` (N,) bool that last `seconds` and have at least `least` frames."""
        return stretches_of(flags, max(least, round(seconds * self.rate_hz / self.step)), gap)

    def positions(self, stretches: tuple[Stretch, ...]) -> tuple[Stretch, ...]:
        """Return stretches of the frames that were read as stretches of positions in the video."""
        return tuple((self.measures[a].position, self.measures[b].position) for a, b in stretches)

    def counted(self, stretches: tuple[Stretch, ...]) -> str:
        """Return the number of frames in stretches of the frames that were read, and their positions, in words."""
        count = sum(last - first + 1 for first, last in stretches)
        return f"{count} frame{'s' * (count != 1)} ({worded(self.positions(stretches))})"

    def selecting(self, stretches: tuple[Stretch, ...]) -> str:
        """Return the option that leaves out stretches of the frames that were read, in words."""
        first, last = stretches[0][0], stretches[-1][1]
        inner = [(a, b) for a, b in stretches if a > 0 and b < len(self) - 1]
        begin = stretches[0][1] + 1 if first == 0 else 0
        end = stretches[-1][0] if last == len(self) - 1 else len(self)
        if begin >= end:
            return ""
        bounds = [begin, *(bound for a, b in inner for bound in (a, b + 1)), end]
        parts = [(a, b) for a, b in zip(bounds[::2], bounds[1::2], strict=True) if b > a]
        a, b = max(parts, key=lambda part: part[1] - part[0])
        start = self.selection.start if a == 0 else self.measures[a].position
        stop = self.selection.stop if b == len(self) else self.measures[b].position
        bounds_in_words = f"{start or ''}:{'' if stop is None else stop}"
        option = f"--frames {bounds_in_words}" + (f":{self.step}" if self.step > 1 else "")
        return f"leave them out with {option}" if not inner else f"the longest part without them: {option}"
