"""The pose of a frame relative to a keyframe, by corners or photometrically, and whether it is accepted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scopemap.engine.config import TrackingSettings
from scopemap.engine.flow.corners import KeyframeMatcher
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, mean_near, orthonormalised, rotation_angle_rad
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.corner_pose import nonrigidity, pose_from_correspondences, reprojection_error_px
from scopemap.engine.tracking.features import RelativePose
from scopemap.engine.tracking.pyramid import build_pyramid
from scopemap.engine.tracking.residuals import PyramidLevel
from scopemap.engine.tracking.rtdl import Alignment, Motion, align, judge, least_correlation
from scopemap.engine.tracking.track import TrackingLoss

MIN_TEXTURE = 0.5  # measured: noise has 0.32, a wall that is touched up to 0.45, tissue 0.65 and more
"""Of an image; below it nothing but noise is shown."""
MIN_SHARPNESS = 0.6  # by hand, for smoke and blur
"""Share of the recent frames' median sharpness below which a frame that also fits its keyframe badly is lost."""
_MIN_INLIER_SHARE = 0.4  # measured: unrelated fine texture has 0.37
_MAX_STEP = 0.5  # by hand: largest motion between frames: rad, and mm over mean depth
MAX_EXTRAPOLATION = 5  # by hand
"""Frames for which the last motion is extrapolated after a loss."""
# By hand: below it an unsharp frame is lost, unless so many features match: by chance 20 at most.
_DOUBTFUL_INLIER_SHARE = 0.6
_CLEAR_MATCHES = 40  # by hand: features that do not match by chance
_MIN_COVERAGE = 0.1  # by hand: of the keyframe's corners that must be matched for them to support a pose
_MAX_SUPPORT_PX = 2.0  # by hand: median reprojection error of a supported pose


@dataclass(frozen=True)
class Keyframe:
    """A frame with depth that later frames are aligned to.

    frame : with `depth_mm`. T_world_camera : (4, 4), in the world of its map. pyramid : of the frame, with depth.
    depth_mm : mean depth. measured : whether the depth is measured, not predicted. map : number of its map.
    """

    frame: Frame
    T_world_camera: np.ndarray
    pyramid: list[PyramidLevel]
    depth_mm: float
    measured: bool
    map: int

    def pose_by(self, alignment: Alignment) -> np.ndarray:
        """Return T_world_camera (4, 4) of the frame that was aligned."""
        T = self.T_world_camera @ inverse(alignment.motion.T_current_reference)
        # Errors of rotation matrices would double from keyframe to keyframe.
        return orthonormalised(T) if np.isfinite(T).all() else T


class MotionModel:
    """Constant motion: the pose tracked last, (4, 4) in the world of `map`, the step to it, frames lost since."""

    def __init__(self) -> None:
        self.map, self._maps, self.frames_lost = 0, 1, 0
        self.T_world_last, self._T_step = np.eye(4), np.eye(4)

    def predictions(self) -> list[np.ndarray]:
        """Return first guesses of T_world_camera: the last pose; after a loss also the extrapolated one."""
        if not self.frames_lost:
            return [self.T_world_last]
        steps = min(1 + self.frames_lost, MAX_EXTRAPOLATION)
        return [self.T_world_last, self.T_world_last @ np.linalg.matrix_power(self._T_step, steps)]

    def follow(self, T_world_camera: np.ndarray) -> None:
        """Go on from a pose (4, 4); the step since the last one is shared among the frames lost between."""
        T_step = inverse(self.T_world_last) @ T_world_camera
        self._T_step = mean_near(np.eye(4), [T_step], [1 / (1 + self.frames_lost)])
        self.T_world_last, self.frames_lost = T_world_camera, 0

    def enter_map(self, number: int, T_world_camera: np.ndarray) -> None:
        """Go on from a pose in the world of another map."""
        self.map, self.T_world_last = number, T_world_camera

    def begin_map(self) -> None:
        """Begin a new map, in whose world the camera is at the origin."""
        self.enter_map(self._maps, np.eye(4))
        self._maps += 1
        self._T_step, self.frames_lost = np.eye(4), 0


