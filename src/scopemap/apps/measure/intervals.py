"""Intervals of measures, in closed form: how far each source of error moves a figure, added as squares.

A source moves a figure when it stands at the lower and at the upper end of its own 95 % interval. Sources are
independent, so what raises ln of the figure adds as squares above it, and what lowers it below it (propagation of
uncertainty by differences: JCGM 100:2008, 5.1.2, kept apart for both signs, since a depth error lengthens a short
distance whichever way it goes). Sources that two figures of a frame share cancel in their ratio.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

SIGMAS = 1.96
"""Ends of a 95 % interval of a normal distribution, standard deviations."""

_SHARED = ("the depth of the frame", "the focal length", "the scale")


@dataclass(frozen=True)
class LogChanges:
    """Changes of ln of a figure as each source stands at its lower and at its upper end.

    shared : (3, 2) by the depth of the whole frame, by the focal length, and by the scale, which other figures share.
    own : (S, 2) by sources that no other figure has.
    """

    shared: np.ndarray = field(default_factory=lambda: np.zeros((3, 2)))
    own: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    @classmethod
    def of_scale(cls, sigma: float) -> LogChanges:
        """Return those of a scale with this standard deviation of its ln."""
        return cls(np.array([[0, 0], [0, 0], [-SIGMAS * sigma, SIGMAS * sigma]]))

    @classmethod
    def of_own(cls, sigma: float) -> LogChanges:
        """Return those by one more source with this standard deviation of ln."""
        return cls(own=np.array([[-SIGMAS * sigma, SIGMAS * sigma]]))

    def times(self, other: LogChanges) -> LogChanges:
        """Return those of the product of two figures."""
        return LogChanges(self.shared + other.shared, np.concatenate([self.own, other.own]))

    def to_power(self, power: float) -> LogChanges:
        """Return those of a power of the figure."""
        return LogChanges(power * self.shared, power * self.own)

    def main_source(self, of_own: str) -> str:
        """Return what widens the interval most, in words; of_own : the figure's own sources, in words."""
        size = np.square(np.abs(self.shared).max(axis=1, initial=0))
        own = float(np.square(np.abs(self.own).max(axis=1, initial=0)).sum())
        return (*_SHARED, of_own)[int(np.argmax([*size, own]))]

    @property
    def factors(self) -> tuple[float, float]:
        """The ends of the figure's 95 % interval over its value."""
        changes = np.concatenate([self.shared, self.own])
        lower, higher = np.minimum(changes, 0).min(axis=1), np.maximum(changes, 0).max(axis=1)
        return float(np.exp(-np.linalg.norm(lower))), float(np.exp(np.linalg.norm(higher)))
