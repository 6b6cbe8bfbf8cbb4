"""Maps in a common world: their keyframes are adjusted together, the solution is judged, and it becomes a correction.

A solution is refused for the first of these reasons that holds:

1. reprojection errors stay large: no rigid scene explains the observations
2. another start ends in another shape, which explains them about as well (`ShapeTest.refuses`)
3. other starts cannot tell, and the depths of keyframes agree less than as tracked

The keyframes of a refused one are where the pose graph of loop closures has them if it merges maps, else as tracked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MappingSettings
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.least_squares import robust_sigma_2d
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.mapping.bundle_adjustment import BundleSolution, adjust_in_windows, errors_px
from scopemap.engine.mapping.bundle_problem import BundleProblem, Points, State
from scopemap.engine.mapping.depth_correction import DepthCorrectionField, fit_depth_corrections
from scopemap.engine.mapping.frame_correction import FrameCorrection, KeyframeStep, TrackedPose
from scopemap.engine.mapping.judge import MapErrors, ShapeTest, refusal_by_depth, refusal_by_views
from scopemap.engine.mapping.other_starts import with_other_starts
from scopemap.engine.notices import Notice


@dataclass(frozen=True)
class MapKeyframes:
    """K keyframes of maps, as tracked, and the common world of these.

    index : (K,) int, numbers of their frames. poses, steps : as tracked, and how far each was moved as it came.
    log_drift : (K,) ln of the drift of their scale. grids_mm : (K, h, w) depths, as `depth_grid` gives them.
    S_common_map : by number of each map, Sim(3) to the common world.
    """

    index: np.ndarray
    poses: Sequence[TrackedPose]
    steps: Sequence[KeyframeStep]
    log_drift: np.ndarray
    grids_mm: np.ndarray
    S_common_map: Mapping[int, Similarity]
    camera: PinholeCamera
    settings: MappingSettings

    @property
    def map_of(self) -> np.ndarray:
        """Number of each keyframe's map, (K,) int."""
        return np.array([pose.map for pose in self.poses])

    @cached_property
    def T_world_camera(self) -> np.ndarray:
        """Poses (K, 4, 4) as tracked, in the common world."""
        return np.stack([self.S_common_map[pose.map].transform_poses(pose.T_world_camera) for pose in self.poses])

    def successive(self, first: int, end: int) -> MapKeyframes:
        """Return the keyframes from `first` to before `end`, in the same world."""
        part = slice(first, end)
        poses = self.poses[part]
        return replace(
            self,
            index=self.index[part],
            poses=poses,
            steps=self.steps[part],
            log_drift=self.log_drift[part],
            grids_mm=self.grids_mm[part],
            S_common_map={pose.map: self.S_common_map[pose.map] for pose in poses},
        )

    def correction(self, found: BundleSolution) -> FrameCorrection:
        """Return the correction by a solution, without depth correction fields."""
        state = found.state
        T_world_world = inverse(state.T_camera_world) @ inverse(self.T_world_camera)
        depth_mm = float(np.exp(np.median(state.log_depth))) if len(state.log_depth) else 1.0
        log_scale = state.log_scale - self.log_drift
        correction = FrameCorrection(self.index, T_world_world, log_scale, found.sigma_px, depth_mm=depth_mm)
        return self._with_steps(correction)

    def uncorrected(self, sigma_px: float) -> FrameCorrection:
        """Return the correction that leaves keyframes as tracked; sigma_px : of the solution that was refused."""
        count = len(self.index)
        unmoved = np.tile(np.eye(4), (count, 1, 1))
        return self._with_steps(FrameCorrection(self.index, unmoved, np.zeros(count), sigma_px))

    def depth_fields(self, points: Points, found: BundleSolution) -> tuple[DepthCorrectionField, ...]:
        """Return the depth correction field of each keyframe by a solution; () where depth is only scaled."""
        as_tracked = replace(points, log_depth=points.log_depth + self.log_drift[points.host])
        change = found.state.log_depth - points.log_depth - found.state.log_scale[points.host]
        count, sigma = len(self.index), found.log_depth_sigma
        return fit_depth_corrections(self.camera, as_tracked, count, change, sigma, self.settings.depth_step_sigma)

    @cached_property
    def tracked_depths(self) -> list[np.ndarray]:
        """The depths (h, w) as tracked, mm of the common world."""
        scales = [np.float32(self.S_common_map[pose.map].scale) for pose in self.poses]
        return [scale * grid for scale, grid in zip(scales, self.grids_mm, strict=True)]

    def adjusted_depths(
        self, found: BundleSolution, fields: tuple[DepthCorrectionField, ...] = ()
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the poses T_world_camera (K, 4, 4) of a solution, and the depths (h, w) mm that it gives keyframes."""
        log_scale = found.state.log_scale - self.log_drift
        after = [np.exp(log) * grid for log, grid in zip(log_scale, self.tracked_depths, strict=True)]
        if fields:
            factors = [np.exp(field.log_factor(grid)) for field, grid in zip(fields, self.tracked_depths, strict=True)]
            after = [factor * grid for factor, grid in zip(factors, after, strict=True)]
        return inverse(found.state.T_camera_world), after

    def refusal_by_depth(self, found: BundleSolution, fields: tuple[DepthCorrectionField, ...] = ()) -> Notice | None:
        """Return that the depths of keyframes agree less than as tracked; None: they agree about as well."""
        before = self.T_world_camera, self.tracked_depths
        return refusal_by_depth(self.camera, before, self.adjusted_depths(found, fields))

    def _with_steps(self, correction: FrameCorrection) -> FrameCorrection:
        return correction.with_steps(self.poses, self.steps, self.S_common_map)


class AdjustedMaps(NamedTuple):
    """A correction, what merged maps are judged by, what was solved, and where that ended, refused or not."""

    correction: FrameCorrection
    errors: MapErrors
    problem: BundleProblem
    solution: State


def adjust_maps(keyframes: MapKeyframes, problem: BundleProblem, loops: np.ndarray, main: int) -> AdjustedMaps:
    """Return the bundle adjustment of keyframes, judged; loops : (A, 2) int, those of the accepted loop closures."""
    found, shape = _solution(keyframes, problem)
    fields: tuple[DepthCorrectionField, ...] = ()
    refused = refusal_by_views(found.sigma_px, keyframes.settings.max_sigma_px, shape)
    if refused is None:
        fields = keyframes.depth_fields(problem.points, found)
        # Other starts have judged the shape, where they could; else the depths do.
        refused = None if shape.is_tested else keyframes.refusal_by_depth(found, fields)
    graph_contradicts = False
    if refused is None:
        correction = replace(keyframes.correction(found), depth_fields=fields, shape=shape, loops=len(loops))
    elif len(keyframes.S_common_map) > 1 and problem.start is not None:
        by_graph = found._replace(state=problem.start._replace(sigma_px=found.sigma_px))
        correction = replace(keyframes.correction(by_graph), refused=refused, loops=len(loops))
        graph_contradicts = keyframes.refusal_by_depth(by_graph) is not None
    else:
        correction = replace(keyframes.uncorrected(found.sigma_px), refused=refused, shape=shape)
    correction = replace(correction, loop_frames=keyframes.index[loops].tolist() if correction.loops else [])
    within_px, between_px = _errors_of_maps(keyframes, problem, found.state, main)
    before_px, _ = _errors_of_maps(keyframes, problem, problem.begin, main)
    errors = MapErrors(
        is_adjusted=refused is None,
        main_px=within_px[main],
        largest_px=_largest(within_px),
        graph_px=math.inf if graph_contradicts else _largest(before_px),
        between_px=between_px,
        loops=correction.loops,
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
    keyframes: MapKeyframes, problem: BundleProblem, state: State, main: int
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