class KeyframeAligner:
    """Aligns frames with keyframes: by the keyframe's corners, else photometrically (`rtdl.py`).

    flow : matches the corners; None: they are not used. motion : where alignments start, and from where a pose may not
    jump.
    """

    def __init__(self, settings: TrackingSettings, flow: FlowEstimator | None, motion: MotionModel) -> None:
        self._settings, self.flow, self._motion = settings, flow, motion
        with_corners = flow is not None and flow.name != "none" and settings.corner_depth_sigma > 0
        self._matcher = KeyframeMatcher(flow) if flow is not None and with_corners else None

    def has_corners(self, keyframe: Keyframe) -> bool:
        """Return whether frames are aligned by corners of a keyframe; measured depth aligns better by itself."""
        return self._matcher is not None and not keyframe.measured

    def set_keyframe(
        self, keyframe: Keyframe, frame: Frame | None = None, T_frame_keyframe: np.ndarray | None = None
    ) -> None:
        """Detect the corners of a keyframe. frame, T_frame_keyframe : as `KeyframeMatcher.set_keyframe` takes them."""
        if self._matcher is not None:
            self._matcher.set_keyframe(keyframe.frame if self.has_corners(keyframe) else None, frame, T_frame_keyframe)

    def align(self, keyframe: Keyframe, frame: Frame) -> tuple[Alignment, list[PyramidLevel] | None]:
        """Return the alignment by corners, else the photometric one, and the frame's pyramid where it was needed.

        Where corners fail and features are searched next, predicted poses are judged, and only good ones are aligned.
        """
        by_corners = self.by_corners(keyframe, frame, inverse(self._motion.T_world_last) @ keyframe.T_world_camera)
        if by_corners is not None and self.rejection(keyframe, by_corners) is None:
            return by_corners, None
        pyramid, predicted = self.pyramid(keyframe, frame), self._motion.predictions()
        starts = [inverse(T) @ keyframe.T_world_camera for T in predicted]
        if not self._settings.photometry.from_previous and len(starts) == 1:
            starts = [np.eye(4)]
        searched = self.has_corners(keyframe) and self._settings.relocalisation_keyframes > 0
        found = []
        for T_start in starts:
            judged = judge(keyframe.pyramid, pyramid, Motion(T_start, np.array([1.0, 0.0])))
            if not searched or self.rejection(keyframe, judged) is None:
                judged = align(keyframe.pyramid, pyramid, T_start, self._settings)
            found.append(judged)
        best = max(found, key=lambda alignment: alignment.agreement)
        return (best if by_corners is None else replace(best, coverage=by_corners.coverage)), pyramid

    def align_from(
        self, keyframe: Keyframe, frame: Frame, pyramid: list[PyramidLevel], relative: RelativePose
    ) -> Alignment:
        """Return the alignment from the pose by features: by corners, else photometric; pyramid : of the frame."""
        T_start, matches = relative.T_current_reference, len(relative.pairs)
        if self.has_corners(keyframe):
            self.set_keyframe(keyframe, frame, T_start)
            by_corners = self.by_corners(keyframe, frame, T_start)
            if by_corners is not None and self.rejection(keyframe, by_corners) is None:
                return replace(by_corners, matches=matches)
        return replace(align(keyframe.pyramid, pyramid, T_start, self._settings), matches=matches)

    def by_corners(self, keyframe: Keyframe, frame: Frame, T_start: np.ndarray) -> Alignment | None:
        """Return the alignment by the corners of the keyframe that was set last; None where too few are matched."""
        correspondences = None if self._matcher is None else self._matcher.match(frame)
        if correspondences is None:
            return None
        depth_sigma = self._settings.corner_depth_sigma
        T = pose_from_correspondences(correspondences, frame.camera, T_start, depth_sigma)
        if T is None:
            return None
        finest = build_pyramid(replace(frame, depth_mm=None), self._settings, levels=1)
        error_px = reprojection_error_px(correspondences, frame.camera, T)
        return replace(
            judge(keyframe.pyramid, finest, Motion(T, np.array([1.0, 0.0]))),
            is_supported=correspondences.coverage >= _MIN_COVERAGE and error_px <= _MAX_SUPPORT_PX,
            coverage=correspondences.coverage,
            nonrigidity=nonrigidity(correspondences, frame.camera, T, depth_sigma),
        )

    def pyramid(self, keyframe: Keyframe, frame: Frame) -> list[PyramidLevel]:
        """Return the pyramid of a frame that is aligned to a keyframe."""
        # The keyframe's points are moved: the frame's own depth counts only if it is measured.
        return build_pyramid(frame if keyframe.measured else replace(frame, depth_mm=None), self._settings)

    def rejection(self, keyframe: Keyframe, alignment: Alignment) -> TrackingLoss | None:
        """Return why an alignment is rejected, or None."""
        T_world_camera, settings = keyframe.pose_by(alignment), self._settings
        if not np.isfinite(T_world_camera).all():
            return TrackingLoss(LossCause.VIEW_CHANGED, "the alignment diverged")
        if alignment.overlap < self._settings.min_valid_share:
            return TrackingLoss(LossCause.VIEW_CHANGED, f"overlap {alignment.overlap:.0%} with the keyframe")
        if settings.pose_checks and alignment.inlier_share < _MIN_INLIER_SHARE and not alignment.is_supported:
            return TrackingLoss(LossCause.VIEW_CHANGED, f"inlier share {alignment.inlier_share:.0%} with the keyframe")
        # Measured depth constrains a pose by shape alone.
        by_shape, least = keyframe.measured and settings.photometry.depth_weight > 0, least_correlation(settings)
        if alignment.correlation < least and not by_shape:
            if alignment.texture < MIN_TEXTURE:
                return TrackingLoss(LossCause.NO_TEXTURE, "weakly constrained, too little texture")
            # A supported pose may be a pixel off, which decorrelates fine texture.
            if alignment.correlation < least / 3 or not alignment.is_supported:
                return TrackingLoss(
                    LossCause.VIEW_CHANGED, f"correlation {alignment.correlation:.2f} with the keyframe"
                )
        # A cut may turn the view by any angle.
        if keyframe.map != self._motion.map or alignment.matches >= _CLEAR_MATCHES:
            return None
        T_step = inverse(self._motion.T_world_last) @ T_world_camera
        rotation_rad = float(rotation_angle_rad(T_step[:3, :3]))
        translation = float(np.linalg.norm(T_step[:3, 3])) / keyframe.depth_mm
        if settings.pose_checks and max(rotation_rad, translation) > _MAX_STEP * (1 + self._motion.frames_lost):
            jump = f"jump of {np.degrees(rotation_rad):.0f} deg and {translation:.2f} mean depths"
            return TrackingLoss(LossCause.VIEW_CHANGED, jump)
        return None


def is_obscured(sharpness: float, alignment: Alignment, least: float) -> bool:
    """Return whether an image, by its `sharpness` over the usual one, is too unsharp for a reliable alignment."""
    # Pixels of smoke fit smoke; its features match by chance alone. Below half of it neither is evidence.
    is_evident = alignment.inlier_share >= _DOUBTFUL_INLIER_SHARE or alignment.matches >= _CLEAR_MATCHES
    return sharpness < (least / 2 if is_evident else least)
