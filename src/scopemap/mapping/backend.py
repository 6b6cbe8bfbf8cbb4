"""The back end: gathers keyframes beside the tracker, and adjusts them all together at the end."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import MappingSettings
from scopemap.flow.estimator import FlowEstimator
from scopemap.frame import Frame
from scopemap.geometry.align import Similarity
from scopemap.geometry.least_squares import robust_sigma_2d
from scopemap.geometry.se3 import inverse
from scopemap.mapping.bundle_adjustment import Solution, adjust, errors_px
from scopemap.mapping.depth_correction import DepthGrid, fit_grid
from scopemap.mapping.feature_tracks import Linker
from scopemap.mapping.loop_closure import Loop, LoopFinder
from scopemap.mapping.map_merging import join_maps
from scopemap.mapping.pose_graph import spread_loops
from scopemap.mapping.pose_interpolation import Correction, TrackedPose, unchanged
from scopemap.mapping.reprojection import Points, Priors, Problem, State

# Points whose depth is known to a tenth; fewer than that share of all may be what moves by itself.
_SURE, _LEAST_SURE = 0.1, 0.1
# What remains within the main map may get so much larger where others are joined with it.
_MAY_SUFFER, _NOISE_PX = 1.5, 0.05


class _Keyframe(NamedTuple):
    """Number of a keyframe's frame, and how it was tracked."""

    frame: int
    tracked: TrackedPose


class _Adjusted(NamedTuple):
    """A correction, and the robust deviation of what remains, px: in the main map, the worst in one, between maps.

    NaN where nothing is seen again.
    """

    correction: Correction
    main_px: float
    worst_px: float
    between_px: float

    def fits(self, alone: _Adjusted, most_px: float) -> bool:
        """Whether maps belong together: by what ties them, and by the main one, which must not suffer for it."""
        rigid = not self.correction.refused and self.worst_px <= most_px
        tied = self.correction.loops > 0 and self.between_px <= most_px
        return rigid and tied and self.main_px <= _MAY_SUFFER * alone.main_px + _NOISE_PX


