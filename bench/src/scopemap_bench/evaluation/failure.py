"""Frames until tracking fails, by one criterion for all methods: their poses alone against the flow of the pictures.

The relative pose of two frames lets a point of the first be seen on a segment of the second: from where it would be at
infinity to where it would be at twice the translation. Flow that ends beside these segments contradicts the pose; so
does a depth of the scene, as flow and translation imply it, that jumps. A frame without a pose counts as contradicted,
from the first one on: a method cannot gain by answering seldom. Each frame is compared with an earlier one from which
the pictures have moved, so that poses which stand still are contradicted in slow clips, too. What a method itself calls
lost is another figure, `frames_until_loss`. The form and the limits are ours.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.corners import match_corners, usable_pixels
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.geometry.se3 import inverse

LIMITS_PX = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Median distances between flow and the segments above which frames contradict; the criterion is that of `LIMIT_PX`."""
LIMIT_PX = 3.0

# The earlier frame is the latest one, at least so many frames before, from which the median flow is so long: a camera
# that stands still is then off at every limit. Among so many frames with poses.
_STEP = 5
_MOTION_PX = max(LIMITS_PX)
_SEARCHED = 60
# Poses have failed where so many of so many frames in a row are contradicted or missing.
_FAILED = 3
_OF_FRAMES = 5
# Spacing of the points, largest forward-backward error of their flow, px, and fewest that tell anything.
_SPACING_PX = 12
_CONSISTENCY_PX = 1.0
_FEWEST = 30
_NEAREST = 2.0  # depth over translation, and of a ray
_LEAST_Z = 0.05
# The implied depth jumps where it is so many times that of the frames before, of which so many are kept; it is known
# from so many px of parallax.
_JUMP = 3.0
_KEPT = 10
_LEAST_PARALLAX_PX = 1.0


class _PosedFrame(NamedTuple):
    """A frame with a pose: its number, (H, W, 3) uint8, its usable pixels (H, W) bool, the pose (4, 4)."""

    number: int
    rgb: np.ndarray
    valid: np.ndarray
    T_world_camera: np.ndarray


class _Matches(NamedTuple):
    """Pixels (n, 2) of an earlier frame and where flow takes them in a later one."""

    past: np.ndarray
    now: np.ndarray

    @property
    def motion_px(self) -> float:
        """Median length of the flow, px; 0 where too few points are matched to tell."""
        if len(self.past) < _FEWEST:
            return 0.0
        return float(np.median(np.linalg.norm(self.now - self.past, axis=1)))


_NO_MATCHES = _Matches(np.empty((0, 2)), np.empty((0, 2)))


