"""Something that was found on a surface, with its sizes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.apps.measure.measure import Measure


@dataclass(frozen=True)
class SurfaceFinding:
    """Something on the surface of a run: its outline, its two ends, or its place.

    points_mm : (N, 3) around it, (2, 3), or (1, 3), world. sizes : NaN for the ends of an interval that is not known.
    """

    name: str
    points_mm: np.ndarray
    sizes: list[Measure]

    def __str__(self) -> str:
        return f"{self.name}: {'; '.join(map(str, self.sizes))}"
