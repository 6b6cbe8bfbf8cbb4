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
from scopemap.engine.mapping.bundle_adjustment import RIGID_SIGMA_PX, BundleSolution, adjust_in_windows, errors_px
from scopemap.engine.mapping.bundle_problem import BundleProblem, Points, Priors, State
from scopemap.engine.mapping.depth_correction import (
    DepthCorrectionField,
    depth_grid,
    fit_depth_corrections,
    growth_of_disagreement,
)
from scopemap.engine.mapping.feature_tracks import FeatureTracks, KeyframeMatches
from scopemap.engine.mapping.frame_correction import FrameCorrection, KeyframeStep, TissueMotion, TrackedPose
from scopemap.engine.mapping.lens_residual import lens_residual
from scopemap.engine.mapping.loop_closure import LOOP, MOST_RECENT, Loop, LoopFinder
from scopemap.engine.mapping.map_merging import AdjustedMaps, Part, errors_of_maps, loop_support, merge_maps, split_maps
from scopemap.engine.mapping.nonrigid_adjustment import RIGID_CORE_PX, adjust_moving_tissue
from scopemap.engine.mapping.other_starts import ShapeTest, with_other_starts
from scopemap.engine.mapping.pose_graph import (
    PathWithoutDrift,
    optimise_pose_graph,
    path_without_drift,
    scale_by_network,
    tracked_pairs,
)
from scopemap.engine.notices import Notice
from scopemap.engine.tracking.features import FeatureDetector

# Reprojection error, rad, of observations that support a motion across a loss: drift is less, false matches are more.
_MAX_PART_ERROR = 0.05
# Those of about 300 keyframes: with more, memory and time of the adjustment would grow without any use to the poses.
MOST_OBSERVATIONS = 1_000_000
"""Of an adjustment, unless memory is limited."""


