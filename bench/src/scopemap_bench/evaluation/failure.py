"""Frames until tracking fails, by one criterion for all methods: their poses alone against the flow of the pictures.

The relative pose of two frames lets a point of the first be seen on a segment of the second: from where it would be at
infinity to where it would be at twice the translation. Flow that ends beside these segments contradicts the pose; so
does a missing pose after the first one, and a depth of the scene, as flow and translation imply it, that jumps. What a
method itself calls lost is another figure, `frames_until_loss`. The form and the limits are ours.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.corners import match_corners, usable_pixels
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.geometry.se3 import inverse

LIMITS_PX = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Median distances between flow and the segments above which frames contradict; the criterion is that of `LIMIT_PX`."""
LIMIT_PX = 3.0

# Frames between the two that are compared, and how many in a row must contradict.
_STEP = 5
_IN_A_ROW = 3
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


class FailureMeter:
    """Takes the frames of a sequence with a method's poses, and says how many pass until these are contradicted."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera, self._flow = camera, DisFlow()
        self._before: deque[tuple[np.ndarray, np.ndarray, np.ndarray | None]] = deque(maxlen=_STEP)
        self._log_depths: deque[float] = deque(maxlen=_KEPT)
        self._off_px: list[float] = []
        self._has_begun = False

    def add(self, rgb: np.ndarray, valid: np.ndarray, T_world_camera: np.ndarray | None) -> None:
        """Add the next frame: (H, W, 3) uint8, its usable pixels (H, W) bool, its pose (4, 4) or None."""
        past = self._before[0] if self._before else None
        self._has_begun |= T_world_camera is not None
        self._off_px.append(math.inf if self._has_begun and T_world_camera is None else 0.0)
        if past is not None and past[2] is not None and T_world_camera is not None:
            self._off_px[-1] = self._off((past[0], rgb), (past[1], valid), inverse(T_world_camera) @ past[2])
        self._before.append((rgb, valid, T_world_camera))

    def figures(self) -> dict[str, int]:
        """Return frames_until_contradicted, and _at_N_px for each of `LIMITS_PX`; all frames where none is."""
        off_px = np.array(self._off_px) if self._has_begun else np.full(len(self._off_px), math.inf)
        counts = {limit: _until(off_px > limit) for limit in LIMITS_PX}
        name = "frames_until_contradicted"
        return {name: counts[LIMIT_PX]} | {f"{name}_at_{limit:g}_px": count for limit, count in counts.items()}

    def _off(self, rgb: tuple[np.ndarray, ...], valid: tuple[np.ndarray, ...], T_now_past: np.ndarray) -> float:
        """Return how far flow is from the segments, median, px; infinite where depth jumps, 0 where too few tell.

        rgb, valid : of the past frame and of this one.
        """
        points = np.argwhere(valid[0])[:, ::-1]
        points = points[(points % _SPACING_PX == _SPACING_PX // 2).all(1)]
        flows = self._flow.estimate_both(*rgb)
        number, pixels = match_corners(points, flows, usable_pixels(valid[1]), _CONSISTENCY_PX)
        if len(number) < _FEWEST:
            return 0.0
        rays = self._camera.unproject(points[number].astype(float)) @ T_now_past[:3, :3].T
        off_px, log_depth = self._compared(rays, pixels, T_now_past[:3, 3])
        usual = float(np.median(self._log_depths)) if self._log_depths else log_depth
        if math.isfinite(log_depth):
            self._log_depths.append(log_depth)
            if abs(log_depth - usual) > math.log(_JUMP):
                return math.inf
        return off_px

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
    """Return how many frames (N,) bool come before the first three in a row; N where there are none."""
    if not len(contradicted):
        return 0
    in_a_row = np.convolve(contradicted, np.ones(_IN_A_ROW, int)) == _IN_A_ROW
    return int(np.argmax(in_a_row)) - _IN_A_ROW + 1 if in_a_row.any() else len(contradicted)
