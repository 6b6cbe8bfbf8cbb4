"""Relocalisation: finds a lost camera in recent keyframes by SIFT features, PnP and photometric alignment."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scopemap.config import TrackingSettings
from scopemap.frame import Frame
from scopemap.tracking.features import Features, detect_features, relative_pose_pnp
from scopemap.tracking.residuals import View
from scopemap.tracking.rtdl import Alignment, align

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

    @cached_property
    def features(self) -> Features:
        """Features with depth, detected on first use: most clips never need them."""
        return detect_features(self.frame)


class Relocaliser:
    """Recent keyframes of the current map and of other maps, in which a lost camera is searched."""

    def __init__(self, settings: TrackingSettings) -> None:
        self.settings = settings
        self._keyframes: deque[Keyframe] = deque(maxlen=settings.relocalisation_keyframes)
        self._of_other_maps: deque[Keyframe] = deque(maxlen=2 * settings.relocalisation_keyframes)

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
        pyramid: list[View],
        is_accepted: Callable[[Keyframe, Alignment], bool],
        *,
        other_maps: bool,
    ) -> tuple[Keyframe, Alignment] | None:
        """Return the keyframe with the best accepted alignment of a frame, and that alignment; None without any.

        pyramid : of the frame. other_maps : whether other maps are searched where the current one has none.
        """
        if self.settings.relocalisation_keyframes == 0:
            return None
        current = detect_features(replace(frame, depth_mm=None))
        for keyframes in (self._keyframes, self._of_other_maps if other_maps else ()):
            found = []
            for keyframe in keyframes:
                relative = relative_pose_pnp(keyframe.features, current, frame.camera, _MIN_INLIERS)
                if relative is not None:
                    alignment = align(keyframe.pyramid, pyramid, relative.T_current_reference, self.settings)
                    if is_accepted(keyframe, alignment):
                        found.append((keyframe, alignment))
            if found:
                return max(found, key=lambda pair: pair[1].agreement)
        return None