class Backend:
    """Takes keyframes as they come and returns what has to be corrected.

    Keyframes are linked in a thread of their own, by the flow given, which no other thread may use meanwhile. Loops are
    looked for there, too; those between maps join them, and what all of them say is spread over all keyframes before
    these are adjusted.
    """

    def __init__(self, settings: MappingSettings, flow: FlowEstimator) -> None:
        self.settings = settings
        self._keyframes: list[_Keyframe] = []
        self._linker = Linker(settings, flow)
        self._finder = LoopFinder(settings) if settings.min_loop_inliers > 0 else None
        self._loops: list[Loop] = []
        self._camera: PinholeCamera | None = None
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="backend")
        self._links: deque[Future[None]] = deque()

    def keyframes(self, map_number: int = 0) -> int:
        """Return how many keyframes of a map were added."""
        return sum(keyframe.tracked.map == map_number for keyframe in self._keyframes)

    def add(self, keyframe: Frame, tracked: TrackedPose | None = None) -> None:
        """Take a keyframe with depth and pose, later than those before; poses of one map share a world.

        tracked : how it was tracked; None: in map 0, from the keyframe before.
        """
        if keyframe.T_world_camera is None:
            raise ValueError("a keyframe needs a pose")
        if tracked is None:
            before = self._keyframes[-1].frame if self._keyframes else keyframe.index
            tracked = TrackedPose(0, before, keyframe.T_world_camera)
        self._keyframes.append(_Keyframe(keyframe.index, tracked))
        # What went wrong with earlier keyframes is heard of now, not after the last frame.
        while self._links and self._links[0].done():
            self._links.popleft().result()
        self._links.append(self._worker.submit(self._link, keyframe, tracked.map))

    def adjust(
        self,
        map_number: int = 0,
        tracked: Mapping[int, TrackedPose] | None = None,
        among: Collection[int] | None = None,
    ) -> Correction:
        """Return the correction of all frames of a map, and of those maps that show the same, after the last keyframe.

        tracked : by number of the frame, how it was tracked; frames of several maps need it. among : numbers of the
        maps that may be merged; None: all. The correction changes nothing where a rigid scene cannot explain what was
        seen. Raises ValueError where no keyframe of that map was added.
        """
        if not self.keyframes(map_number):
            raise ValueError("nothing to adjust: no keyframe was added")
        while self._links:
            self._links.popleft().result()
        self._worker.shutdown()
        free = {keyframe.tracked.map for keyframe in self._keyframes} if among is None else set(among)
        worlds = {map_number: Similarity.identity()}
        found = alone = self._adjusted(worlds, map_number)
        others = [*self._joined(map_number, free)][1:]
        # All at once if that can be; else one by one, for it may be a single one that does not fit.
        for some in (others, *([number] for number in others if len(others) > 1)):
            more = self._joined(map_number, {*worlds, *some})
            if len(more) == len(worlds):
                continue
            together = self._adjusted(more, map_number)
            if together.fits(alone, self.settings.max_sigma_px):
                found, worlds = together, more
        return replace(found.correction, S_common_map=worlds, tracked=tracked or {})

    def _link(self, keyframe: Frame, map_number: int) -> None:
        """Link a keyframe to those just before it, and to those elsewhere that show the same."""
        self._camera = keyframe.camera
        self._linker.add(keyframe, map_number)
        for loop in self._finder.add(keyframe, map_number) if self._finder is not None else []:
            self._linker.close(loop)
            self._loops.append(loop)

    def _joined(self, map_number: int, free: Collection[int]) -> dict[int, Similarity]:
        """Return the worlds of the maps, of those that are free, that belong together with this one."""
        map_of = [keyframe.tracked.map for keyframe in self._keyframes]
        points, _ = self._linker.collected(np.flatnonzero(np.array(map_of) == map_number))
        if len(set(map_of)) < 2 or not len(points.log_depth):
            return {map_number: Similarity.identity()}
        depth_mm = float(np.exp(np.median(points.log_depth)))
        T_world_camera = np.stack([keyframe.tracked.T_world_camera for keyframe in self._keyframes])
        loops = [loop for loop in self._loops if map_of[loop.past] in free and map_of[loop.new] in free]
        return join_maps(T_world_camera, map_of, loops, map_number, depth_mm)

    def _adjusted(self, worlds: Mapping[int, Similarity], main: int) -> _Adjusted:
        """Adjust all keyframes of the maps with these worlds together."""
        camera, settings = self._camera, self.settings
        assert camera is not None
        chosen = [k for k, keyframe in enumerate(self._keyframes) if keyframe.tracked.map in worlds]
        own = [self._keyframes[k] for k in chosen]
        world_of = [worlds[keyframe.tracked.map] for keyframe in own]
        T_world_camera = np.stack(
            [w.transform_poses(k.tracked.T_world_camera) for w, k in zip(world_of, own, strict=True)]
        )
        log_unit = np.log([world.scale for world in world_of])
        points, sightings = self._linker.collected(chosen)
        points = replace(points, log_depth=points.log_depth + log_unit[points.host])
        priors = Priors(
            settings.scale_sigma, math.radians(settings.rotation_sigma_deg), settings.translation_sigma_share
        )
        pairs, loops = _neighbours(own), 0
        problem = Problem(inverse(T_world_camera), points, sightings, priors, pairs, camera.fx)
        if said := _of(self._loops, chosen, log_unit):
            depth_mm = float(np.exp(np.median(points.log_depth)))
            graph = spread_loops(T_world_camera, pairs, said, depth_mm)
            loops, log_depth = graph.believed, points.log_depth + graph.log_scale[points.host]
            start = State(inverse(graph.T_world_camera), graph.log_scale, log_depth, problem.tracked.lens)
            problem = replace(problem, start=start)
        found = adjust(problem)
        if problem.start is not None and self._doubt(points, found):
            # Loops may be what is wrong.
            found, loops = adjust(replace(problem, start=None)), 0
        map_of = np.array([keyframe.tracked.map for keyframe in own])
        host, other = map_of[points.host[sightings.point]], map_of[sightings.keyframe]
        off_px = errors_px(problem, found)
        within = {number: _sigma_px(off_px[(host == number) & (other == number)]) for number in worlds}
        correction, between_px = self._correction(own, problem, found, loops), _sigma_px(off_px[host != other])
        # A map of one keyframe sees nothing again.
        return _Adjusted(correction, within[main], np.fmax.reduce(list(within.values())), between_px)

    def _correction(self, own: Sequence[_Keyframe], problem: Problem, found: Solution, loops: int) -> Correction:
        """Return what a solution makes of these keyframes, or, where it is doubtful, that nothing is to be changed."""
        index, points, camera = np.array([keyframe.frame for keyframe in own]), problem.points, self._camera
        assert camera is not None
        if doubt := self._doubt(points, found):
            return unchanged(index, found.sigma_px, doubt)
        T_world_world = inverse(found.state.T_camera_world) @ problem.T_camera_world
        grids = self._grids(camera, points, found) if self.settings.depth_step_sigma > 0 else ()
        depth_mm = float(np.exp(np.median(points.log_depth))) if len(points.log_depth) else 1.0
        return Correction(
            index, T_world_world, found.state.log_scale, found.sigma_px, loops=loops, grids=grids, depth_mm=depth_mm
        )

    def _doubt(self, points: Points, found: Solution) -> str:
        """Say why a rigid scene does not explain what was seen, "" where it does."""
        settings = self.settings
        if not found.sigma_px <= settings.max_sigma_px:
            return f"points seen again lie {found.sigma_px:.2f} px from where they should"
        sure = found.log_depth_sigma < _SURE
        change = np.abs(_depth_change(points, found)[sure])
        # Depth that is wrong by a third almost everywhere is not what networks do; tissue that swells under a camera
        # at rest looks just so.
        if sure.sum() > _LEAST_SURE * len(sure) and np.median(change) > settings.max_depth_change:
            return f"depth would have to change by {100 * np.expm1(np.median(change)):.0f} %"
        return ""

    def _grids(self, camera: PinholeCamera, points: Points, found: Solution) -> tuple[DepthGrid, ...]:
        """Fit what each keyframe's depth lacks beside its scale, by its adjusted points."""
        error = _depth_change(points, found)
        pixels = points.pixel * [1.0, camera.fy / camera.fx] + [camera.cx, camera.cy]
        places = (pixels + 0.5) / [camera.width, camera.height]
        of = [slice(*np.searchsorted(points.host, (k, k + 1))) for k in range(len(found.state.T_camera_world))]
        step_sigma = self.settings.depth_step_sigma
        return tuple(
            fit_grid(places[own], points.log_depth[own], error[own], found.log_depth_sigma[own], step_sigma)
            for own in of
        )


