"""The back end: gathers keyframes beside the tracker, and adjusts them all together at the end."""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from scopemap.backend.adjustment import Priors, Problem, adjust
from scopemap.backend.correction import Correction, unchanged
from scopemap.backend.links import Linker
from scopemap.backend.loops import Loop, LoopFinder
from scopemap.backend.pose_graph import spread_loops
from scopemap.camera import PinholeCamera
from scopemap.config import BackendSettings
from scopemap.flow import DisFlow
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse


class Backend:
    """Takes keyframes as they come and returns what has to be corrected.

    Keyframes are linked in a thread of their own, by OpenCV's DIS flow whatever flow the front end uses: over the wide
    gaps between keyframes many pairs are needed, and the adjustment does away with what it gets wrong. Loops are
    looked for there, too; what they say is spread over all keyframes before these are adjusted.
    """

    def __init__(self, settings: BackendSettings) -> None:
        self.settings = settings
        self._linker = Linker(settings, DisFlow())
        self._finder = LoopFinder(settings) if settings.loop_landmarks > 0 else None
        self._loops: list[Loop] = []
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="backend")
        self._links: deque[Future[None]] = deque()
        self._index: list[int] = []
        self._T_world_camera: list[np.ndarray] = []
        self._camera: PinholeCamera | None = None

    @property
    def keyframes(self) -> int:
        """How many keyframes were added."""
        return len(self._index)

    def add(self, keyframe: Frame) -> None:
        """Take a keyframe with depth and pose, later than those before."""
        if keyframe.T_world_camera is None:
            raise ValueError("a keyframe needs a pose")
        self._index.append(keyframe.index)
        self._T_world_camera.append(keyframe.T_world_camera)
        self._camera = keyframe.camera
        # What went wrong with earlier keyframes is heard of now, not after the last frame.
        while self._links and self._links[0].done():
            self._links.popleft().result()
        self._links.append(self._worker.submit(self._link, keyframe))

    def adjust(self) -> Correction:
        """Return the correction of all frames, which changes nothing where a rigid scene cannot explain what was seen.

        Raises ValueError where no keyframe was added.
        """
        if self._camera is None:
            raise ValueError("nothing to adjust: no keyframe was added")
        while self._links:
            self._links.popleft().result()
        self._worker.shutdown()
        camera, settings = self._camera, self.settings
        T_world_camera = np.stack(self._T_world_camera)
        priors = Priors(settings.scale_sigma, math.radians(settings.turn_sigma_deg), settings.way_sigma_share)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        points, sightings = self._linker.collected()
        start, loops = None, 0
        if self._loops:
            graph = spread_loops(T_world_camera, self._loops, float(np.exp(np.median(points.log_depth))))
            start, loops = (inverse(graph.T_world_camera), graph.log_scale), graph.believed
        found = adjust(Problem(intrinsics, inverse(T_world_camera), points, sightings, priors, start))
        index = np.array(self._index)
        if not found.sigma_px <= settings.max_sigma_px:
            return unchanged(index, found.sigma_px)
        T_world_world = inverse(found.T_camera_world) @ inverse(T_world_camera)
        return Correction(index, T_world_world, found.log_scale, found.sigma_px, loops=loops)

    def _link(self, keyframe: Frame) -> None:
        """Link a keyframe to those just before it, and to those long before that show the same."""
        self._linker.add(keyframe)
        for loop in self._finder.add(keyframe) if self._finder is not None else []:
            self._linker.close(loop)
            self._loops.append(loop)
