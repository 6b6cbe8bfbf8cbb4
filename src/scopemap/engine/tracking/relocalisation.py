"""Relocalisation of a lost camera in known keyframes; until then, in a close-up, its rotation is followed."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import TrackingSettings
from scopemap.engine.depth.mapis import DenseCorrespondence
from scopemap.engine.flow.corners import Correspondences2D3D
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, transform
from scopemap.engine.tracking.corner_pose import pose_from_correspondences, reprojection_error_px
from scopemap.engine.tracking.features import (
    FeatureDetector,
    Features,
    RelativePose,
    points_at,
    relative_pose_pnp,
    similarities,
)
from scopemap.engine.tracking.keyframe_alignment import Keyframe
from scopemap.engine.tracking.rtdl import Alignment
from scopemap.engine.tracking.track import Track

_MIN_INLIERS = 20  # by hand: of PnP; 20 match by chance, at most
_STRONGEST = 128  # by hand: descriptors by which keyframes are ranked
_CANDIDATES = 3  # by hand: those that are tried, of either group
_LEAST_SIMILARITY = 3.0  # of keyframes that are tried: in less similar ones of a colonoscopy PnP succeeded once
_MAX_APART = 0.3  # by hand: distance of an earlier keyframe's view, at most, and over that of the current one
_NEARER = 0.7  # by hand
_CLOSE_UP_RANGE = 0.5  # by hand: of the range of ln depth of the keyframe: a frame with less is a close-up
_EVERY_PX = 4  # by hand, for time
_RANGE = (5, 95)  # by hand: percentiles between which the range is measured
# Of flow that supports a rotation: step of its pixels, share of them that is matched, median error over the width.
_FLOW_EVERY_PX = 8  # by hand
_FOLLOWED_COVERAGE = 0.25  # by hand
_FOLLOWED_ERROR = 0.01  # by hand
_DEPTH_SIGMA = 0.2  # by hand: relative standard deviation of depth in a close-up
_MIN_MAP_FRAMES = 5  # by hand: tracked in another map before relocalisation searches it


def is_close_up(frame: Frame, keyframe: Keyframe) -> bool:
    """Return whether a frame's predicted depth hardly varies beside the keyframe's: a close-up without structure."""
    if keyframe.measured or frame.depth_mm is None:
        return False
    return _log_depth_range(frame) < _CLOSE_UP_RANGE * _log_depth_range(keyframe.frame)


def _log_depth_range(frame: Frame) -> float:
    some_mm = np.asarray(frame.depth_mm)[::_EVERY_PX, ::_EVERY_PX][frame.valid[::_EVERY_PX, ::_EVERY_PX]]
    some_mm = some_mm[some_mm > 0]
    return float(np.ptp(np.log(np.percentile(some_mm, _RANGE)))) if some_mm.size else float("nan")


def depth_ratio(keyframe: Keyframe, frame: Frame, T_world_camera: np.ndarray) -> float:
    """Return the median of a keyframe's depth, seen from a frame's pose, over the frame's own; NaN without overlap."""
    some = slice(_EVERY_PX // 2, None, _EVERY_PX)
    points = keyframe.frame.camera.rays[some, some] * np.asarray(keyframe.frame.depth_mm)[some, some, None]
    points = points[keyframe.frame.valid[some, some]].astype(np.float64)
    seen = transform(inverse(T_world_camera) @ keyframe.T_world_camera, points)
    seen = seen[seen[:, 2] > 0]
    pixels, size = frame.camera.project(seen), (frame.camera.width, frame.camera.height)
    inside = ((pixels >= 0) & (pixels < size)).all(1)
    usable_mm = np.where(frame.valid, np.asarray(frame.depth_mm), np.nan)
    own_mm = points_at(pixels[inside], usable_mm, frame.camera)[:, 2]
    ratio = seen[inside, 2] / own_mm
    return float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else float("nan")


def nearer_keyframe(keyframes: Iterable[Frame], T_world_camera: np.ndarray, current: Keyframe) -> Frame | None:
    """Return the keyframe clearly nearer to a view (4, 4), by rad plus translation over depth, or None."""

    def distance(T_world_other: np.ndarray | None) -> float:
        assert T_world_other is not None
        T = inverse(T_world_other) @ T_world_camera
        return float(rotation_angle_rad(T[:3, :3])) + float(np.linalg.norm(T[:3, 3])) / current.depth_mm

    nearest = min(keyframes, key=lambda frame: distance(frame.T_world_camera), default=None)
    if nearest is None or nearest.index == current.frame.index:
        return None
    limit = min(_MAX_APART, _NEARER * distance(current.T_world_camera))
    return nearest if distance(nearest.T_world_camera) <= limit else None


class RotationFollower:
    """Follows the rotation of a lost camera from frame to frame in a close-up; its position is not known.

    In a close-up translation moves the picture as much as rotation does. Predicted depth has a shape there, but no
    scale: PnP of the last frame's points gives the rotation, and a translation that is dropped. Where flow matches
    little, or does not fit, the rotation is lost, too.
    """

    _depth_mm: np.ndarray | None = None
    _rotation: np.ndarray | None = None

    def resume_after(self, track: Track, depth_mm: np.ndarray) -> None:
        """Go on after a frame that was followed before the run was resumed; depth_mm : (h, w), at the flow's size."""
        self._depth_mm = depth_mm
        self._rotation = np.eye(3) if track.status != "lost" else track.rotation

    def follow(self, track: Track, frame: Frame, correspondence: DenseCorrespondence | None) -> Track:
        """Return the track of each frame, in order, with its rotation where it is lost and followed, by raw depth."""
        before_mm, self._depth_mm = self._depth_mm, np.where(frame.valid, np.asarray(frame.depth_mm), np.nan)
        if track.status != "lost":
            self._rotation = np.eye(3)
            return track
        step = None
        if before_mm is not None and correspondence is not None and self._rotation is not None:
            step = rotation_by_flow(before_mm, frame.camera, correspondence)
        self._rotation = None if step is None or self._rotation is None else self._rotation @ step.T
        return replace(track, rotation=self._rotation)


def rotation_by_flow(
    depth_mm: np.ndarray, camera: PinholeCamera, correspondence: DenseCorrespondence
) -> np.ndarray | None:
    """Return R_current_previous (3, 3) by flow and depth (H, W) of any scale, NaN = unknown; None if unsupported."""
    some = slice(_FLOW_EVERY_PX // 2, None, _FLOW_EVERY_PX)
    height, width = depth_mm.shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)[some, some].reshape(-1, 2).astype(float)
    previous = pixels + correspondence.to_previous[some, some].reshape(-1, 2)
    points_mm = points_at(previous, depth_mm, camera)
    matched = correspondence.consistent[some, some].ravel() & np.isfinite(points_mm).all(1)
    found = Correspondences2D3D(points_mm[matched], pixels[matched], float(matched.mean()), 0)
    T = None
    if found.coverage >= _FOLLOWED_COVERAGE:
        T = pose_from_correspondences(found, camera, np.eye(4), _DEPTH_SIGMA)
    if T is None or reprojection_error_px(found, camera, T) > _FOLLOWED_ERROR * width:
        return None
    return T[:3, :3]


class Relocaliser:
    """Recent keyframes of the current map and of other maps, in which a lost camera is searched."""

    def __init__(self, settings: TrackingSettings, detector: FeatureDetector) -> None:
        self.settings, self.detector = settings, detector
        self._keyframes = deque[Keyframe](maxlen=settings.relocalisation_keyframes)
        self._of_other_maps = deque[Keyframe](maxlen=2 * settings.relocalisation_keyframes)
        self._features: dict[int, Features] = {}
        self._frames_of_map = Counter[int]()

    @property
    def keyframes(self) -> list[Keyframe]:
        """The keyframes in which a lost camera is searched."""
        return [*self._keyframes, *self._of_other_maps]

    def add(self, keyframe: Keyframe) -> None:
        """Add a keyframe of the current map."""
        self._keyframes.append(keyframe)

    def count(self, number: int) -> None:
        """Count a tracked frame of a map."""
        self._frames_of_map[number] += 1

    def enter_map(self, number: int) -> None:
        """Make a map the current one; others with few tracked frames are dropped."""
        known, frames = [*self._of_other_maps, *self._keyframes], self._frames_of_map
        self._keyframes.clear()
        self._of_other_maps.clear()
        self._keyframes.extend(keyframe for keyframe in known if keyframe.map == number)
        self._of_other_maps.extend(k for k in known if k.map != number and frames[k.map] >= _MIN_MAP_FRAMES)

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

        The most similar ones are tried, until the keyframe's corners confirm a pose.
        align : returns the alignment with a keyframe from its relative pose by features. near : keyframes
        that are searched in any case. recent : whether the others of the current map are, too. other_maps : whether
        those of other maps are, where none of these is found.
        """
        if self.settings.relocalisation_keyframes == 0:
            return None
        current = self.detector.detect(replace(frame, depth_mm=None))
        kept = {keyframe.frame.index for keyframe in (*self._keyframes, *self._of_other_maps, *near)}
        self._features = {index: known for index, known in self._features.items() if index in kept}
        numbers = {keyframe.frame.index for keyframe in near}
        others = [keyframe for keyframe in self._keyframes if recent and keyframe.frame.index not in numbers]
        for keyframes in ([*near, *others], self._of_other_maps if other_maps else ()):
            found = []
            for keyframe in self._most_similar(keyframes, current):
                relative = relative_pose_pnp(self._known(keyframe), current, frame.camera, _MIN_INLIERS)
                if relative is not None and is_accepted(keyframe, alignment := align(keyframe, relative)):
                    found.append((keyframe, alignment))
                    if alignment.is_supported:
                        break
            if found:
                return max(found, key=lambda pair: (pair[1].is_supported, pair[1].agreement))
        return None

    def _most_similar(self, keyframes: Iterable[Keyframe], current: Features) -> list[Keyframe]:
        """Return the keyframes whose strongest features are most like those of a frame, most similar first."""
        strongest = current.descriptors[:_STRONGEST]
        known = list(keyframes)
        alike = similarities(strongest, [self._known(k).descriptors[:_STRONGEST] for k in known])
        likely = [k for k in np.argsort(-alike, kind="stable") if alike[k] >= _LEAST_SIMILARITY]
        return [known[k] for k in likely[:_CANDIDATES]]

    def _known(self, keyframe: Keyframe) -> Features:
        """Return the features of a keyframe, detected on first use: most clips never need them."""
        index = keyframe.frame.index
        if index not in self._features:
            self._features[index] = self.detector.detect(keyframe.frame)
        return self._features[index]
