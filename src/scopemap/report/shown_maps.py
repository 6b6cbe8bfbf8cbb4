"""What a page shows surfaces of: the result, its other submaps, and its other segments, each for its own frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from scopemap.engine.notices import Level
from scopemap.result.frame_table import NOT_USED
from scopemap.result.result import Result
from scopemap.result.verdict import level_of_submap
from scopemap.result.wording import LEVEL_WORDS

_MOST_SUBMAPS = 8
_MOST_SEGMENTS = 24
"""The longest of them; the frames of others are shown with the main surface."""


@dataclass(frozen=True)
class MapOnPage:
    """A surface and the frames that it is of.

    result : the result, or one of its submaps. segment : number of the segment there. name, short : in words, and in a
    letter or a number. folder : of the result or submap in that of the whole result. level : of the verdict on it.
    """

    result: Result
    segment: int
    name: str
    short: str
    folder: str
    level: Level

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The surface, world mm."""
        return self.result.surface(self.segment)

    @property
    def facts(self) -> dict[str, str]:
        """What the page needs of it beside its surface."""
        word = LEVEL_WORDS[self.level]
        return {"name": self.name, "short": self.short, "folder": self.folder, "level": self.level, "word": word}


def shown_maps(run: Result) -> list[MapOnPage]:
    """Return the result's main surface, then those of its other submaps, then those of its other segments."""
    segments, main = run.segments, run.main_segment
    name, level = "The result", level_of_submap(run)
    if len(segments) > 1:
        name, level = f"Segment {segments[main].words}, the main one", segments[main].level
    found = [MapOnPage(run, main, name, "R", ".", level)]
    for number, submap in enumerate(run.submaps[1:_MOST_SUBMAPS], 1):
        words, folder = f"Submap {number} (maps/{number})", f"maps/{number}"
        found.append(MapOnPage(submap, submap.main_segment, words, str(number), folder, level_of_submap(submap)))
    others = sorted((one for one in segments if one.segment != main), key=lambda one: -one.duration_s)[:_MOST_SEGMENTS]
    for one in sorted(others, key=lambda one: one.segment):
        found.append(MapOnPage(run, one.segment, f"Segment {one.words}", f"S{one.segment}", ".", one.level))
    return found


def opening_row(run: Result) -> int:
    """Return the row in the run's table of the frame that is shown first: the first of the result's main segment.

    Where no frame is in the main segment, it is the first that was used; 0 where there is none.
    """
    frames = run.frames
    inside = frames.submap == 0
    for found in (inside & (frames["segment"] == run.main_segment), inside, frames.submap != NOT_USED):
        if found.any():
            return int(np.argmax(found))
    return 0


def shown_map_numbers(run: Result, maps: list[MapOnPage]) -> np.ndarray:
    """Return the number of each frame's map (N,), as `FrameTable.submap` for frames in none."""
    submap = run.frames.submap.copy()
    inside = submap == 0
    for number, one in enumerate(maps):
        if one.result is run and number:
            submap[inside & (run.frames["segment"] == one.segment)] = number
    return submap
