"""Keyframes that are known: a lost camera is found again in them by features, PnP and alignment from there."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scopemap.config import TrackingSettings
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap.tracking.features import FeatureDetector, Features, RelativePose, relative_pose_pnp
from scopemap.tracking.residuals import View
from scopemap.tracking.rtdl import Alignment

_MIN_INLIERS = 20
_PASSED_KEYFRAMES = 64
_MAX_APART, _NEARER = 0.3, 0.7  # distance of a passed keyframe's view, at most, and over that of the current one
_MIN_MAP_FRAMES = 5  # tracked in another map before relocalisation searches it


@dataclass(frozen=True)
class Keyframe:
    """A frame with depth that later frames are aligned to.

    Attributes
    ----------
    frame : with `depth_mm`. T_world_camera : (4, 4), in the world of its map. pyramid : of the frame, with depth.
    depth_mm : mean depth. measured : whether the depth is measured, not predicted. map : number of its map.
    """

    frame: Frame
    T_world_camera: np.ndarray
    pyramid: list[View]
    depth_mm: float
    measured: bool
    map: int


class PassedKeyframes:
    """Earlier keyframes of the current map, 64 at most, that the camera may come back to."""

    def __init__(self) -> None:
        self._frames: deque[Frame] = deque(maxlen=_PASSED_KEYFRAMES)

    def add(self, frame: Frame) -> None:
        """Add a keyframe with its pose and its depth."""
        self._frames.append(replace(frame, depth_sigma_mm=None))

    def clear(self) -> None:
        """Forget them: the world is another one."""
        self._frames.clear()

    def nearer(self, T_world_camera: np.ndarray, current: Keyframe) -> Frame | None:
        """Return the keyframe nearest to a view (4, 4), where it is clearly nearer than the current one; else None.

        The distance of two views is the turn, rad, plus the way over the scene's depth.
        """

        def distance(T_world_other: np.ndarray | None) -> float:
            assert T_world_other is not None
            T = inverse(T_world_other) @ T_world_camera
            return float(rotation_angle_rad(T[:3, :3])) + float(np.linalg.norm(T[:3, 3])) / current.depth_mm

        nearest = min(self._frames, key=lambda frame: distance(frame.T_world_camera), default=None)
        if nearest is None or nearest.index == current.frame.index:
            return None
        limit = min(_MAX_APART, _NEARER * distance(current.T_world_camera))
        return nearest if distance(nearest.T_world_camera) <= limit else None


class Relocaliser:
    """Recent keyframes of the current map and of other maps, in which a lost camera is searched."""

    def __init__(self, settings: TrackingSettings, detector: FeatureDetector) -> None:
        self.settings, self._detector = settings, detector
        self._keyframes: deque[Keyframe] = deque(maxlen=settings.relocalisation_keyframes)
        self._of_other_maps: deque[Keyframe] = deque(maxlen=2 * settings.relocalisation_keyframes)
        self._features: dict[int, Features] = {}

    def add(self, keyframe: Keyframe) -> None:
        """Add a keyframe of the current map."""
        self._keyframes.append(keyframe)

    def enter_map(self, number: int, frames: Counter[int]) -> None:
        """Make a map the current one; `frames` counts the tracked frames per map, and maps of few are dropped."""
        known = [*self._of_other_maps, *self._keyframes]
        self._keyframes.clear()
        self._of_other_maps.clear()
        self._keyframes.extend(keyframe for keyframe in known if keyframe.map == number)
        self._of_other_maps.extend(
            keyframe for keyframe in known if keyframe.map != number and frames[keyframe.map] >= _MIN_MAP_FRAMES
        )

    def find(
        self,
        frame: Frame,
        align: Callable[[Keyframe, RelativePose], Alignment],
        is_accepted: Callable[[Keyframe, Alignment], bool],
        *,
        near: Sequence[Keyframe],
        recent: bool,
        other_maps: bool,
    ) -> tuple[Keyframe, Alignment] | None:
        """Return the keyframe with the best accepted alignment of a frame, and that alignment; None without any.

        align : returns the alignment with a keyframe from its relative pose by features. near : keyframes
        that are searched in any case. recent : whether those of the current map are, too. other_maps : whether those of
        other maps are, where none of these is found.
        """
        if self.settings.relocalisation_keyframes == 0:
            return None
        current = self._detector.detect(replace(frame, depth_mm=None))
        own = {keyframe.frame.index: keyframe for keyframe in (*(self._keyframes if recent else ()), *near)}
        groups = [own.values(), self._of_other_maps if other_maps else ()]
        searched = {keyframe.frame.index for group in groups for keyframe in group}
        self._features = {index: known for index, known in self._features.items() if index in searched}
        for keyframes in groups:
            found = []
            for keyframe in keyframes:
                relative = relative_pose_pnp(self._known(keyframe), current, frame.camera, _MIN_INLIERS)
                if relative is not None:
                    alignment = align(keyframe, relative)
                    if is_accepted(keyframe, alignment):
                        found.append((keyframe, alignment))
            if found:
                return max(found, key=lambda pair: pair[1].agreement)
        return None

    def _known(self, keyframe: Keyframe) -> Features:
        """Return the features of a keyframe, detected on first use: most clips never need them."""
        index = keyframe.frame.index
        if index not in self._features:
            self._features[index] = self._detector.detect(keyframe.frame)
        return self._features[index]
