"""A place that changed between two examinations, as the views of either show it, and what the views of both show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scopemap.engine.geometry.align import Similarity


@dataclass(frozen=True)
class Change:
    """A place that is not as it was.

    what : "shape", "colour", or "shape and colour". place_mm : (3,), world of the first. area : square mm of the first.
    rise_mm : by how much the second surface is nearer to the camera. redness : change of ln of red over green. views :
    keyframes that show it, at most. frames : numbers of the frames of both that show it best, -1: none. seen_in : whose
    views show it.
    """

    what: str
    place_mm: np.ndarray
    area_mm2: float
    rise_mm: float
    redness: float
    sigmas: float
    views: int
    frames: tuple[int, int]
    seen_in: Literal["first", "second", "both"] = "first"

    def of_second(self, S_first_second: Similarity) -> Change:
        """Return in the world of the first what was found with the second examination as the first one."""
        return replace(
            self,
            place_mm=S_first_second.transform_points(self.place_mm),
            area_mm2=self.area_mm2 * S_first_second.scale**2,
            rise_mm=-self.rise_mm * S_first_second.scale,
            redness=-self.redness,
            frames=(self.frames[1], self.frames[0]),
            seen_in="second",
        )

    def enlarged(self, factor: float) -> Change:
        """Return the change in a world whose lengths are times a factor."""
        place_mm, area_mm2 = self.place_mm * factor, self.area_mm2 * factor**2
        return replace(self, place_mm=place_mm, area_mm2=area_mm2, rise_mm=self.rise_mm * factor)

    @property
    def radius_mm(self) -> float:
        """Of a circle with its area."""
        return float(np.sqrt(self.area_mm2 / np.pi))


def changes_of_both(of_first: list[Change], of_second: list[Change], beside_mm: float) -> list[Change]:
    """Return the changes that the views of the first or the second show: those of both first, then the surest.

    What both show is one change: two circles that touch, but for how far the wall rose and how far the surfaces are
    apart where nothing changed, `beside_mm`. Which of the two is the first does not matter.
    """
    apart = [
        (float(np.linalg.norm(one.place_mm - other.place_mm)), row, column)
        for row, one in enumerate(of_first)
        for column, other in enumerate(of_second)
    ]
    partner: dict[int, int] = {}
    for distance, row, column in sorted(apart):
        one, other = of_first[row], of_second[column]
        near = one.radius_mm + other.radius_mm + max(abs(one.rise_mm), abs(other.rise_mm)) + beside_mm
        if distance <= near and row not in partner and column not in partner.values():
            partner[row] = column
    found = [_as_one(of_first[row], of_second[column]) for row, column in partner.items()]
    found += [one for row, one in enumerate(of_first) if row not in partner]
    found += [one for column, one in enumerate(of_second) if column not in partner.values()]
    return sorted(found, key=lambda change: (change.seen_in != "both", -change.sigmas))


def _as_one(one: Change, other: Change) -> Change:
    """Return what the views of both show of a change, at its place on the first: means, and the surer one's frames."""
    words = [name for name in ("shape", "colour") if name in one.what or name in other.what]
    surer = max(one, other, key=lambda change: change.sigmas)
    return replace(
        surer,
        what=" and ".join(words),
        place_mm=one.place_mm,
        area_mm2=(one.area_mm2 + other.area_mm2) / 2,
        rise_mm=(one.rise_mm + other.rise_mm) / 2,
        redness=(one.redness + other.redness) / 2,
        views=one.views + other.views,
        seen_in="both",
    )