class Backend:
    """Takes keyframes one by one, and returns the correction of all frames.

    Feature tracks and loop closures are computed in another thread; no other one may use `flow` meanwhile. Before the
    bundle adjustment loop closures between maps merge them, the scale's drift is removed, and a pose graph spreads all
    loop closures over the keyframes. table : of observations until then. anchored : as `scale_by_network` takes it.
    """

    _frames: Kept[list[int]]
    _times_s: Kept[list[float]]
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
        self.settings, self._anchored = settings.constants, anchored
        self._frames, self._times_s, self._tracked, self._steps, self._log_scales = [], [], [], [], []
        self._path = PathWithoutDrift(np.zeros(0), np.zeros((0, 4, 4)))
        self._depths_mm, self._loops = table("depth_grids", np.dtype(np.float32)), table("loops", LOOP)
        self._tracks = FeatureTracks(settings, flow, table)
        self._finder = LoopFinder(settings, table, features) if settings.constants.min_loop_inliers > 0 else None
        self._all_weighed = False
        self.most_observations = MOST_OBSERVATIONS
        """About so many are adjusted."""
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
        self._times_s.append(keyframe.time_s)
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
        parts = {(pose.map, pose.segment) for pose in self._tracked}
        if self._camera is None or len(parts) == len({number for number, _ in parts}):
            return {}
        points, observations = self._tracks.collected()
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
    ) -> FrameCorrection:
        """Return the correction of all frames of a map and of the maps merged with it, after the last keyframe.

        tracked : poses as tracked by number of the frame; needed for several maps. among : numbers of the maps that may
        be merged; None: all. Where it is refused, keyframes stay as tracked, and only their steps are spread over the
        frames that lead to them. Raises ValueError where the map has no keyframe.
        """
        if not self.keyframes(map_number):
            raise ValueError("nothing to adjust: no keyframe was added")
        self.settle()
        self._worker.shutdown()
        if self._finder is not None and not self._all_weighed:
            self._take(self._finder.between([pose.map for pose in self._tracked]))
            self._all_weighed = True
        allowed = {pose.map for pose in self._tracked} if among is None else set(among)
        # Where no adjustment confirms the network's scale, that of the chain of frames stays: it is consistent.
        for share in (1.0, 0.0) if any(self._log_scales) else (0.0,):
            self._path = path_without_drift(self._tracked, share * np.array(self._log_scales))
            alone = self._adjusted({map_number: self._unit(map_number)}, map_number)
            if not alone.correction.refused:
                break
        found, worlds = self._merged_and_adjusted(map_number, allowed, alone)
        correction = found.correction if len(worlds) > 1 else self._with_moving_tissue(found, worlds)
        if not correction.refused and correction.tissue is None:
            tested = found if alone.correction.refused else alone  # the main map tells enough of the lens
            correction = replace(correction, lens_residual=lens_residual(tested.problem, tested.rigid))
        return replace(correction, S_common_map=worlds, tracked=tracked or {})

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
            if not together.accepted(alone, self.settings.max_sigma_px):
                refused += 1
                continue
            merged.add(number)
            if merged <= few or len(worlds) == 1:
                found, worlds = together, S
        if len(worlds) < len(merged):
            S = self._merged(main, merged)
            together = self._adjusted(S, main)
            if together.accepted(alone, self.settings.max_sigma_px):
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
        points, _ = self._tracks.collected(np.flatnonzero(map_of == map_number))
        if len(set(map_of.tolist())) < 2 or not len(points.log_depth):
            return {map_number: self._unit(map_number)}
        chosen = np.flatnonzero(np.isin(map_of, [map_number, *allowed])).tolist()
        loops, T_world_camera = self._loops_among(chosen, -self._path.drift[chosen]), self._path.T_world_camera[chosen]
        worlds = merge_maps(T_world_camera, map_of[chosen].tolist(), loops, map_number, points.median_mm)
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
        assert self._camera is not None
        chosen = [k for k, pose in enumerate(self._tracked) if pose.map in worlds]
        map_of = np.array([self._tracked[k].map for k in chosen])
        problem, accepted = self._problem(chosen, worlds, self._camera)
        found, shape = adjust_in_windows(problem), ShapeTest()
        if len(worlds) == 1 and self.settings.other_starts:
            is_rigid = found.sigma_px <= self.settings.max_sigma_px
            found, shape = with_other_starts(problem, found, is_rigid=is_rigid)
        refused, fields = self._judged(chosen, problem, found, shape, worlds)
        ends = map_of[problem.points.host[problem.observations.point]], map_of[problem.observations.keyframe]
        within, between_px = errors_of_maps(errors_px(problem, found.state), *ends, [*worlds], main)
        before, _ = errors_of_maps(errors_px(problem, problem.begin), *ends, [*worlds], main)
        # A map of one keyframe has no observations: NaN.
        largest_px, graph_px = float(np.fmax.reduce(within)), float(np.fmax.reduce(before))
        index = np.array(self._frames)[chosen]
        if not refused:
            correction = self._correction(chosen, worlds, found)
            correction = replace(correction, depth_fields=fields, shape=shape, loops=len(accepted))
        elif len(worlds) > 1 and problem.start is not None:
            by_graph = found._replace(state=problem.start._replace(sigma_px=found.sigma_px))
            correction = replace(self._correction(chosen, worlds, by_graph), refused=refused, loops=len(accepted))
            if self._depth_contradiction(chosen, by_graph, (), worlds):
                graph_px = math.inf
        else:
            as_tracked = np.tile(np.eye(4), (len(chosen), 1, 1))
            correction = FrameCorrection(index, as_tracked, np.zeros(len(index)), found.sigma_px, refused=refused)
            correction = self._with_steps(replace(correction, shape=shape), chosen, worlds)
        correction = replace(correction, loop_frames=index[accepted].tolist() if correction.loops else [])
        main_px, support = within[list(worlds).index(main)], loop_support(accepted, map_of, main)
        return AdjustedMaps(correction, problem, found.state, main_px, largest_px, between_px, graph_px, support)

    def _with_moving_tissue(self, alone: AdjustedMaps, worlds: Mapping[int, Similarity]) -> FrameCorrection:
        """Return the correction with tissue that moves where left-out tracks confirm it, else the rigid one."""
        by_depth = alone.correction.refused and alone.rigid.sigma_px < RIGID_CORE_PX
        if self._camera is None or not self.settings.moving_tissue or by_depth:
            return alone.correction
        chosen = [k for k, pose in enumerate(self._tracked) if pose.map in worlds]
        time_s = np.array(self._times_s)[chosen]
        solution = adjust_moving_tissue(alone.problem, alone.rigid, time_s)
        if solution is None:
            return alone.correction
        found, deformation, left_out = solution
        rate = deformation.rate_per_min(time_s)
        fields, tissue = self._fields(chosen, alone.problem.points, found), TissueMotion(deformation, left_out, rate)
        return replace(self._correction(chosen, worlds, found), depth_fields=fields, tissue=tissue)

    def _problem(
        self, chosen: list[int], worlds: Mapping[int, Similarity], camera: PinholeCamera
    ) -> tuple[BundleProblem, np.ndarray]:
        """Return the bundle adjustment of chosen keyframes, from the pose graph, and its accepted loops (A, 2)."""
        settings, poses = self.settings, [self._tracked[k] for k in chosen]
        T_map_camera, to_common = self._path.T_world_camera[chosen], [worlds[pose.map] for pose in poses]
        T_world_camera = np.stack([S.transform_poses(T) for S, T in zip(to_common, T_map_camera, strict=True)])
        log_unit = np.log([S.scale for S in to_common]) - self._path.drift[chosen]
        points, observations = self._tracks.collected(chosen, self.most_observations)
        points = replace(points, log_depth=points.log_depth + log_unit[points.host])
        rotation_rad = math.radians(settings.rotation_sigma_deg)
        priors = Priors(settings.scale_sigma, rotation_rad, settings.translation_sigma_share)
        pairs = tracked_pairs([self._frames[k] for k in chosen], poses)
        T, correlated = inverse(T_world_camera), settings.correlated_observations
        problem = BundleProblem(T, points, observations, priors, pairs, camera.fx, correlated=correlated)
        loops = self._loops_among(chosen, log_unit)
        if not loops:
            return problem, np.zeros((0, 2), int)
        graph = optimise_pose_graph(T_world_camera, pairs, loops, points.median_mm)
        log_depth = points.log_depth + graph.log_scale[points.host]
        start = State(inverse(graph.T_world_camera), graph.log_scale, log_depth, problem.tracked.lens)
        return replace(problem, start=start), graph.accepted

    def _as_tracked(self, chosen: list[int], worlds: Mapping[int, Similarity]) -> np.ndarray:
        """Return the poses (C, 4, 4) of chosen keyframes as tracked, in the common world."""
        poses = [self._tracked[k] for k in chosen]
        return np.stack([worlds[pose.map].transform_poses(pose.T_world_camera) for pose in poses])

    def _correction(
        self, chosen: list[int], worlds: Mapping[int, Similarity], found: BundleSolution
    ) -> FrameCorrection:
        """Return the correction by a solution of chosen keyframes."""
        state, index = found.state, np.array(self._frames)[chosen]
        T_world_world = inverse(state.T_camera_world) @ inverse(self._as_tracked(chosen, worlds))
        depth_mm = float(np.exp(np.median(state.log_depth))) if len(state.log_depth) else 1.0
        log_scale = state.log_scale - self._path.drift[chosen]
        correction = FrameCorrection(index, T_world_world, log_scale, found.sigma_px, depth_mm=depth_mm)
        return self._with_steps(correction, chosen, worlds)

    def _with_steps(
        self, correction: FrameCorrection, chosen: list[int], worlds: Mapping[int, Similarity]
    ) -> FrameCorrection:
        """Return a correction that spreads the step of each keyframe over the frames that lead to it."""
        return correction.with_steps([self._tracked[k] for k in chosen], [self._steps[k] for k in chosen], worlds)

    def _judged(
        self,
        chosen: list[int],
        problem: BundleProblem,
        found: BundleSolution,
        shape: ShapeTest,
        worlds: Mapping[int, Similarity],
    ) -> tuple[Notice | None, tuple[DepthCorrectionField, ...]]:
        """Return why a solution is refused, None where it is not, and its depth correction fields."""
        if not found.sigma_px <= self.settings.max_sigma_px:  # NaN: nothing was observed
            return Notice("mapping-not-rigid", {"sigma_px": found.sigma_px, "merged": ""}), ()
        if shape.is_contradicted and found.sigma_px > RIGID_SIGMA_PX:  # else poses fit the views all the same
            errors = {"error_px": shape.error_px, "other_px": shape.other_px}
            return Notice("mapping-not-determined", {**errors, "merged": ""}), ()
        fields = self._fields(chosen, problem.points, found)
        if shape.outcome != "not tested":  # the starts have judged the shape
            return None, fields
        return self._depth_contradiction(chosen, found, fields, worlds), fields

    def _fields(self, chosen: list[int], points: Points, found: BundleSolution) -> tuple[DepthCorrectionField, ...]:
        """Return the depth correction fields of chosen keyframes by a solution; () where depth is only scaled."""
        if (step_sigma := self.settings.depth_step_sigma) <= 0:
            return ()
        assert self._camera is not None
        drift = self._path.drift[chosen]
        as_tracked = replace(points, log_depth=points.log_depth + drift[points.host])
        change = found.state.log_depth - points.log_depth - found.state.log_scale[points.host]
        return fit_depth_corrections(self._camera, as_tracked, len(drift), change, found.log_depth_sigma, step_sigma)

    def _depth_contradiction(
        self,
        chosen: list[int],
        found: BundleSolution,
        fields: tuple[DepthCorrectionField, ...],
        worlds: Mapping[int, Similarity],
    ) -> Notice | None:
        """Return that the depths of keyframes agree less than as tracked, None where they agree."""
        assert self._camera is not None
        grids = self._depths_mm.read().reshape(-1, *self._grid_shape)
        before = [np.float32(worlds[self._tracked[k].map].scale) * grids[k] for k in chosen]
        log_scale = found.state.log_scale - self._path.drift[chosen]
        after = [np.exp(scale) * grid for scale, grid in zip(log_scale, before, strict=True)]
        if fields:
            factors = [np.exp(field.log_factor(grid)) for field, grid in zip(fields, before, strict=True)]
            after = [factor * grid for factor, grid in zip(factors, after, strict=True)]
        # Farther apart two keyframes may have a few pixels in common, which prove nothing.
        gaps = [gap for gap in self.settings.keyframe_gaps if gap <= MOST_RECENT]
        both = (self._as_tracked(chosen, worlds), before), (inverse(found.state.T_camera_world), after)
        grown = growth_of_disagreement(self._camera, *both, gaps)
        if grown is None:
            return None
        return Notice("mapping-depth-disagrees", {"tracked": grown[0], "adjusted": grown[1], "merged": ""})
