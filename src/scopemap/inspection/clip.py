"""The figures of a whole video, as arrays over its pictures."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from scopemap.inspection.finding import Stretch
from scopemap.inspection.view import Figures


@dataclass(frozen=True)
class Clip:
    """What was read.

    Attributes
    ----------
    figures : of every picture, in order. stamped : whether its time stamps are the video's own, not counted.
    """

    figures: tuple[Figures, ...]
    stamped: bool

    def __len__(self) -> int:
        return len(self.figures)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return one figure, a name of `Figures`, of all pictures, (N,)."""
        if name not in {field.name for field in fields(Figures)}:
            raise KeyError(name)
        return np.array([getattr(figures, name) for figures in self.figures])

    @property
    def rate_hz(self) -> float:
        """Usual number of pictures per second; 0 where it is unknown."""
        steps_s = np.diff(self["time_s"])
        usual_s = float(np.median(steps_s)) if steps_s.size else 0.0
        return 1 / usual_s if usual_s > 0 else 0.0

    def frames_in(self, seconds: float, least: int) -> int:
        """Return how many pictures last that long, `least` or more."""
        return max(least, round(seconds * self.rate_hz))

    def selecting(self, stretches: tuple[Stretch, ...]) -> str:
        """Return the options that leave stretches out, in words."""
        first, last = stretches[0][0], stretches[-1][1]
        inner = [(a, b) for a, b in stretches if a > 0 and b < len(self) - 1]
        begin = stretches[0][1] + 1 if first == 0 else 0
        end = stretches[-1][0] if last == len(self) - 1 else len(self)
        if begin >= end:
            return ""
        bounds = [begin, *(bound for a, b in inner for bound in (a, b + 1)), end]
        parts = [(a, b) for a, b in zip(bounds[::2], bounds[1::2], strict=True) if b > a]
        a, b = max(parts, key=lambda part: part[1] - part[0])
        option = f"--frames {a or ''}:{b if b < len(self) else ''}"
        return f"leave them out with {option}" if not inner else f"the longest part without them: {option}"