def _sigma_px(off_px: np.ndarray) -> float:
    """Robust standard deviation of distances in the plane; NaN of none."""
    return robust_sigma_2d(off_px) if len(off_px) else float("nan")


def _depth_change(points: Points, found: Solution) -> np.ndarray:
    """What each point (P,) adds to ln of its estimated depth, beside its keyframe's scale."""
    return found.state.log_depth - points.log_depth - found.state.log_scale[points.host]


def _neighbours(keyframes: Sequence[_Keyframe]) -> np.ndarray:
    """Pairs (C, 2) of keyframes of which the second was tracked from the first.

    That is the one it was aligned to, or, where that was none of them, the one before it in its map.
    """
    place = {keyframe.frame: k for k, keyframe in enumerate(keyframes)}
    pairs: list[tuple[int, int]] = []
    latest: dict[int, int] = {}
    for k, keyframe in enumerate(keyframes):
        first = place.get(keyframe.tracked.keyframe, k)
        first = latest.get(keyframe.tracked.map, k) if first >= k else first
        if first < k:
            pairs.append((first, k))
        latest[keyframe.tracked.map] = k
    return np.array(pairs, dtype=int).reshape(-1, 2)


def _of(loops: Sequence[Loop], chosen: Sequence[int], log_unit: np.ndarray) -> list[Loop]:
    """Return the loops among the chosen keyframes, called by their place here, in the millimetres that these get.

    log_unit : (K,) ln of what the chosen keyframes' millimetres are multiplied by.
    """
    place = {number: k for k, number in enumerate(chosen)}
    out = []
    for loop in loops:
        if loop.past in place and loop.new in place:
            past, new = place[loop.past], place[loop.new]
            T_new_past = loop.T_new_past.copy()
            T_new_past[:3, 3] *= np.exp(log_unit[past])
            ratio = loop.log_ratio + float(log_unit[new] - log_unit[past])
            out.append(replace(loop, past=past, new=new, T_new_past=T_new_past, log_ratio=ratio))
    return out
