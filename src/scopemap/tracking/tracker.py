"""Tracker: estimates the pose of every frame against the keyframe, and reports why where it cannot."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from scopemap.config import TrackingSettings
from scopemap.flow.corners import KeyframeMatcher
from scopemap.flow.estimator import FlowEstimator
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse, mean_near, orthonormalised
from scopemap.tracking.acceptance import MIN_TEXTURE, LastPose, is_obscured, rejection
from scopemap.tracking.features import FeatureDetector, RelativePose, SiftFeatures
from scopemap.tracking.pyramid import build_pyramid
from scopemap.tracking.relocalisation import EarlierKeyframes, Keyframe, Relocaliser, depth_ratio, is_close_up
from scopemap.tracking.reprojection import nonrigidity, pose_from_correspondences, reprojection_error_px
from scopemap.tracking.residuals import View
from scopemap.tracking.rtdl import Alignment, Motion, align, judge
from scopemap.tracking.sharpness import SharpnessMonitor
from scopemap.tracking.track import FrameTracker, Status, Track, TrackingLoss, unusable
from scopemap.trajectory.causes import LossCause

_MAX_EXTRAPOLATION = 5  # frames for which the last motion is extrapolated after a loss
_FOUND_OVERLAP = 0.25  # with the keyframe in which features find a frame: with less the pose hangs on a corner of it
_MIN_COVERAGE = 0.1  # of the keyframe's corners that must be matched for them to support a pose
_WEAK_COVERAGE = 0.15  # of a pose that is compared with one by features
_KEYFRAME_COVERAGE = 0.3  # a frame in which fewer are matched becomes a keyframe
_REVISITED_COVERAGE = 0.5  # of an earlier keyframe's corners that must be matched for it to be tracked against again
_CLEAR, _PATIENCE = 0.8, 3  # of the best quality since the keyframe: below it the next one waits so many frames more
_MAX_SUPPORT_PX = 2.0  # median reprojection error of a supported pose
_UNCONFIRMED = "no features confirm the pose after a wall filled the picture"


class Tracker(FrameTracker):
    """Tracks frames against keyframes.

    The first usable frame fixes the world. The pose is the one of the least reprojection error of the keyframe's
    corners, matched by `flow`; it is judged photometrically. Where it is rejected, where too few corners are matched,
    and where the keyframe's depth is measured, the pose comes from photometric alignment (METHOD section WEMA-RTDL).
    A lost frame is recorded with the reason; the next one is aligned from the last pose, from the extrapolated one, and
    relocalised in recent keyframes. After several sharp frames lost in a row a new map begins, with its own world;
    later relocalisation may lead back to an older map.
    """

    def __init__(
        self, settings: TrackingSettings, flow: FlowEstimator | None = None, features: FeatureDetector | None = None
    ) -> None:
        self.settings = settings
        with_corners = flow is not None and flow.name != "none" and settings.advanced.corner_depth_sigma > 0
        self._matcher = KeyframeMatcher(flow) if flow is not None and with_corners else None
        self._relocaliser = Relocaliser(settings, features or SiftFeatures())
        self._sharpness = SharpnessMonitor()
        self._keyframe: Keyframe | None = None
        self._last: Frame | None = None
        self._T_world_last = np.eye(4)
        self._T_step = np.eye(4)
        self._frames_since_keyframe = 0
        self._frames_lost = self._sharp_frames_lost = 0
        self._agreement: list[float] = []
        self._is_unsharp = self._after_close_up = False
        self._quality = self._best_quality = 0.0
        self._coverage = 1.0
        self._earlier_keyframes = EarlierKeyframes()
        self._is_revisited = False
        self._map, self._map_count = 0, 1
        self._frames_of_map: Counter[int] = Counter()

    def track(self, frame: Frame) -> Track:
        """Return the frame's pose relative to the first usable frame of its map, or the reason why there is none."""
        self._frames_since_keyframe += 1
        self._quality, self._best_quality = frame.quality, max(frame.quality, self._best_quality)
        usable = float(frame.valid.mean())
        if usable < self.settings.min_valid_share:
            self._sharp_frames_lost = 0
            return replace(self._lost(frame, unusable(frame)), usable=usable)
        sharpness = self._sharpness.relative_sharpness(frame.rgb, frame.valid)
        return replace(self._track(frame, sharpness), usable=usable, sharpness=sharpness)

    def _track(self, frame: Frame, sharpness: float) -> Track:
        self._is_unsharp = sharpness < self.settings.min_sharpness
        unsharp = TrackingLoss(LossCause.UNSHARP, f"only {sharpness:.0%} of the usual sharpness: blur, smoke or fluid")
        if self._keyframe is None:
            if self._is_unsharp:
                return self._lost(frame, unsharp)
            return Track(frame.index, "initial", "first frame of the map", np.eye(4), frame.index, map=self._map)
        if self._frames_lost > _MAX_EXTRAPOLATION and self._frames_lost % self.settings.search_every:
            self._sharp_frames_lost += not self._is_unsharp
            skipped = f"not searched: one of {self.settings.search_every} lost frames is"
            return self._lost(frame, TrackingLoss(LossCause.OTHER, skipped))
        alignment, pyramid = self._align(self._keyframe, frame)
        if (
            self._is_due([alignment.agreement])
            and not self._frames_lost
            and not self._rejection(self._keyframe, alignment)
        ):
            alignment = self._against_earlier_keyframe(frame, alignment)
        obscured = is_obscured(sharpness, alignment, self.settings.min_sharpness)
        rejected, relocalised = self._rejection(self._keyframe, alignment), False
        failed, is_weak = obscured or bool(rejected), self._coverage < _WEAK_COVERAGE
        if failed and is_close_up(frame, self._keyframe):
            self._after_close_up, unsharp, rejected = True, _in_contact(unsharp), rejected and _in_contact(rejected)
        elif self._after_close_up and not failed and self.settings.relocalisation_keyframes:
            failed, rejected = True, TrackingLoss(LossCause.VIEW_CHANGED, _UNCONFIRMED)
        if failed or is_weak or self._frames_lost:
            found = self._found(frame, pyramid, sharpness, failed=failed)
            if found is not None and (failed or found[1].agreement > alignment.agreement):
                relocalised = found[0].map != self._map or self._frames_lost > 0
                obscured, rejected = False, None
                alignment = self._aligned_to(*found)
        if obscured:
            self._sharp_frames_lost = 0
            return self._lost(frame, unsharp, alignment)
        if rejected:
            self._sharp_frames_lost += 1
            after = self.settings.new_map_after * (2 if self._after_close_up else 1)
            if self._sharp_frames_lost > after > 0 and not self._is_unsharp:
                return self._new_map(frame)
            return self._lost(frame, rejected._replace(reason=f"rejected: {rejected.reason}"), alignment)
        return self._accept(frame, self._keyframe, alignment, relocalised)

    def remember(self, frame: Frame) -> bool:
        """Take the frame that was tracked last, with its refined depth and its pose: the next may be matched with it.

        Where tissue moves further than flow follows, features still match successive frames. `Track.keyframe` is then
        the number of this frame, which is a keyframe from there on.
        """
        self._last = None if self._is_unsharp else frame
        return True

    def another(self) -> Tracker:
        """Return a tracker with the same parts that has seen no frame."""
        flow = None if self._matcher is None else self._matcher.flow
        return Tracker(self.settings, flow, self._relocaliser.detector)

    def needs_keyframe(self) -> bool:
        """Return whether the frame that was tracked last should become a keyframe."""
        if self._keyframe is None:
            return True
        # The depth of an unsharp frame is no better than its image.
        return (self._is_revisited or self._is_due(self._agreement[-1:])) and not self._is_unsharp

    def _is_due(self, agreement: list[float]) -> bool:
        """Whether a frame with this agreement, [] where it is not known, should become a keyframe."""
        patience = _PATIENCE if self._quality < _CLEAR * self._best_quality else 0
        is_old = self._frames_since_keyframe >= self.settings.keyframe_every + patience
        least = self.settings.advanced.min_keyframe_agreement
        fits_worse = bool(agreement and self._agreement) and agreement[-1] < least * self._agreement[0]
        return is_old or fits_worse or self._coverage < _KEYFRAME_COVERAGE

    def insert_keyframe(self, frame: Frame, *, measured: bool) -> bool:
        """Make a tracked frame, with its depth, the keyframe; False, and nothing changes, where its depth is unknown.

        measured : whether the depth is measured, not predicted; only then tangent planes are taken from it.
        """
        if frame.depth_mm is None or frame.T_world_camera is None:
            raise ValueError("a keyframe needs a depth and a pose")
        if self._is_revisited:
            self._is_revisited, self._frames_since_keyframe = False, 0
            return True
        keyframe = self._keyframe_of(frame, measured)
        if keyframe is None:
            return False
        self._use_keyframe(keyframe)
        self._relocaliser.add(keyframe)
        self._earlier_keyframes.add(frame)
        self._frames_since_keyframe, self._best_quality = 0, 0.0
        return True

    def _against_earlier_keyframe(self, frame: Frame, alignment: Alignment) -> Alignment:
        """Return the alignment with an earlier keyframe where one is nearer than the current one, which it replaces.

        Errors of poses and scale since then are gone: a camera that goes to and fro does not drift on and on.
        """
        current = self._keyframe
        assert current is not None
        self._is_revisited = False
        if self._matcher is None or current.measured:
            return alignment
        T_world_camera = _T_world_camera(current, alignment)
        nearest = self._earlier_keyframes.nearer(T_world_camera, current)
        keyframe = None if nearest is None else self._keyframe_of(nearest, current.measured)
        if keyframe is None:
            return alignment
        T_start, coverage = inverse(T_world_camera) @ keyframe.T_world_camera, self._coverage
        self._matcher.set_keyframe(keyframe.frame, frame, T_start)
        found = self._align_by_corners(keyframe, frame, T_start)
        if found is None or self._coverage < _REVISITED_COVERAGE or not self._is_accepted(keyframe, found):
            self._matcher.set_keyframe(current.frame)
            self._coverage = coverage
            return alignment
        self._use_keyframe(keyframe)
        self._is_revisited = True
        return found

    def _keyframe_of(self, frame: Frame, measured: bool) -> Keyframe | None:
        """Return a keyframe of the current map; None where too little of the frame's depth is known."""
        assert frame.depth_mm is not None
        assert frame.T_world_camera is not None
        known = frame.valid & np.isfinite(frame.depth_mm)
        if known.mean() < self.settings.min_valid_share:
            return None
        pyramid = build_pyramid(frame, self.settings, use_slope=measured)
        mean_mm = float(frame.depth_mm[known].mean())
        return Keyframe(frame, frame.T_world_camera, pyramid, mean_mm, measured, self._map)

    def _found(
        self, frame: Frame, pyramid: list[View] | None, sharpness: float, *, failed: bool
    ) -> tuple[Keyframe, Alignment] | None:
        """Return the keyframe in which features find a frame, and its accepted alignment; None without any.

        failed : whether the alignment without features failed; then all maps are searched. After a loss the current one
        is, else the keyframe and the frame tracked last.
        """
        assert self._keyframe is not None
        views, coverage = pyramid or self._pyramid(self._keyframe, frame), self._coverage
        near = [self._keyframe]
        if self._last is not None and self._last.index != self._keyframe.frame.index:
            last = self._keyframe_of(self._last, self._keyframe.measured)
            near += [] if last is None else [last]
        found = self._relocaliser.find(
            frame,
            lambda keyframe, relative: self._align_from(keyframe, frame, views, relative),
            lambda keyframe, alignment: (
                self._is_accepted(keyframe, alignment)
                and alignment.overlap >= _FOUND_OVERLAP
                # Of many keyframes one always fits a wall without texture.
                and (keyframe.measured or alignment.texture >= MIN_TEXTURE)
                and not is_obscured(sharpness, alignment, self.settings.min_sharpness)
            ),
            near=near,
            recent=failed or self._frames_lost > 0,
            other_maps=failed,
        )
        if self._matcher is not None and not self._keyframe.measured:
            self._matcher.set_keyframe(self._keyframe.frame)
        self._coverage = coverage
        return found

    def _aligned_to(self, keyframe: Keyframe, alignment: Alignment) -> Alignment:
        """Make the keyframe in which a frame was found the current one; return its alignment."""
        if self._last is not None and keyframe.frame.index == self._last.index:
            self._relocaliser.add(keyframe)
            self._frames_since_keyframe = 1
        self._use_keyframe(keyframe)
        self._coverage = 0.0  # tracking by flow alone has failed: a keyframe is due
        return alignment

    def _use_keyframe(self, keyframe: Keyframe) -> None:
        self._keyframe, self._last, self._agreement = keyframe, None, []
        if self._matcher is not None:
            # Measured depth tracks better by itself than flow over wide gaps.
            self._matcher.set_keyframe(None if keyframe.measured else keyframe.frame)

    def _align(self, keyframe: Keyframe, frame: Frame) -> tuple[Alignment, list[View] | None]:
        """Return the pose by corners, else by photometric alignment, and the frame's pyramid where it was needed."""
        self._coverage = 1.0
        T_start = inverse(self._T_world_last) @ keyframe.T_world_camera
        by_corners = self._align_by_corners(keyframe, frame, T_start)
        if by_corners is not None and self._is_accepted(keyframe, by_corners):
            return by_corners, None
        pyramid = self._pyramid(keyframe, frame)
        starts = [inverse(T) @ keyframe.T_world_camera for T in self._start_poses(keyframe)]
        found = [align(keyframe.pyramid, pyramid, start, self.settings) for start in starts]
        return max(found, key=lambda alignment: alignment.agreement), pyramid

    def _align_from(self, keyframe: Keyframe, frame: Frame, pyramid: list[View], relative: RelativePose) -> Alignment:
        """Return the pose from the one by features: by corners, their flow searched from there, else photometric."""
        T_start, matches = relative.T_current_reference, len(relative.pairs)
        if self._matcher is not None and not keyframe.measured:
            self._matcher.set_keyframe(keyframe.frame, frame, T_start)
            by_corners = self._align_by_corners(keyframe, frame, T_start)
            if by_corners is not None and self._is_accepted(keyframe, by_corners):
                return replace(by_corners, matches=matches)
        return replace(align(keyframe.pyramid, pyramid, T_start, self.settings), matches=matches)

    def _align_by_corners(self, keyframe: Keyframe, frame: Frame, T_start: np.ndarray) -> Alignment | None:
        correspondences = None if self._matcher is None else self._matcher.match(frame)
        if correspondences is None:
            return None
        depth_sigma = self.settings.advanced.corner_depth_sigma
        T = pose_from_correspondences(correspondences, frame.camera, T_start, depth_sigma)
        if T is None:
            return None
        finest = build_pyramid(replace(frame, depth_mm=None), self.settings, levels=1)
        alignment = judge(keyframe.pyramid, finest, Motion(T, np.array([1.0, 0.0])))
        self._coverage = correspondences.coverage
        error_px = reprojection_error_px(correspondences, frame.camera, T)
        is_supported = correspondences.coverage >= _MIN_COVERAGE and error_px <= _MAX_SUPPORT_PX
        moving = nonrigidity(correspondences, frame.camera, T, depth_sigma)
        return replace(alignment, is_supported=is_supported, nonrigidity=moving)

    def _pyramid(self, keyframe: Keyframe, frame: Frame) -> list[View]:
        # The keyframe's points are moved: the frame's own depth counts only if it is measured.
        return build_pyramid(frame if keyframe.measured else replace(frame, depth_mm=None), self.settings)

    def _start_poses(self, keyframe: Keyframe) -> list[np.ndarray]:
        """First guesses of T_world_camera: the last pose; after a loss also the extrapolated one."""
        if self._frames_lost:
            steps = min(1 + self._frames_lost, _MAX_EXTRAPOLATION)
            return [self._T_world_last, self._T_world_last @ np.linalg.matrix_power(self._T_step, steps)]
        return [keyframe.T_world_camera if self.settings.paper.start == "identity" else self._T_world_last]

    def _is_accepted(self, keyframe: Keyframe, alignment: Alignment) -> bool:
        return not self._rejection(keyframe, alignment)

    def _rejection(self, keyframe: Keyframe, alignment: Alignment) -> TrackingLoss | None:
        """Return why a pose is rejected, or None."""
        last = LastPose(self._map, self._T_world_last, self._frames_lost)
        return rejection(keyframe, alignment, _T_world_camera(keyframe, alignment), last, self.settings)

    def _accept(self, frame: Frame, keyframe: Keyframe, alignment: Alignment, relocalised: bool) -> Track:
        T_world_camera = _T_world_camera(keyframe, alignment)
        if keyframe.map != self._map:
            # The last pose is in another world.
            self._enter_map(keyframe.map)
            self._T_world_last = T_world_camera
        ratio = depth_ratio(keyframe, frame, T_world_camera) if self._after_close_up else float("nan")
        self._after_close_up = False
        T_step = inverse(self._T_world_last) @ T_world_camera
        # After lost frames the step is that of several: its share of one.
        self._T_step = mean_near(np.eye(4), [T_step], [1 / (1 + self._frames_lost)])
        self._T_world_last, self._frames_lost, self._sharp_frames_lost = T_world_camera, 0, 0
        self._frames_of_map[self._map] += 1
        self._agreement.append(alignment.agreement)
        reason = "relocalised" if relocalised else ""
        track = _track_of(frame.index, "ok", reason, T_world_camera, keyframe, alignment)
        return replace(track, depth_ratio=ratio, relocalised=relocalised)

    def _lost(self, frame: Frame, loss: TrackingLoss, alignment: Alignment | None = None) -> Track:
        self._frames_lost += 1
        if self._keyframe is None or alignment is None:
            keyframe = self._keyframe.frame.index if self._keyframe else frame.index
            track = Track(frame.index, "lost", loss.reason, self._T_world_last, keyframe, map=self._map)
        else:
            track = _track_of(frame.index, "lost", loss.reason, self._T_world_last, self._keyframe, alignment)
        return replace(track, cause=loss.cause)

    def _new_map(self, frame: Frame) -> Track:
        """Begin a new map with this frame; its relative pose to the other maps is unknown."""
        self._enter_map(self._map_count)
        self._map_count += 1
        self._keyframe, self._T_world_last, self._T_step, self._after_close_up = None, np.eye(4), np.eye(4), False
        self._frames_lost = self._sharp_frames_lost = 0
        return Track(frame.index, "initial", "new map", np.eye(4), frame.index, map=self._map)

    def _enter_map(self, number: int) -> None:
        self._earlier_keyframes.clear()
        self._map, self._last = number, None
        self._relocaliser.enter_map(number, self._frames_of_map)


def _in_contact(loss: TrackingLoss) -> TrackingLoss:
    """Return a loss as that of a frame in which a close-up without structure fills the picture."""
    return TrackingLoss(LossCause.CONTACT, f"the wall fills the picture, {loss.reason}")


def _T_world_camera(keyframe: Keyframe, alignment: Alignment) -> np.ndarray:
    T = keyframe.T_world_camera @ inverse(alignment.motion.T_current_reference)
    # Errors of rotation matrices would double from keyframe to keyframe.
    return orthonormalised(T) if np.isfinite(T).all() else T


def _track_of(
    index: int, status: Status, reason: str, T_world_camera: np.ndarray, keyframe: Keyframe, alignment: Alignment
) -> Track:
    return Track(
        index,
        status,
        reason,
        T_world_camera,
        keyframe.frame.index,
        alignment.residual,
        alignment.inlier_share,
        alignment.correlation,
        alignment.overlap,
        alignment.iterations,
        keyframe.map,
        nonrigidity=alignment.nonrigidity,
    )