class FailureMeter:
    """Takes the frames of a sequence with a method's poses, and says how many pass until these are contradicted."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera, self._flow = camera, DisFlow()
        self._earlier: deque[_PosedFrame] = deque(maxlen=_SEARCHED)
        self._log_depths: deque[float] = deque(maxlen=_KEPT)
        self._off_px: list[float] = []

    def add(self, rgb: np.ndarray, valid: np.ndarray, T_world_camera: np.ndarray | None) -> None:
        """Add the next frame: (H, W, 3) uint8, its usable pixels (H, W) bool, its pose (4, 4) or None."""
        if T_world_camera is None:
            self._off_px.append(math.inf)
            return
        frame = _PosedFrame(len(self._off_px), rgb, valid, T_world_camera)
        self._off_px.append(self._off(frame))
        self._earlier.append(frame)

    @property
    def is_contradicted(self) -> bool:
        """Whether the poses have failed by the criterion."""
        return _until(np.array(self._off_px) > LIMIT_PX) < len(self._off_px)

    def figures(self) -> dict[str, int]:
        """Return frames_until_contradicted, and _at_N_px for each of `LIMITS_PX`; all frames where none is."""
        off_px = np.array(self._off_px)
        counts = {limit: _until(off_px > limit) for limit in LIMITS_PX}
        name = "frames_until_contradicted"
        return {name: counts[LIMIT_PX]} | {f"{name}_at_{limit:g}_px": count for limit, count in counts.items()}

    def _off(self, frame: _PosedFrame) -> float:
        """Return how far flow is from the segments, median, px; infinite where depth jumps, 0 where too few tell."""
        found = self._moved_from(frame)
        if found is None:
            return 0.0
        past, matches = found
        T_now_past = inverse(frame.T_world_camera) @ past.T_world_camera
        rays = self._camera.unproject(matches.past.astype(float)) @ T_now_past[:3, :3].T
        off_px, log_depth = self._compared(rays, matches.now, T_now_past[:3, 3])
        usual = float(np.median(self._log_depths)) if self._log_depths else log_depth
        if math.isfinite(log_depth):
            self._log_depths.append(log_depth)
            if abs(log_depth - usual) > math.log(_JUMP):
                return math.inf
        return off_px

    def _moved_from(self, frame: _PosedFrame) -> tuple[_PosedFrame, _Matches] | None:
        """Return the frame to compare with, and the matches; None where none has enough. Those before it are forgotten.

        Where too little of it is left in sight, the latest frame takes over.
        """
        earlier = [past for past in self._earlier if frame.number - past.number >= _STEP]
        place, matches = 0, self._matches(earlier[0], frame) if earlier else _NO_MATCHES
        if earlier and len(matches.past) < _FEWEST:
            place, matches = len(earlier) - 1, self._matches(earlier[-1], frame)
        if len(matches.past) < _FEWEST:
            return None
        for later in range(place + 1, len(earlier)):
            closer = self._matches(earlier[later], frame)
            if closer.motion_px < _MOTION_PX:
                break
            place, matches = later, closer
        while self._earlier[0] is not earlier[place]:
            self._earlier.popleft()
        return earlier[place], matches

    def _matches(self, past: _PosedFrame, frame: _PosedFrame) -> _Matches:
        points = np.argwhere(past.valid)[:, ::-1]
        points = points[(points % _SPACING_PX == _SPACING_PX // 2).all(1)]
        flows = self._flow.estimate_both(past.rgb, frame.rgb)
        number, pixels = match_corners(points, flows, usable_pixels(frame.valid), _CONSISTENCY_PX)
        return _Matches(points[number], pixels)

    def _compared(self, rays: np.ndarray, pixels: np.ndarray, t_mm: np.ndarray) -> tuple[float, float]:
        """Return how far pixels (n, 2) are from the segments of rays (n, 3), median px, and ln of the implied depth."""
        moved = float(np.linalg.norm(t_mm))
        step = t_mm / moved if moved else t_mm
        nearest = np.full(len(rays), 1 / _NEAREST)
        if step[2] < 0:  # not behind the camera
            nearest = np.minimum(nearest, np.maximum((rays[:, 2] - _LEAST_Z) / -step[2], 0))
        ahead = rays[:, 2] > _LEAST_Z
        far, near = (self._camera.project(r[ahead]) for r in (rays, rays + nearest[:, None] * step))
        seen, along = pixels[ahead], near - far
        if len(seen) < _FEWEST:
            return math.inf, math.nan
        share = np.clip(((seen - far) * along).sum(1) / np.maximum((along**2).sum(1), 1e-12), 0, 1)
        off_px = float(np.median(np.linalg.norm(seen - far - share[:, None] * along, axis=1)))
        parallax = share * np.linalg.norm(along, axis=1)
        if not moved or np.median(parallax) < _LEAST_PARALLAX_PX:
            return off_px, math.nan
        # p x (r + t / z) = 0, least squares.
        p = self._camera.unproject(seen)
        by_far, by_step = np.cross(p, rays[ahead]), np.cross(p, step)
        inverse_depth = -(by_far * by_step).sum(1) / np.maximum((by_step**2).sum(1), 1e-12)
        known = inverse_depth[inverse_depth > 0]
        return off_px, math.log(moved / float(np.median(known))) if len(known) else math.nan


def _until(contradicted: np.ndarray) -> int:
    """Return how many frames (N,) bool come before poses fail, three of five in a row; N where they do not."""
    before = np.concatenate([[0], np.cumsum(contradicted)])
    ends = np.minimum(np.arange(len(contradicted)) + _OF_FRAMES, len(contradicted))
    inside = before[ends] - before[:-1]
    failed = np.flatnonzero(inside >= _FAILED)
    return int(failed[0] + np.argmax(contradicted[failed[0] :])) if len(failed) else len(contradicted)
