"""Back end: takes keyframes while the tracker runs, and adjusts all of them together after the last frame."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.frame import Frame, Rows, RowTable, rows_in_memory
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.kept import Kept
from scopemap.engine.mapping.adjusted_maps import AdjustedMaps, MapKeyframes, adjust_maps
from scopemap.engine.mapping.bundle_adjustment import errors_px
from scopemap.engine.mapping.bundle_problem import CORRELATED, TRACKED, BundleProblem, Priors, State
from scopemap.engine.mapping.depth_correction import depth_grid
from scopemap.engine.mapping.feature_tracks import FeatureTracks, KeyframeMatches
from scopemap.engine.mapping.frame_correction import FrameCorrection, KeyframeStep, TrackedPose
from scopemap.engine.mapping.judge import refusal_by_lens
from scopemap.engine.mapping.lens import LensKinds, lens_test
from scopemap.engine.mapping.loop_closure import LOOP, Loop, LoopFinder
from scopemap.engine.mapping.map_merging import Part, merge_maps, split_maps
from scopemap.engine.mapping.pose_graph import (
    PathWithoutDrift,
    optimise_pose_graph,
    path_without_drift,
    scale_by_network,
    tracked_pairs,
)
from scopemap.engine.mapping.segments import Segment, adjust_interval, choose_segments, joined
from scopemap.engine.tracking.features import FeatureDetector

# Reprojection error, rad, of observations that support a motion across a loss: drift is less, false matches are more.
_MAX_PART_ERROR = 0.05  # by hand
# Those of about 300 keyframes: with more, memory and time of the adjustment would grow without any use to the poses.
MOST_OBSERVATIONS = 1_000_000  # by hand
"""Of an adjustment, unless memory is limited."""


class Backend:
    """Takes keyframes one by one, and returns the correction of all frames.

    Feature tracks and loop closures are computed in another thread; no other one may use `flow` meanwhile. Before the
    bundle adjustment loop closures between maps merge them, the scale's drift is removed, and a pose graph spreads all
    loop closures over the keyframes. table : of observations until then. anchored : as `scale_by_network` takes it.
    """

    _frames: Kept[list[int]]
    _tracked: Kept[list[TrackedPose]]
    _steps: Kept[list[KeyframeStep]]
    _log_scales: Kept[list[float]]
    _depths_mm: Kept[Rows]
    _grid_shape: Kept[tuple[int, int]] = (0, 0)
    _tracks: Kept[FeatureTracks]
    _finder: Kept[LoopFinder | None]
    _loops: Kept[Rows]
    _camera: Kept[PinholeCamera | None] = None

    def __init__(
        self,
        settings: MappingSettings,
        flow: FlowEstimator,
        table: RowTable = rows_in_memory,
        features: FeatureDetector | None = None,
        anchored: bool = False,
    ) -> None:
        self._settings, self._anchored = settings, anchored
        self._frames, self._tracked, self._steps, self._log_scales = [], [], [], []
        self._path = PathWithoutDrift(np.zeros(0), np.zeros((0, 4, 4)))
        self._depths_mm, self._loops = table("depth_grids", np.dtype(np.float32)), table("loops", LOOP)
        self._tracks = FeatureTracks(flow, table)
        self._finder = LoopFinder(settings, table, features) if settings.min_loop_inliers > 0 else None
        self._all_weighed = False
        self.most_observations = MOST_OBSERVATIONS
        """About so many are adjusted."""
        self.lenses = LensKinds()
        """What the lens may be."""
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="backend")
        self._pending: deque[Future[None]] = deque()

    @property
    def keyframe_count(self) -> int:
        """Number of keyframes of all maps."""
        return len(self._frames)

    def keyframes(self, map_number: int = 0) -> int:
        """Return the number of keyframes of a map."""
        return sum(pose.map == map_number for pose in self._tracked)

    def add(
        self,
        keyframe: Frame,
        tracked: TrackedPose | None = None,
        matches: KeyframeMatches | None = None,
        step: KeyframeStep | None = None,
    ) -> None:
        """Take a keyframe with depth and pose, later than those before; poses of one map share a world.

        tracked : pose as tracked; None: in map 0, from the keyframe before. matches : what is known of its feature
        tracks. step : by how much it was moved as it came; None: not at all. Raises an error of an earlier keyframe's
        feature tracks, and ValueError without a pose or a depth.
        """
        if keyframe.T_world_camera is None or keyframe.depth_mm is None:
            raise ValueError("a keyframe needs a pose and a depth")
        if tracked is None:
            reference = self._frames[-1] if self._frames else keyframe.index
            tracked = TrackedPose(0, reference, keyframe.T_world_camera)
        self._frames.append(keyframe.index)
        self._tracked.append(tracked)
        self._steps.append(step or KeyframeStep())
        self._log_scales.append(math.log(keyframe.depth_scale))
        grid = depth_grid(keyframe.depth_mm, keyframe.valid)
        self._depths_mm.append(grid.ravel())
        self._grid_shape = grid.shape
        while self._pending and self._pending[0].done():
            self._pending.popleft().result()
        self._pending.append(self._worker.submit(self._observe, keyframe, tracked.map, matches))

    def replace_tracked(self, change: Callable[[TrackedPose], TrackedPose]) -> None:
        """Change the poses as tracked of all keyframes, after the last one."""
        self._tracked = [change(pose) for pose in self._tracked]

    def split(self, relocalised: Collection[tuple[Part, Part]]) -> dict[Part, int]:
        """Split maps after the last keyframe, where nothing supports a motion across a loss: see `split_maps`."""
        self.settle()
        parts = list(dict.fromkeys((pose.map, pose.segment) for pose in self._tracked))
        if self._camera is None or len(parts) == len({number for number, _ in parts}):
            return {}
        part_of = np.array([parts.index((pose.map, pose.segment)) for pose in self._tracked])
        points, observations = self._tracks.collected(across=part_of)
        T = np.stack([pose.T_world_camera for pose in self._tracked])
        problem = BundleProblem(inverse(T), points, observations, Priors(), np.zeros((0, 2), int), self._camera.fx)
        pairs = np.column_stack([points.host[observations.point], observations.keyframe])
        pairs = pairs[errors_px(problem, problem.tracked) < _MAX_PART_ERROR * self._camera.fx]
        maps = split_maps(self._tracked, pairs, relocalised)
        self._tracked = [pose._replace(map=maps[pose.map, pose.segment]) for pose in self._tracked]
        return maps

    def settle(self) -> None:
        """Wait for the features of all keyframes so far."""
        while self._pending:
            self._pending.popleft().result()

    def adjust(
        self,
        map_number: int = 0,
        tracked: Mapping[int, TrackedPose] | None = None,
        among: Collection[int] | None = None,
    ) -> list[Segment]:
        """Return the segments of a map and of the maps merged with it, after the last keyframe: one where one scene
        explains all of it.

        tracked : poses as tracked by number of the frame; needed for several maps. among : numbers of the maps that may
        be merged; None: all. Where an adjustment is refused, keyframes stay as tracked, and only their steps are spread
        over the frames that lead to them. Raises ValueError where the map has no keyframe.
        """
        if not self.keyframes(map_number):
            raise ValueError("nothing to adjust: no keyframe was added")
        self.settle()
        self._worker.shutdown()
        if self._finder is not None and not self._all_weighed:
            self._take(self._finder.between([pose.map for pose in self._tracked]))
            self._all_weighed = True
        allowed = {pose.map for pose in self._tracked} if among is None else set(among)
        alone = self._alone(map_number)
        found, worlds = self._merged_and_adjusted(map_number, allowed, alone)
        correction = self._in_worlds(self._tested(found, alone, worlds), worlds, tracked)
        whole = Segment(int(correction.index[-1]), correction)
        return self._segments(found, correction) or [whole] if correction.refused else [whole]

    def _segments(self, found: AdjustedMaps, refused: FrameCorrection) -> list[Segment]:
        """Return the segments of maps that no one scene explains, each adjusted by itself; [] where there is one.

        found, refused : the adjustment of all, and the correction that was refused.
        """
        worlds, tracked = refused.S_common_map, refused.tracked
        keyframes, problem = self._keyframes_of(worlds), replace(found.problem, start=None)
        intervals = choose_segments(keyframes, problem)
        if len(intervals) < 2:
            return []
        alone = (adjust_interval(keyframes, problem, interval) for interval in intervals)
        corrections = [replace(self._in_worlds(one, worlds, tracked), lens=refused.lens) for one in alone]
        return joined(corrections, intervals, keyframes)

    @staticmethod
    def _in_worlds(
        correction: FrameCorrection, worlds: Mapping[int, Similarity], tracked: Mapping[int, TrackedPose] | None
    ) -> FrameCorrection:
        """Return a correction that knows all maps with these Sim(3) to the common world, and the poses as tracked."""
        return replace(correction, S_common_map=worlds, tracked=tracked or {})

    def _alone(self, map_number: int) -> AdjustedMaps:
        """Return the adjustment of one map, the drift of the scale removed from all where that is confirmed.

        Where no adjustment confirms the network's scale, that of the chain of frames stays: it is consistent.
        """

        def without_drift(share: float) -> AdjustedMaps:
            self._path = path_without_drift(self._tracked, share * np.array(self._log_scales))
            return self._adjusted({map_number: self._unit(map_number)}, map_number)

        if any(self._log_scales):
            found = without_drift(1.0)
            if not found.correction.refused:
                return found
            del found  # for memory
        return without_drift(0.0)

    def _tested(self, found: AdjustedMaps, alone: AdjustedMaps, worlds: Mapping[int, Similarity]) -> FrameCorrection:
        """Return the correction with the test of the lens; where one map was refused, only if it contradicts the lens.

        alone : the main map's own adjustment, which tells enough of the lens.
        """
        tested = found if alone.correction.refused else alone
        lens = lens_test(tested.problem, tested.solution)
        lens = self.lenses.better_than(lens, tested.problem, tested.solution)
        worse = refusal_by_lens(lens)
        if worse is not None and tested is found and not found.correction.refused:
            return replace(self._keyframes_of(worlds).uncorrected(lens.held_px), refused=worse, lens=lens)
        if len(worlds) == 1 and found.correction.refused and not lens.contradicts:
            return found.correction
        return replace(found.correction, lens=lens)

    def _merged_and_adjusted(
        self, main: int, allowed: Collection[int], alone: AdjustedMaps
    ) -> tuple[AdjustedMaps, dict[int, Similarity]]:
        """Return the adjustment of a map with all that fit to it, the best supported first, and their Sim(3).

        alone : the map's own. Each map is tried with the main one and with that of the merged ones that it has most
        loops with, so that time grows with the number of maps, and all are adjusted together in the end.
        """
        found, worlds, merged, refused = alone, {main: self._unit(main)}, {main}, 0
        for number in [*self._merged(main, allowed)][1:]:
            few = {main, self._partner(number, merged), number}
            # Each try costs an adjustment: no more of them fail than maps are merged, and one.
            if refused > len(merged) or number not in (S := self._merged(main, few)):
                continue
            together = self._adjusted(S, main)
            if not together.errors.fit(alone.errors, self._settings.max_sigma_px):
                refused += 1
                continue
            merged.add(number)
            if merged <= few or len(worlds) == 1:
                found, worlds = together, S
        if len(worlds) < len(merged):
            S = self._merged(main, merged)
            together = self._adjusted(S, main)
            if together.errors.fit(alone.errors, self._settings.max_sigma_px):
                return together, S
        return found, worlds

    def _partner(self, number: int, merged: Collection[int]) -> int:
        """Return the map among merged ones that a map has most loops with."""
        map_of, loops = np.array([pose.map for pose in self._tracked]), self._loops.read()
        ends = np.column_stack([map_of[loops["past"]], map_of[loops["new"]]])
        others = ends[(ends == number).any(1)].sum(1) - number
        return max(sorted(merged), key=lambda one: int((others == one).sum()))

    def _observe(self, keyframe: Frame, map_number: int, matches: KeyframeMatches | None) -> None:
        """Add a keyframe's feature tracks and loop closures."""
        self._camera = keyframe.camera
        self._tracks.add(keyframe, map_number, matches)
        if self._finder is not None:
            self._take(self._finder.add(keyframe, map_number))

    def _take(self, loops: Sequence[Loop]) -> None:
        for loop in loops:
            self._tracks.add_loop(loop)
            self._loops.append(loop.row())

    def _merged(self, map_number: int, allowed: Collection[int]) -> dict[int, Similarity]:
        """Return Sim(3) to the common world of the map and of the allowed maps that loop closures merge with it."""
        map_of = np.array([pose.map for pose in self._tracked])
        if len(set(map_of.tolist())) < 2:
            return {map_number: self._unit(map_number)}
        depth_mm = self._tracks.median_depth_mm(np.flatnonzero(map_of == map_number))
        if depth_mm is None:
            return {map_number: self._unit(map_number)}
        chosen = np.flatnonzero(np.isin(map_of, [map_number, *allowed])).tolist()
        loops, T_world_camera = self._loops_among(chosen, -self._path.drift[chosen]), self._path.T_world_camera[chosen]
        worlds = merge_maps(T_world_camera, map_of[chosen].tolist(), loops, map_number, depth_mm)
        return {number: self._unit(map_number).after(S) for number, S in worlds.items()}

    def _unit(self, map_number: int) -> Similarity:
        """Return the Sim(3) from a map as tracked to the same map in the millimetres of `scale_by_network`."""
        map_of, off = np.array([pose.map for pose in self._tracked]), np.array(self._log_scales) - self._path.drift
        return Similarity(scale_by_network(off, map_of, map_number, self._anchored), np.eye(3), np.zeros(3))

    def _loops_among(self, chosen: list[int], log_unit: np.ndarray) -> list[Loop]:
        """Return the loops between these keyframes, numbered by their place; log_unit as `Loop.among` takes it."""
        among, found = set(chosen), map(Loop.of_row, self._loops.read())
        return [loop.among(chosen, log_unit) for loop in found if {loop.past, loop.new} <= among]

    def _adjusted(self, worlds: Mapping[int, Similarity], main: int) -> AdjustedMaps:
        """Return the bundle adjustment of all keyframes of maps with these Sim(3) to the common world."""
        problem, accepted = self._problem(worlds)
        return adjust_maps(self._keyframes_of(worlds), problem, accepted, main)

    def _chosen(self, worlds: Mapping[int, Similarity]) -> list[int]:
        """Return the places of the keyframes of these maps."""
        return [k for k, pose in enumerate(self._tracked) if pose.map in worlds]

    def _keyframes_of(self, worlds: Mapping[int, Similarity]) -> MapKeyframes:
        """Return the keyframes of maps with these Sim(3) to the common world."""
        assert self._camera is not None
        chosen = self._chosen(worlds)
        return MapKeyframes(
            index=np.array(self._frames)[chosen],
            poses=[self._tracked[k] for k in chosen],
            steps=[self._steps[k] for k in chosen],
            log_drift=self._path.drift[chosen],
            grids_mm=self._depths_mm.read().reshape(-1, *self._grid_shape)[chosen],
            S_common_map=worlds,
            camera=self._camera,
            settings=self._settings,
        )

    def _problem(self, worlds: Mapping[int, Similarity]) -> tuple[BundleProblem, np.ndarray]:
        """Return the bundle adjustment of maps' keyframes, from the pose graph, and its accepted loops (A, 2)."""
        assert self._camera is not None
        chosen = self._chosen(worlds)
        poses = [self._tracked[k] for k in chosen]
        T_map_camera, to_common = self._path.T_world_camera[chosen], [worlds[pose.map] for pose in poses]
        T_world_camera = np.stack([S.transform_poses(T) for S, T in zip(to_common, T_map_camera, strict=True)])
        log_unit = np.log([S.scale for S in to_common]) - self._path.drift[chosen]
        pairs, graph = tracked_pairs([self._frames[k] for k in chosen], poses), None
        # Before the observations are read: both fill memory.
        if loops := self._loops_among(chosen, log_unit):
            depth_mm = self._tracks.median_depth_mm(chosen, log_unit)
            assert depth_mm is not None  # loops have points
            graph = optimise_pose_graph(T_world_camera, pairs, loops, depth_mm)
        points, observations = self._tracks.collected(chosen, self.most_observations)
        points = replace(points, log_depth=points.log_depth + log_unit[points.host])
        T = inverse(T_world_camera)
        problem = BundleProblem(T, points, observations, TRACKED, pairs, self._camera.fx, correlated=CORRELATED)
        if graph is None:
            return problem, np.zeros((0, 2), int)
        log_depth = points.log_depth + graph.log_scale[points.host]
        start = State(inverse(graph.T_world_camera), graph.log_scale, log_depth, problem.tracked.log_focal)
        return replace(problem, start=start), graph.accepted
