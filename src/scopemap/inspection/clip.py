"""The figures of a whole video, as arrays over its pictures."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from scopemap.inspection.finding import Stretch, worded
from scopemap.inspection.view import Figures


@dataclass(frozen=True)
class Clip:
    """What was read.

    Attributes
    ----------
    figures : of every picture, in order. stamped : whether its time stamps are the video's own, not counted.
    selection : which positions were to be read.
    """

    figures: tuple[Figures, ...]
    stamped: bool
    selection: slice

    def __len__(self) -> int:
        return len(self.figures)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return one figure, a name of `Figures`, of all pictures, (N,)."""
        if name not in {field.name for field in fields(Figures)}:
            raise KeyError(name)
        return np.array([getattr(figures, name) for figures in self.figures])

    @property
    def is_whole(self) -> bool:
        """Whether all of the video was to be read."""
        return self.selection in (slice(None), slice(0, None), slice(0, None, 1), slice(None, None, 1))

    @property
    def step(self) -> int:
        """From one position that was read to the next."""
        return int(self.selection.step or 1)

    @property
    def steps_s(self) -> np.ndarray:
        """Time from each picture to the next that was read, (N - 1,) s, per position between; unreadable ones count."""
        return np.diff(self["time_s"]) / np.maximum(np.diff(self["position"]), 1)

    @property
    def rate_hz(self) -> float:
        """Usual number of pictures per second in the video; 0 where it is unknown."""
        steps_s = self.steps_s
        usual_s = float(np.median(steps_s)) if steps_s.size else 0.0
        return 1 / usual_s if usual_s > 0 else 0.0

    def frames_in(self, seconds: float, least: int) -> int:
        """Return how many of the pictures that were read last that long, `least` or more."""
        return max(least, round(seconds * self.rate_hz / self.step))

    def positions(self, stretches: tuple[Stretch, ...]) -> tuple[Stretch, ...]:
        """Return stretches of what was read as stretches of positions in the video."""
        return tuple((self.figures[a].position, self.figures[b].position) for a, b in stretches)

    def selecting(self, stretches: tuple[Stretch, ...]) -> str:
        """Return the options that leave stretches of what was read out, in words."""
        first, last = stretches[0][0], stretches[-1][1]
        inner = [(a, b) for a, b in stretches if a > 0 and b < len(self) - 1]
        begin = stretches[0][1] + 1 if first == 0 else 0
        end = stretches[-1][0] if last == len(self) - 1 else len(self)
        if begin >= end:
            return ""
        bounds = [begin, *(bound for a, b in inner for bound in (a, b + 1)), end]
        parts = [(a, b) for a, b in zip(bounds[::2], bounds[1::2], strict=True) if b > a]
        a, b = max(parts, key=lambda part: part[1] - part[0])
        start = self.selection.start if a == 0 else self.figures[a].position
        stop = self.selection.stop if b == len(self) else self.figures[b].position
        bounds_in_words = f"{start or ''}:{'' if stop is None else stop}"
        option = f"--frames {bounds_in_words}" + (f":{self.step}" if self.step > 1 else "")
        return f"leave them out with {option}" if not inner else f"the longest part without them: {option}"


def frames_of(clip: Clip, stretches: tuple[Stretch, ...]) -> str:
    """Return how many of the pictures that were read lie in stretches of these, and at which positions, in words."""
    count = sum(last - first + 1 for first, last in stretches)
    return f"{count} frame{'s' * (count != 1)} ({worded(clip.positions(stretches))})"
