"""Relocalisation: finds a lost camera in recent keyframes by features, PnP and alignment from there."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scopemap.config import TrackingSettings
from scopemap.frame import Frame
from scopemap.tracking.features import FeatureDetector, Features, RelativePose, relative_pose_pnp
from scopemap.tracking.residuals import View
from scopemap.tracking.rtdl import Alignment

_MIN_INLIERS = 20
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
