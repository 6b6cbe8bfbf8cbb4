"""Hypotheses: what is tried after the last frame to explain what keyframes observe, and in which order.

| | hypothesis | what is free | where it begins |
|---|---|---|---|
| 1 | one map without the drift of its scale | poses, depth scales, points | as tracked, the drift divided out |
| 2 | the same with the drift, if 1 is refused | the same | as tracked |
| 3 | another shape, beside 1 and 2 | the same | mirrored, and flat (`other_starts.py`) |
| 4 | other maps merged with it, one by one | the same, of all of them | as their loop closures have them |
| 5 | another lens (`lens.py`) | the focal length, or the kind of lens, too | where 1 has ended; 4, if 1 was refused |
| 6 | as tracked, or as loop closures merge the maps, if all of these are refused | nothing | |
| 7 | segments (`segments.py`), after 6 | as 1, of each by itself | as tracked |

Where loops close, 1, 2 and 4 begin where the pose graph has the keyframes. `BundleProblem` holds what is free, and in
`start` where it begins. `explain` is that order; `judge.py` says what is kept. Another lens is only reported: the run
may take it, and begin again (`runner/lens_of_motion.py`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.least_squares import robust_sigma_2d
from scopemap.engine.mapping.bundle_adjustment import BundleSolution, adjust_in_windows, errors_px
from scopemap.engine.mapping.bundle_problem import BundleProblem, BundleState, successive
from scopemap.engine.mapping.correction import FrameCorrection, TrackedPose
from scopemap.engine.mapping.depth_correction import DepthCorrectionField
from scopemap.engine.mapping.judge import (
    LEAST_COMPARED,
    Interval,
    MapErrors,
    ShapeTest,
    refusal_by_tracked_poses,
    refusal_by_views,
    refusal_of_interval,
)
from scopemap.engine.mapping.keyframes import Keyframes, MapKeyframes
from scopemap.engine.mapping.lens import LensKinds, lens_test
from scopemap.engine.mapping.other_starts import with_other_starts
from scopemap.engine.mapping.segments import Segment, choose_segments, joined


class AdjustedMaps(NamedTuple):
    """A correction, what merged maps are judged by, what was solved, and where that ended, refused or not."""

    correction: FrameCorrection
    errors: MapErrors
    problem: BundleProblem
    solution: BundleState


def explain(
    keyframes: Keyframes,
    main: int,
    allowed: Collection[int],
    tracked: Mapping[int, TrackedPose],
    lenses: LensKinds,
) -> list[Segment]:
    """Return the segments of a map and of the maps merged with it: one where one scene explains all of it.

    allowed : numbers of the maps that may be merged. tracked : poses as tracked by number of the frame; needed for
    several maps. lenses : what the lens may be.
    """
    keyframes, alone = _alone(keyframes, main)
    found, worlds = _merged(keyframes, main, allowed, alone)
    merged = keyframes.of_maps(worlds)
    if found is not alone and alone.correction.refused:
        found = _unless_worse(merged, found)
    correction = replace(_with_lens(found, alone, lenses), S_common_map=worlds, tracked=tracked)
    whole = Segment(int(correction.index[-1]), correction)
    if not correction.refused:
        return [whole]
    return _segments(merged, found.problem, correction) or [whole]


def _alone(keyframes: Keyframes, main: int) -> tuple[Keyframes, AdjustedMaps]:
    """Return the adjustment of one map, and the keyframes of all without the drift of the scale if that is confirmed.

    Where no adjustment confirms the network's scale, that of the chain of frames stays: it is consistent.
    """
    if keyframes.log_scales.any():
        without = keyframes.with_path(keeps_drift=False)
        found = _of_map(without, main)
        if not found.correction.refused:
            return without, found
        del found  # for memory
    keyframes = keyframes.with_path(keeps_drift=True)
    return keyframes, _of_map(keyframes, main)


def _of_map(keyframes: Keyframes, main: int) -> AdjustedMaps:
    """Return the adjustment of one map; as tracked where left-out tracks prefer that."""
    world = {main: keyframes.unit(main)}
    return _unless_worse(keyframes.of_maps(world), _adjusted(keyframes, world, main))


def _unless_worse(keyframes: MapKeyframes, found: AdjustedMaps) -> AdjustedMaps:
    """Return an adjustment with its test of the lens; as tracked where that explains left-out tracks better.

    That test adjusts half of the points with the lens held, so that it tells of the adjustment, too.
    """
    if found.correction.refused:
        return found
    lens = lens_test(found.problem, found.solution)
    if (worse := refusal_by_tracked_poses(lens)) is None:
        return found._replace(correction=replace(found.correction, lens=lens))
    as_tracked = replace(keyframes.uncorrected(lens.held_px), refused=worse, lens=lens)
    return found._replace(correction=as_tracked, errors=found.errors._replace(is_adjusted=False))


def _merged(
    keyframes: Keyframes, main: int, allowed: Collection[int], alone: AdjustedMaps
) -> tuple[AdjustedMaps, dict[int, Similarity]]:
    """Return the adjustment of a map with all that fit to it, the best supported first, and their Sim(3).

    alone : the map's own. Each map is tried with the main one and with that of the merged ones that it has most
    loops with, so that time grows with the number of maps, and all are adjusted together in the end.
    """
    most_px = keyframes.settings.max_sigma_px
    found, worlds, merged, refused = alone, {main: keyframes.unit(main)}, {main}, 0
    for number in [*keyframes.merged_worlds(main, allowed)][1:]:
        few = {main, keyframes.partner(number, merged), number}
        # Each try costs an adjustment: it stops once more of them failed than maps are merged.
        if refused > len(merged) or number not in (S := keyframes.merged_worlds(main, few)):
            continue
        together = _adjusted(keyframes, S, main)
        if not together.errors.fit(alone.errors, most_px):
            refused += 1
            continue
        merged.add(number)
        if merged <= few or len(worlds) == 1:
            found, worlds = together, S
    if len(worlds) < len(merged):
        S = keyframes.merged_worlds(main, merged)
        together = _adjusted(keyframes, S, main)
        if together.errors.fit(alone.errors, most_px):
            return together, S
    return found, worlds


def _with_lens(found: AdjustedMaps, alone: AdjustedMaps, lenses: LensKinds) -> FrameCorrection:
    """Return the correction with the test of the lens; where one map was refused, only if it contradicts the lens.

    alone : the main map's own adjustment, which tells enough of the lens.
    """
    tested = found if alone.correction.refused else alone
    lens = tested.correction.lens
    if math.isnan(lens.held_px):  # it was refused before
        lens = lens_test(tested.problem, tested.solution)
    lens = lenses.better_than(lens, tested.problem, tested.solution)
    if found is alone and found.correction.refused and not lens.contradicts:
        return found.correction
    return replace(found.correction, lens=lens)


def _segments(keyframes: MapKeyframes, problem: BundleProblem, refused: FrameCorrection) -> list[Segment]:
    """Return the segments of maps that no one scene explains, each adjusted by itself; [] where there is one.

    problem : of all keyframes. refused : the correction of all, which is none.
    """
    problem = replace(problem, start=None)
    intervals = choose_segments(keyframes, problem)
    if len(intervals) < 2:
        return []
    worlds, tracked, lens = refused.S_common_map, refused.tracked, refused.lens
    alone = (_of_interval(keyframes, problem, interval) for interval in intervals)
    corrections = [replace(one, S_common_map=worlds, tracked=tracked, lens=lens) for one in alone]
    return joined(corrections, intervals, keyframes)


def _of_interval(keyframes: MapKeyframes, problem: BundleProblem, interval: Interval) -> FrameCorrection:
    """Return the correction of an interval by itself: as tracked where left-out tracks or depth prefer that."""
    own = keyframes.successive(interval.first, interval.last + 1)
    if (refused := refusal_of_interval(interval, keyframes.settings.max_sigma_px)) is not None:
        return replace(own.uncorrected(interval.error_px), refused=refused)
    part = successive(problem, interval.first, interval.last + 1)
    return adjust_maps(own, part, np.zeros((0, 2), int), own.poses[0].map).correction


def _adjusted(keyframes: Keyframes, worlds: Mapping[int, Similarity], main: int) -> AdjustedMaps:
    """Return the bundle adjustment of all keyframes of maps with these Sim(3) to the common world."""
    problem, accepted = keyframes.problem(worlds)
    return adjust_maps(keyframes.of_maps(worlds), problem, accepted, main)


def adjust_maps(keyframes: MapKeyframes, problem: BundleProblem, loops: np.ndarray, main: int) -> AdjustedMaps:
    """Return the bundle adjustment of keyframes, judged; loops : (A, 2) int, those of the accepted loop closures."""
    found, shape = _solution(keyframes, problem)
    fields: tuple[DepthCorrectionField, ...] = ()
    loop_frames = keyframes.index[loops].tolist()
    near_px, most_px = _largest_near_px(problem, found.state), keyframes.settings.max_sigma_px
    refused = refusal_by_views(found.sigma_px, near_px, most_px, shape, len(keyframes.index))
    if refused is None:
        fields = keyframes.depth_fields(problem.points, found)
        # Other starts have judged the shape, where they could; else the depths do.
        refused = None if shape.is_tested else keyframes.refusal_by_depth(found, fields)
    graph_contradicts = False
    if refused is None:
        correction = replace(keyframes.correction(found), depth_fields=fields, shape=shape, loop_frames=loop_frames)
    elif len(keyframes.S_common_map) > 1 and problem.start is not None:
        by_graph = found._replace(state=problem.start._replace(sigma_px=found.sigma_px))
        correction = replace(keyframes.correction(by_graph), refused=refused, loop_frames=loop_frames)
        graph_contradicts = keyframes.refusal_by_depth(by_graph) is not None
    else:
        correction = replace(keyframes.uncorrected(found.sigma_px), refused=refused, shape=shape)
    within_px, between_px = _errors_of_maps(keyframes, problem, found.state, main)
    before_px, _ = _errors_of_maps(keyframes, problem, problem.begin, main)
    errors = MapErrors(
        is_adjusted=refused is None,
        main_px=within_px[main],
        largest_px=_largest(within_px),
        graph_px=math.inf if graph_contradicts else _largest(before_px),
        between_px=between_px,
        loops=len(correction.loop_frames),
        support=_loop_support(loops, keyframes.map_of, main),
    )
    return AdjustedMaps(correction, errors, problem, found.state)


def _solution(keyframes: MapKeyframes, problem: BundleProblem) -> tuple[BundleSolution, ShapeTest]:
    """Return the solution; of one map that of the start that wins, and what the starts tell."""
    found, settings = adjust_in_windows(problem), keyframes.settings
    if len(keyframes.S_common_map) > 1 or not settings.other_starts:
        return found, ShapeTest()
    return with_other_starts(problem, found, is_rigid=found.sigma_px <= settings.max_sigma_px)


def _errors_of_maps(
    keyframes: MapKeyframes, problem: BundleProblem, state: BundleState, main: int
) -> tuple[dict[int, float], float]:
    """Return the robust standard deviations of reprojection errors within each map, and the largest between maps.

    Between: of each map but the main one with all others, for a wrong one hides among right ones that have more loops;
    NaN where a map has no loop.
    """
    length_px, map_of, seen = errors_px(problem, state), keyframes.map_of, problem.observations
    host, observer = map_of[problem.points.host[seen.point]], map_of[seen.keyframe]

    def sigma_px(chosen: np.ndarray) -> float:
        return robust_sigma_2d(length_px[chosen]) if chosen.any() else math.nan

    maps = [*keyframes.S_common_map]
    within_px = {number: sigma_px((host == number) & (observer == number)) for number in maps}
    between_px = [sigma_px((host == number) != (observer == number)) for number in maps if number != main]
    return within_px, float(np.max(between_px or math.nan))


def _largest_near_px(problem: BundleProblem, state: BundleState) -> float:
    """Return the largest robust standard deviation of the errors between two neighbouring keyframes; 0 without any."""
    length_px, seen = errors_px(problem, state), problem.observations
    ends = np.column_stack([problem.points.host[seen.point], seen.keyframe])
    first, is_near = ends.min(1), np.ptp(ends, axis=1) == 1
    compared = (length_px[is_near & (first == k)] for k in range(len(state.T_camera_world) - 1))
    return max((robust_sigma_2d(one) for one in compared if len(one) >= LEAST_COMPARED), default=0.0)


def _largest(within_px: Mapping[int, float]) -> float:
    """Return the largest known error; NaN without any, as of a map of one keyframe."""
    return float(np.fmax.reduce([*within_px.values()]))


def _loop_support(loops: np.ndarray, map_of: np.ndarray, main: int) -> int:
    """Return the fewest keyframes, on either side, of the loops (A, 2) of a map with others; 0: a map has none."""
    least = []
    for number in sorted(set(map_of.tolist()) - {main}):
        inside = map_of[loops] == number
        ends = loops[inside.sum(1) == 1]
        own = map_of[ends] == number
        least.append(min(len(np.unique(ends[own])), len(np.unique(ends[~own]))))
    return min(least, default=0)
