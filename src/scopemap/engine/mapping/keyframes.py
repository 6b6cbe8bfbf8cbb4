"""Keyframes after the last one: what was collected of them, and of which adjustment they are a part.

`Keyframes` are those of all maps, each in the world of its map. `MapKeyframes` are those of some maps in a common
world, and what an adjustment makes of them.

Loop closures show drift of the scale where the camera comes back, and the network's scale along new places: each
frame's depth takes its scale from the one before (`depth/mapis.py`), and errors add up; the network's scale is noisy
from frame to frame but does not drift. ln of the chained scale over the network's is drift plus noise. The drift is its
smooth part (Whittaker, "On a new method of graduation", 1923).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from scipy.sparse import identity
from scipy.sparse.linalg import spsolve

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MappingSettings
from scopemap.engine.frame import Rows
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.mapping.bundle_adjustment import BundleSolution, errors_px
from scopemap.engine.mapping.bundle_problem import CORRELATED, TRACKED, BundleProblem, BundleState, Points, Priors
from scopemap.engine.mapping.correction import FrameCorrection, KeyframeStep, TrackedPose
from scopemap.engine.mapping.depth_correction import DepthCorrectionField, fit_depth_corrections
from scopemap.engine.mapping.feature_tracks import FeatureTracks
from scopemap.engine.mapping.judge import refusal_by_depth
from scopemap.engine.mapping.loop_closure import Loop
from scopemap.engine.mapping.pose_graph import Part, merge_maps, optimise_pose_graph, split_maps, tracked_pairs
from scopemap.engine.notices import Notice

# Standard deviations, ln: of the network's scale at a keyframe, many of which err alike, of the drift from one keyframe
# to the next, and of the change of that drift. Without any drift a phantom of fast motion is 33 mm off, with it 3.5
# (bench/results/earns.md); six real clips do not care.
_NETWORK_SIGMA = 0.2  # by hand
_DRIFT_SIGMA = 0.02  # by hand
_CHANGE_SIGMA = 0.002  # by hand
# Reprojection error, rad, of observations that support a motion across a loss: drift is less, false matches are more.
_MAX_PART_ERROR = 0.05  # by hand


@dataclass(frozen=True)
class Keyframes:
    """All K keyframes of a run, each in the world of its map.

    frames : numbers of their frames, increasing. poses, steps : as tracked, and how far each was moved as it came.
    log_scales : (K,) ln of the factor by which the estimated depth of each was scaled, `Frame.depth_scale`. grids_mm :
    K rows, depths (h, w) as `depth_grid` gives them, of `grid_shape`. tracks, loops : what was matched of them; loops
    are rows of the kind `LOOP`. camera, settings : of the run. anchored : as `scale_by_network` takes it.
    most_observations : about so many are adjusted. log_drift, T_map_camera : (K,) ln of the drift of their scale that
    is divided out, and (K, 4, 4) poses without it, each in the world of its map, as `with_path` sets them.
    """

    frames: Sequence[int]
    poses: Sequence[TrackedPose]
    steps: Sequence[KeyframeStep]
    log_scales: np.ndarray
    grids_mm: Rows
    grid_shape: tuple[int, int]
    tracks: FeatureTracks
    loops: Rows
    camera: PinholeCamera
    settings: MappingSettings
    anchored: bool
    most_observations: int
    log_drift: np.ndarray = field(default_factory=partial(np.zeros, 0))
    T_map_camera: np.ndarray = field(default_factory=partial(np.zeros, (0, 4, 4)))

    @property
    def map_of(self) -> np.ndarray:
        """Number of each keyframe's map, (K,) int."""
        return np.array([pose.map for pose in self.poses])

    def split(self, relocalised: Collection[tuple[Part, Part]]) -> dict[Part, int]:
        """Return the map of each part of the maps, as `split_maps` does; {} where each map is one part."""
        parts = list(dict.fromkeys((pose.map, pose.lost_before) for pose in self.poses))
        if len(parts) == len({number for number, _ in parts}):
            return {}
        part_of = np.array([parts.index((pose.map, pose.lost_before)) for pose in self.poses])
        points, observations = self.tracks.collected(across=part_of)
        T = np.stack([pose.T_world_camera for pose in self.poses])
        problem = BundleProblem(inverse(T), points, observations, Priors(), np.zeros((0, 2), int), self.camera.fx)
        pairs = np.column_stack([points.host[observations.point], observations.keyframe])
        pairs = pairs[errors_px(problem, problem.tracked) < _MAX_PART_ERROR * self.camera.fx]
        return split_maps(self.poses, pairs, relocalised)

    def with_path(self, *, keeps_drift: bool) -> Keyframes:
        """Return the keyframes with or without the drift of their scale; needed before what follows."""
        log_drift, T_map_camera = path_without_drift(self.poses, (0.0 if keeps_drift else 1.0) * self.log_scales)
        return replace(self, log_drift=log_drift, T_map_camera=T_map_camera)

    def unit(self, number: int) -> Similarity:
        """Return the Sim(3) from a map as tracked to the same map in the millimetres of `scale_by_network`."""
        off = self.log_scales - self.log_drift
        return Similarity(scale_by_network(off, self.map_of, number, self.anchored), np.eye(3), np.zeros(3))

    def merged_worlds(self, number: int, allowed: Collection[int]) -> dict[int, Similarity]:
        """Return Sim(3) to the common world of a map and of the allowed maps that loop closures merge with it."""
        map_of = self.map_of
        if len(set(map_of.tolist())) < 2:
            return {number: self.unit(number)}
        depth_mm = self.tracks.median_depth_mm(np.flatnonzero(map_of == number))
        if depth_mm is None:
            return {number: self.unit(number)}
        chosen = np.flatnonzero(np.isin(map_of, [number, *allowed])).tolist()
        loops, T_map_camera = self._loops_among(chosen, -self.log_drift[chosen]), self.T_map_camera[chosen]
        worlds = merge_maps(T_map_camera, map_of[chosen].tolist(), loops, number, depth_mm)
        return {one: self.unit(number).after(S) for one, S in worlds.items()}

    def of_maps(self, worlds: Mapping[int, Similarity]) -> MapKeyframes:
        """Return the keyframes of maps with these Sim(3) to the common world."""
        chosen = self._chosen(worlds)
        return MapKeyframes(
            index=np.array(self.frames)[chosen],
            poses=[self.poses[k] for k in chosen],
            steps=[self.steps[k] for k in chosen],
            log_drift=self.log_drift[chosen],
            grids_mm=self.grids_mm.read().reshape(-1, *self.grid_shape)[chosen],
            S_common_map=worlds,
            camera=self.camera,
            settings=self.settings,
        )

    def problem(self, worlds: Mapping[int, Similarity]) -> tuple[BundleProblem, np.ndarray]:
        """Return the bundle adjustment of maps' keyframes, from the pose graph, and its accepted loops (A, 2)."""
        chosen = self._chosen(worlds)
        poses = [self.poses[k] for k in chosen]
        T_map_camera, to_common = self.T_map_camera[chosen], [worlds[pose.map] for pose in poses]
        T_world_camera = np.stack([S.transform_poses(T) for S, T in zip(to_common, T_map_camera, strict=True)])
        log_unit = np.log([S.scale for S in to_common]) - self.log_drift[chosen]
        pairs, graph = tracked_pairs([self.frames[k] for k in chosen], poses), None
        # Before the observations are read: both fill memory.
        if loops := self._loops_among(chosen, log_unit):
            depth_mm = self.tracks.median_depth_mm(chosen, log_unit)
            assert depth_mm is not None  # loops have points
            graph = optimise_pose_graph(T_world_camera, pairs, loops, depth_mm)
        points, observations = self.tracks.collected(chosen, self.most_observations)
        points = replace(points, log_depth=points.log_depth + log_unit[points.host])
        T = inverse(T_world_camera)
        problem = BundleProblem(T, points, observations, TRACKED, pairs, self.camera.fx, correlated=CORRELATED)
        if graph is None:
            return problem, np.zeros((0, 2), int)
        log_depth = points.log_depth + graph.log_scale[points.host]
        start = BundleState(inverse(graph.T_world_camera), graph.log_scale, log_depth, problem.tracked.log_focal)
        return replace(problem, start=start), graph.accepted

    def partner(self, number: int, merged: Collection[int]) -> int:
        """Return the map among merged ones that a map has most loops with."""
        map_of, loops = self.map_of, self.loops.read()
        ends = np.column_stack([map_of[loops["past"]], map_of[loops["new"]]])
        others = ends[(ends == number).any(1)].sum(1) - number
        return max(sorted(merged), key=lambda one: int((others == one).sum()))

    def _chosen(self, worlds: Mapping[int, Similarity]) -> list[int]:
        """Return the places of the keyframes of these maps."""
        return [k for k, pose in enumerate(self.poses) if pose.map in worlds]

    def _loops_among(self, chosen: list[int], log_unit: np.ndarray) -> list[Loop]:
        """Return the loops between these keyframes, numbered by their place; log_unit as `Loop.among` takes it."""
        among, found = set(chosen), map(Loop.of_row, self.loops.read())
        return [loop.among(chosen, log_unit) for loop in found if {loop.past, loop.new} <= among]


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
        T_adjusted_tracked = inverse(state.T_camera_world) @ inverse(self.T_world_camera)
        depth_mm = float(np.exp(np.median(state.log_depth))) if len(state.log_depth) else 1.0
        log_scale = state.log_scale - self.log_drift
        correction = FrameCorrection(self.index, T_adjusted_tracked, log_scale, found.sigma_px, depth_mm=depth_mm)
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
            factors = [np.exp(one.log_factor(grid)) for one, grid in zip(fields, self.tracked_depths, strict=True)]
            after = [factor * grid for factor, grid in zip(factors, after, strict=True)]
        return inverse(found.state.T_camera_world), after

    def refusal_by_depth(self, found: BundleSolution, fields: tuple[DepthCorrectionField, ...] = ()) -> Notice | None:
        """Return that the depths of keyframes agree less than as tracked; None: they agree about as well."""
        before = self.T_world_camera, self.tracked_depths
        return refusal_by_depth(self.camera, before, self.adjusted_depths(found, fields))

    def _with_steps(self, correction: FrameCorrection) -> FrameCorrection:
        return correction.with_steps(self.poses, self.steps, self.S_common_map)


