"""The maps of a run beside each other: their order in time, and the one that agrees least with its own frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.result.frame_table import FrameTable


@dataclass(frozen=True)
class SubmapSummary:
    """A map of a run.

    number : of the map, 0 for the result and N for `maps/N`. frames : how many it has. first, last : numbers of its
    first and its last frame. inlier_share : median over its frames of the share of compared pixels that agree with the
    keyframe, NaN = unknown.
    """

    number: int
    frames: int
    first: int
    last: int
    inlier_share: float

    @property
    def name(self) -> str:
        """The folder that holds it, or "the result"."""
        return f"maps/{self.number}" if self.number else "the result"

    @property
    def inliers(self) -> str:
        """Its inliers in words, "" where they are unknown."""
        return "" if np.isnan(self.inlier_share) else f"{_percent(self.inlier_share)} inliers"


def submaps_in_time(frames: FrameTable) -> list[SubmapSummary]:
    """Return the maps of a run in the order of their first frames."""
    shares, submap, found = frames["inlier_share"], frames.submap, []
    for number in np.unique(submap[submap >= 0]).tolist():
        inside = submap == number
        indices, known = frames["index"][inside], shares[inside & np.isfinite(shares)]
        share = float(np.median(known)) if len(known) else float("nan")
        found.append(SubmapSummary(number, len(indices), int(indices.min()), int(indices.max()), share))
    return sorted(found, key=lambda submap: submap.first)


def most_doubtful(submaps: list[SubmapSummary]) -> SubmapSummary | None:
    """Return the submap of the lowest inlier share, None where fewer than two are known."""
    known = [submap for submap in submaps if not np.isnan(submap.inlier_share)]
    return min(known, key=lambda submap: submap.inlier_share) if len(known) > 1 else None


def doubt_words(submaps: list[SubmapSummary]) -> str:
    """Return which submap is the most doubtful and why, one phrase; "" where that is unknown."""
    worst = most_doubtful(submaps)
    if worst is None:
        return ""
    others = [submap.inlier_share for submap in submaps if submap is not worst and not np.isnan(submap.inlier_share)]
    rest = _percent(min(others)) + (f" to {_percent(max(others))}" if len(others) > 1 else "")
    where = f"{worst.name} (frames {worst.first} to {worst.last})"
    return f"{where}, with {worst.inliers} against {rest}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
