"""Segments: the parts of a submap's time in which one scene explains the views, as few and as long as they allow.

Where organs move no surface fits all of a video, but one fits a second or two of it. Pieces of a second are merged with
their neighbours, the best union first, while one scene explains the union about as well as its parts. Two things tell:

- tracks that were left out of an adjustment of the union: a rigid scene leaves them as small as its parts do
- where no adjustment is rigid, the depths of the keyframes as tracked: over the union they agree as within its parts

Neighbours share a keyframe, which joins them by Sim(3): the path has no steps.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.mapping.bundle_adjustment import adjust
from scopemap.engine.mapping.bundle_problem import BundleProblem, Observations, successive
from scopemap.engine.mapping.correction import FrameCorrection
from scopemap.engine.mapping.depth_correction import depth_log_ratios
from scopemap.engine.mapping.feature_tracks import NEAR_GAPS
from scopemap.engine.mapping.judge import (
    LEAST_COMPARED,
    Interval,
    halves,
    left_out_px,
    mean_of_known,
    placed,
    union_rank,
)
from scopemap.engine.mapping.keyframes import MapKeyframes

PIECE = 4
"""Steps between the keyframes of a piece, about a second: five keyframes, as many as are adjusted together as they
come."""
# By hand, for time: of a keyframe that are adjusted, and as many that judge.
_POINTS = 60
# Of the adjustment that is judged: 20 change left-out errors of real intervals by 1 % at most, 8 by 4 %.
_ITERATIONS = 12


@dataclass(frozen=True)
class Segment:
    """A part of a submap's time that one scene explains.

    last : number of the frame of its last keyframe, which the next segment is adjusted from, too; the frame is of this
    one. Of the last segment the number of its last frame. correction : of poses and depth of its frames, to the world
    of the submap; None: they are as tracked. is_joined : False where it shares no keyframe with the segment before, so
    that only the motion as tracked joins them. frames : numbers of its frames.
    """

    last: int
    correction: FrameCorrection | None = None
    is_joined: bool = True
    frames: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Submap:
    """Frames that share a world after the last frame.

    Attributes
    ----------
    main : number of its map with most frames. maps : numbers of all maps merged into it.
    frames : numbers of the frames tracked in these. main_frames : of those tracked in the main map. segments : parts of
    its time, in order; one surface fits the frames of each.
    """

    main: int
    maps: tuple[int, ...]
    frames: frozenset[int]
    main_frames: frozenset[int]
    segments: tuple[Segment, ...]

    def depth_factor(self, index: int) -> float:
        """Return the factor of the whole depth of the frame with this number."""
        correction = self.correction(index)
        return 1.0 if correction is None else correction.depth_factor(index)

    def correction(self, index: int) -> FrameCorrection | None:
        """Return the correction of the frame with this number; None: it is as tracked."""
        return self.segments[self.segment_of(index)].correction

    def segment_of(self, index: int) -> int:
        """Return the number of the segment that a frame of this number is in."""
        return min(bisect_left(self._lasts, index), len(self.segments) - 1)

    @cached_property
    def _lasts(self) -> list[int]:
        return [segment.last for segment in self.segments]


class _IntervalTest:
    """Measures how well one scene explains successive keyframes, each pair of keyframes being compared once."""

    def __init__(self, keyframes: MapKeyframes, problem: BundleProblem) -> None:
        self._keyframes = keyframes
        self._adjusted, self._left_out = halves(replace(problem, start=None), _POINTS)
        self._grids_mm = keyframes.tracked_depths
        self._compared: dict[tuple[int, int], float] = {}

    def measure(self, first: int, last: int, shared: int | None = None) -> Interval:
        """Return what is known of the keyframes from `first` to `last`; shared : where the parts of a union meet."""
        adjusted, left_out = (successive(half, first, last + 1) for half in (self._adjusted, self._left_out))
        found = adjust(adjusted, max_iterations=_ITERATIONS)
        if shared is not None:
            left_out = _connecting(left_out, shared - first)
        states = (placed(left_out, keyframes) for keyframes in (found.state, left_out.tracked))
        error_px, tracked_px = (left_out_px(left_out, state, least=LEAST_COMPARED) for state in states)
        own = self._keyframes.successive(first, last + 1)
        T, grids_mm = own.adjusted_depths(found, own.depth_fields(adjusted.points, found))
        pairs = [(k, k + gap) for gap in NEAR_GAPS for k in range(last + 1 - first - gap)]
        pairs += [(other, one) for one, other in pairs]
        after = [_disagreement(own.camera, T, grids_mm, *pair) for pair in pairs]
        tracked = [self._as_tracked(first + one, first + other) for one, other in pairs]
        return Interval(first, last, error_px, tracked_px, mean_of_known(after), mean_of_known(tracked))

    def measure_union(self, one: Interval, other: Interval) -> Interval:
        """Return what is known of two neighbours together."""
        return self.measure(one.first, other.last, other.first)

    def _as_tracked(self, one: int, other: int) -> float:
        if (one, other) not in self._compared:
            camera, T = self._keyframes.camera, self._keyframes.T_world_camera
            self._compared[one, other] = _disagreement(camera, T, self._grids_mm, one, other)
        return self._compared[one, other]


def _disagreement(
    camera: PinholeCamera, T_world_camera: np.ndarray, grids_mm: Sequence[np.ndarray], one: int, other: int
) -> float:
    """Return by how much ln depth of two keyframes differs where both see the same, median; NaN: nowhere."""
    ratios = depth_log_ratios(camera, T_world_camera, grids_mm, one, other)
    return float(np.median(np.abs(ratios))) if len(ratios) >= LEAST_COMPARED else float("nan")


def choose_segments(keyframes: MapKeyframes, problem: BundleProblem) -> list[Interval]:
    """Return the intervals of keyframes that one scene explains, in order; neighbours share a keyframe within a map."""
    test, most_px = _IntervalTest(keyframes, problem), keyframes.settings.max_sigma_px
    found = [test.measure(*piece) for piece in _pieces(keyframes.map_of)]
    unions = {pair: test.measure_union(*pair) for pair in itertools.pairwise(found)}
    while True:
        ranked = {pair: union_rank(union, pair, most_px) for pair, union in unions.items()}
        ranks = {pair: rank for pair, rank in ranked.items() if rank is not None}
        if not ranks:
            return found
        best = min(ranks, key=lambda pair: ranks[pair])
        union, place = unions[best], found.index(best[0])
        found[place : place + 2] = [union]
        near = itertools.pairwise(found[max(place - 1, 0) : place + 2])
        kept = {pair: unions[pair] for pair in itertools.pairwise(found) if pair in unions}
        unions = kept | {pair: test.measure_union(*pair) for pair in near}


def _pieces(map_of: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the last keyframe of each piece; pieces do not reach from one map (K,) into another."""
    found = []
    ends = [0, *(np.flatnonzero(np.diff(map_of)) + 1).tolist(), len(map_of)]
    for begin, end in itertools.pairwise(ends):
        # Equally long: a last piece of two keyframes would tell nothing.
        count = max((end - 1 - begin) // PIECE, 1)
        edges = np.linspace(begin, end - 1, count + 1).round().astype(int).tolist()
        found += [*itertools.pairwise(edges)]
    return found


def _connecting(problem: BundleProblem, shared: int) -> BundleProblem:
    """Return the problem with the observations between keyframes before and after one that both parts share."""
    seen = problem.observations
    ends = np.column_stack([problem.points.host[seen.point], seen.keyframe])
    chosen = (ends.min(1) < shared) & (ends.max(1) > shared)
    return replace(problem, observations=Observations(*(part[chosen] for part in seen.columns)))


def joined(
    corrections: Sequence[FrameCorrection], intervals: Sequence[Interval], keyframes: MapKeyframes
) -> list[Segment]:
    """Return the segments of intervals, each joined to the one before by the keyframe that they share.

    There both have the same pose, and the same median depth. Where they share none, in another map, the motion from the
    last keyframe before as tracked joins them.
    """
    found: list[Segment] = []
    for number, (correction, interval) in enumerate(zip(corrections, intervals, strict=True)):
        is_joined = not number or intervals[number - 1].last == interval.first
        if number:
            before = found[-1].correction
            assert before is not None
            S = _link(before, correction, keyframes, intervals[number - 1].last)
            correction = replace(correction, S_world_adjusted=S)
        found.append(Segment(int(keyframes.index[interval.last]), correction, is_joined))
    return found


def _link(before: FrameCorrection, own: FrameCorrection, keyframes: MapKeyframes, k: int) -> Similarity:
    """Return Sim(3) from the adjusted world of a correction to that of the submap, by a keyframe of the one before."""
    number = int(keyframes.index[k])
    T_tracked, grid_mm = keyframes.poses[k].T_world_camera, keyframes.grids_mm[k]
    T, T_own = before.pose(number, T_tracked), own.pose(number, T_tracked)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = before.depth_factors(number, grid_mm) / own.depth_factors(number, grid_mm)
    known = ratios[np.isfinite(ratios)]
    scale = float(np.median(known)) if known.size else 1.0
    R = T[:3, :3] @ T_own[:3, :3].T
    return Similarity(scale, R, T[:3, 3] - scale * R @ T_own[:3, 3])