def path_without_drift(tracked: Sequence[TrackedPose], log_scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ln of the drift of the scale along each map (K,), and poses (K, 4, 4) without it, each in its map's world.

    log_scale : (K,) ln of the factor by which each keyframe's estimated depth was scaled, `Frame.depth_scale`. The
    translation from each keyframe to the next, and its depth, are divided by the drift there. The first keyframe of a
    map keeps pose and scale.
    """
    T, map_of = np.stack([pose.T_world_camera for pose in tracked]), np.array([pose.map for pose in tracked])
    drift = np.zeros(len(T))
    for number in set(map_of.tolist()):
        own = np.flatnonzero(map_of == number)
        drift[own] = _scale_drift(log_scale[own])
        factor = np.exp(-(drift[own[1:]] + drift[own[:-1]]) / 2)
        steps_mm = factor[:, None] * np.diff(T[own, :3, 3], axis=0)
        T[own[1:], :3, 3] = T[own[0], :3, 3] + np.cumsum(steps_mm, axis=0)
    return drift, T


def _scale_drift(log_scale: np.ndarray) -> np.ndarray:
    """Return the most probable drift (K,), 0 at first: Whittaker's smoothing, by first and second differences."""
    count = len(log_scale)
    differences, normal = identity(count, format="csc"), identity(count, format="csc") / _NETWORK_SIGMA**2
    for sigma in (_DRIFT_SIGMA, _CHANGE_SIGMA):
        if differences.shape[0] > 1:
            differences = differences[1:] - differences[:-1]
            normal += differences.T @ differences / sigma**2
    drift: np.ndarray = spsolve(normal.tocsc(), log_scale / _NETWORK_SIGMA**2)
    return drift - drift[0]


def scale_by_network(log_scale: np.ndarray, map_of: np.ndarray, number: int, anchored: bool) -> float:
    """Return the factor of a map's millimetres that makes them those of the depth network, by most of its keyframes.

    A map begins with the scale with which the one before has ended, so that drift adds up over maps, and the error of
    the very first frame would scale them all. log_scale : (K,) as `path_without_drift` takes it, without its drift.
    map_of : (K,) numbers of the maps. anchored : whether depth was fitted to something else on the first frame: its map
    keeps its millimetres, and others get them by the network.
    """
    off = np.median(log_scale[map_of == number])
    return float(np.exp((np.median(log_scale[map_of == map_of[0]]) if anchored else 0.0) - off))
