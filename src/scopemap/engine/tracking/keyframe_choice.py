"""KeyframeChoice: when a frame becomes a keyframe because the last one is old or fits badly."""

from __future__ import annotations

import numpy as np

from scopemap.engine.config import TrackingSettings
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import rotation_angle_rad
from scopemap.engine.tracking.rtdl import Alignment

_KEYFRAME_COVERAGE = 0.3  # by hand: a frame in which fewer corners are matched becomes a keyframe
_PATIENCE = 3  # by hand: frames that a keyframe waits longer where the picture is not clear
# A camera that has moved less since the keyframe, rad and translation over depth, needs no other one: its views
# triangulate nothing, and their errors are alike. Chosen on cecum_t1_a (C3VD): 0.02 left out some where it is slow.
_MIN_KEYFRAME_MOTION = 0.01
_CLEAR = 0.8  # by hand: of the best quality since the keyframe: below it the next one waits


class KeyframeChoice:
    """When the next keyframe is due: by frames and motion since the last one, and by how well they still fit it."""

    _first_agreement: float | None = None

    def __init__(self, settings: TrackingSettings) -> None:
        self._settings, self._depth_mm = settings, 1.0
        self.frames_since, self._quality, self._best_quality = 0, 0.0, 0.0

    def see(self, frame: Frame) -> None:
        """Count a frame."""
        self.frames_since += 1
        self._quality, self._best_quality = frame.quality, max(frame.quality, self._best_quality)

    def accept(self, agreement: float) -> None:
        """Take the agreement of a tracked frame with the current keyframe, as `Alignment` has it."""
        if self._first_agreement is None:
            self._first_agreement = agreement

    def change(self, depth_mm: float) -> None:
        """Take another keyframe, of this mean depth, as the current one."""
        self._first_agreement, self._depth_mm = None, depth_mm

    def begin(self) -> None:
        """Begin with a new keyframe."""
        self.frames_since, self._best_quality = 0, 0.0

    def reason(self, alignment: Alignment) -> str:
        """Return why a frame with this alignment should become a keyframe; "" where it need not."""
        settings = self._settings
        waits = settings.keyframes_wait and self._quality < _CLEAR * self._best_quality
        if self.frames_since >= settings.keyframe_every + (_PATIENCE if waits else 0) and self._has_moved(alignment):
            return f"{self.frames_since} frames after the last keyframe"
        if alignment.agreement < settings.min_keyframe_agreement * (self._first_agreement or 0.0):
            return "the keyframe fits less well than at first"
        return "few corners of the keyframe are matched" if alignment.coverage < _KEYFRAME_COVERAGE else ""

    def _has_moved(self, alignment: Alignment) -> bool:
        if not self._settings.keyframes_wait:
            return True
        T = alignment.motion.T_current_reference
        moved = rotation_angle_rad(T[:3, :3]) + np.linalg.norm(T[:3, 3]) / self._depth_mm
        return bool(moved >= _MIN_KEYFRAME_MOTION)
