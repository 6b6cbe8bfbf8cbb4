"""The back end: gathers keyframes beside the tracker, and adjusts them all together at the end."""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from scopemap.backend.adjustment import Points, Priors, Problem, Solution, adjust
from scopemap.backend.correction import Correction, unchanged
from scopemap.backend.depth_grid import DepthGrid, fit_grid
from scopemap.backend.links import Linker
from scopemap.backend.loops import Loop, LoopFinder
from scopemap.backend.pose_graph import spread_loops
from scopemap.camera import PinholeCamera
from scopemap.config import BackendSettings
from scopemap.flow import DisFlow
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse

# Points whose depth is known to a tenth.
_SURE = 0.1


class Backend:
    """Takes keyframes as they come and returns what has to be corrected, map by map.

    Keyframes are linked in a thread of their own, by OpenCV's DIS flow whatever flow the front end uses: over the wide
    gaps between keyframes many pairs are needed, and the adjustment does away with what it gets wrong. Loops are
    looked for there, too; what they say is spread over all keyframes before these are adjusted.
    """

    def __init__(self, settings: BackendSettings) -> None:
        self.settings = settings
        self._maps: dict[int, _Map] = {}
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="backend")
        self._links: deque[Future[None]] = deque()

    def keyframes(self, map_number: int = 0) -> int:
        """Return how many keyframes of a map were added."""
        return len(self._maps[map_number].index) if map_number in self._maps else 0

    def add(self, keyframe: Frame, map_number: int = 0) -> None:
        """Take a keyframe with depth and pose, later than those before; poses of one map share a world."""
        if keyframe.T_world_camera is None:
            raise ValueError("a keyframe needs a pose")
        own = self._maps.setdefault(map_number, _Map(self.settings))
        own.index.append(keyframe.index)
        own.T_world_camera.append(keyframe.T_world_camera)
        # What went wrong with earlier keyframes is heard of now, not after the last frame.
        while self._links and self._links[0].done():
            self._links.popleft().result()
        self._links.append(self._worker.submit(own.link, keyframe))

    def adjust(self, map_number: int = 0) -> Correction:
        """Return the correction of all frames of a map, after the last keyframe.

        It changes nothing where a rigid scene cannot explain what was seen. Raises ValueError where no keyframe of that
        map was added.
        """
        if map_number not in self._maps:
            raise ValueError("nothing to adjust: no keyframe was added")
        while self._links:
            self._links.popleft().result()
        self._worker.shutdown()
        return self._maps[map_number].adjusted()


class _Map:
    """The keyframes of one map, what links them, and the loops among them."""

    def __init__(self, settings: BackendSettings) -> None:
        self.settings = settings
        self.index: list[int] = []
        self.T_world_camera: list[np.ndarray] = []
        self._linker = Linker(settings, DisFlow())
        self._finder = LoopFinder(settings) if settings.loop_landmarks > 0 else None
        self._loops: list[Loop] = []
        self._camera: PinholeCamera | None = None

    def link(self, keyframe: Frame) -> None:
        """Link a keyframe to those just before it, and to those long before that show the same."""
        self._camera = keyframe.camera
        self._linker.add(keyframe)
        for loop in self._finder.add(keyframe) if self._finder is not None else []:
            self._linker.close(loop)
            self._loops.append(loop)

    def adjusted(self) -> Correction:
        """Adjust all keyframes together."""
        camera, settings = self._camera, self.settings
        assert camera is not None
        T_world_camera = np.stack(self.T_world_camera)
        priors = Priors(settings.scale_sigma, math.radians(settings.turn_sigma_deg), settings.way_sigma_share)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        points, sightings = self._linker.collected()
        start, loops = None, 0
        if self._loops:
            graph = spread_loops(T_world_camera, self._loops, float(np.exp(np.median(points.log_depth))))
            start, loops = (inverse(graph.T_world_camera), graph.log_scale), graph.believed
        problem = Problem(intrinsics, inverse(T_world_camera), points, sightings, priors, start)
        found = adjust(problem)
        if start is not None and self._doubt(points, found):
            # Loops may be what is wrong.
            found, loops = adjust(replace(problem, start=None)), 0
        index, doubt = np.array(self.index), self._doubt(points, found)
        if doubt:
            return unchanged(index, found.sigma_px, doubt)
        T_world_world = inverse(found.T_camera_world) @ inverse(T_world_camera)
        grids = self._grids(camera, points, found) if settings.depth_step_sigma > 0 else ()
        return Correction(index, T_world_world, found.log_scale, found.sigma_px, loops=loops, grids=grids)

    def _doubt(self, points: Points, found: Solution) -> str:
        """Say why a rigid scene does not explain what was seen, "" where it does."""
        settings = self.settings
        if not found.sigma_px <= settings.max_sigma_px:
            return f"points seen again lie {found.sigma_px:.2f} px from where they should"
        sure = found.log_depth_sigma < _SURE
        change = np.abs(_depth_change(points, found)[sure])
        # Depth that is wrong by a third almost everywhere is not what networks do; tissue that swells under a camera
        # at rest looks just so.
        if sure.any() and np.median(change) > settings.max_depth_change:
            return f"depth would have to change by {100 * np.expm1(np.median(change)):.0f} %"
        return ""

    def _grids(self, camera: PinholeCamera, points: Points, found: Solution) -> tuple[DepthGrid, ...]:
        """Fit what each keyframe's depth lacks beside its scale, by its adjusted points."""
        error = _depth_change(points, found)
        pixels = points.rays[:, :2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        places = (pixels + 0.5) / [camera.width, camera.height]
        of = [slice(*np.searchsorted(points.host, (k, k + 1))) for k in range(len(self.index))]
        step_sigma = self.settings.depth_step_sigma
        return tuple(
            fit_grid(places[own], points.log_depth[own], error[own], found.log_depth_sigma[own], step_sigma)
            for own in of
        )


def _depth_change(points: Points, found: Solution) -> np.ndarray:
    """What each point (P,) adds to ln of its estimated depth, beside its keyframe's scale."""
    return found.log_depth - points.log_depth - found.log_scale[points.host]
