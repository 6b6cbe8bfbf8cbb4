"""The parts of a video between losses of the camera: which submap each is in, and what joins it to earlier ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scopemap.result.frame_table import NOT_USED
from scopemap.result.result import Result

_LEAST_GAP_S = 0.5


@dataclass(frozen=True)
class Join:
    """What joins a part to an earlier one of its submap.

    part : its place in the list. loops : how many loop closures. inliers : share of the compared pixels that agree with
    the earlier part's keyframe in which the camera was found again, NaN where it was not found there.
    """

    part: int
    loops: int
    inliers: float


@dataclass(frozen=True)
class VideoPart:
    """Frames of one submap between two losses of half a second or more: its first and last row in the run's table."""

    submap: int
    first: int
    last: int
    joined: tuple[Join, ...]


def video_parts(run: Result) -> list[VideoPart]:
    """Return the parts of a run in the order of the video."""
    spans = _spans(run.frames.submap, run.frames["time_s"])
    part_of = np.full(len(run.frames), -1)
    for number, (_, first, last) in enumerate(spans):
        part_of[first : last + 1] = number
    submap_of = [*(submap for submap, _, _ in spans), NOT_USED]  # of no part
    row_of = {index: row for row, index in enumerate(run.frames["index"].tolist())}
    # A span of another submap may lie between two frames of one.
    in_map = run.frames.submap
    part_of_frame = {
        index: int(part_of[row]) for index, row in row_of.items() if in_map[row] == submap_of[part_of[row]]
    }
    loops: Counter[tuple[int, int]] = Counter()
    found: dict[tuple[int, int], float] = {}
    for submap in run.submaps:
        for pair in submap.provenance.get("loops", []):
            one, other = sorted(part_of_frame.get(int(index), -1) for index in pair)
            loops[one, other] += 1
        for row in submap.frames.rows[submap.frames.tracked]:
            parts = part_of_frame.get(int(row["keyframe"]), -1), part_of_frame.get(int(row["index"]), -1)
            found.setdefault(parts, float(row["inlier_share"]))
    return [
        VideoPart(submap, first, last, _joined(number, loops, found))
        for number, (submap, first, last) in enumerate(spans)
    ]


def _spans(submap: np.ndarray, time_s: np.ndarray) -> list[tuple[int, int, int]]:
    """Return submap, first and last row of each part."""
    spans: list[tuple[int, int, int]] = []
    for row in np.flatnonzero(submap >= 0).tolist():
        number = int(submap[row])
        if spans and spans[-1][0] == number:
            _, first, last = spans[-1]
            lost = (submap[last + 1 : row] != NOT_USED).any()
            if not lost or time_s[row] - time_s[last] < _LEAST_GAP_S:
                spans[-1] = number, first, row
                continue
        spans.append((number, row, row))
    return spans


def _joined(number: int, loops: Counter[tuple[int, int]], found: dict[tuple[int, int], float]) -> tuple[Join, ...]:
    earlier: Sequence[int] = range(number)
    return tuple(
        Join(part, loops[part, number], found.get((part, number), float("nan")))
        for part in earlier
        if loops[part, number] or (part, number) in found
    )
