"""Tracker: estimates the pose of every frame against the keyframe, and reports why where it cannot."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scopemap.engine.config import TrackingSettings
from scopemap.engine.errors import InputError
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.features import FeatureDetector, SiftFeatures
from scopemap.engine.tracking.keyframe_alignment import (
    MAX_EXTRAPOLATION,
    MIN_SHARPNESS,
    MIN_TEXTURE,
    Keyframe,
    KeyframeAligner,
    MotionModel,
    is_obscured,
)
from scopemap.engine.tracking.keyframe_choice import KeyframeChoice
from scopemap.engine.tracking.pyramid import build_pyramid
from scopemap.engine.tracking.relocalisation import Relocaliser, depth_ratio, is_close_up, nearer_keyframe
from scopemap.engine.tracking.residuals import PyramidLevel
from scopemap.engine.tracking.rtdl import Alignment
from scopemap.engine.tracking.sharpness import SharpnessMonitor
from scopemap.engine.tracking.track import FrameTracker, KeyframeDecision, Track, TrackingLoss
from scopemap.engine.tracking.usable import too_few_pixels

_EARLIER_KEYFRAMES = 64  # by hand: of the current map, that are searched for one nearer than the current one
# By hand: with the keyframe in which features find a frame: with less the pose hangs on a corner of it.
_FOUND_OVERLAP = 0.25
_WEAK_COVERAGE = 0.15  # by hand: of a pose that is compared with one by features
# By hand: of an earlier keyframe's corners that must be matched for it to be tracked against again.
_REVISITED_COVERAGE = 0.5
_SEARCHED_FAST = 3  # by hand: of a camera lost for longer every n-th frame is searched, where tracking is fast
# Pictures that show no structure say nothing of how long the camera has been lost.
_OBSCURED = (LossCause.TOO_DARK, LossCause.OVEREXPOSED, LossCause.VIEW_COVERED, LossCause.UNSHARP)
_UNCONFIRMED = "no features confirm the pose after a wall filled the picture"


class _Failure(NamedTuple):
    """Why an alignment gives no pose. is_obscured : by blur, smoke or fluid; such frames begin no new map."""

    loss: TrackingLoss
    is_obscured: bool


class Tracker(FrameTracker):
    """Tracks frames against keyframes.

    The first usable frame fixes the world. A frame's pose has the least reprojection error of the keyframe's corners,
    matched by `flow`, and is judged photometrically. Where it is rejected and where too few corners are matched,
    features find the frame in the keyframes most like it. Where the keyframe's depth is measured, the pose comes from
    photometric alignment (`rtdl.py`). A lost frame is recorded with the reason; the next one is aligned
    from the last pose, from the extrapolated one, and relocalised in recent keyframes. After several sharp frames lost
    in a row a new map begins, with its own world; later relocalisation may lead back to an older map.

    `Track.decision` says whether a frame becomes a keyframe:

    - "new" where the last one is old or fits badly (`KeyframeChoice`), and where flow fails and features find the frame
    - "revisited" where an earlier keyframe is nearer; `_is_revisited` until a sharp frame is a keyframe in mapping
    - after it was tracked, where features match the next frame with it alone: that one's track promotes it
    """

    _keyframe: Keyframe | None = None
    _last: Frame | None = None

    def __init__(
        self, settings: TrackingSettings, flow: FlowEstimator | None = None, features: FeatureDetector | None = None
    ) -> None:
        self.settings = settings
        self._min_sharpness = MIN_SHARPNESS if settings.picture_checks else 0.0
        self._searched_every = _SEARCHED_FAST if settings.fast else 1
        self._motion = MotionModel()
        self._aligner = KeyframeAligner(settings, flow, self._motion)
        self._relocaliser = Relocaliser(settings, features or SiftFeatures())
        self._earlier_keyframes = deque[Frame](maxlen=_EARLIER_KEYFRAMES)
        self._choice = KeyframeChoice(settings)
        self._sharpness, self._sharp_frames_lost = SharpnessMonitor(), 0
        self._is_unsharp = self._after_close_up = self._is_revisited = False

    def track(self, frame: Frame) -> Track:
        """Return the frame's pose relative to the first usable frame of its map, or the reason why there is none."""
        self._choice.see(frame)
        usable, loss = float(frame.valid.mean()), too_few_pixels(frame, self.settings)
        if loss is not None:
            self._sharp_frames_lost = 0
            return replace(self._lost(frame, loss), usable=usable)
        sharpness = self._sharpness.relative_sharpness(frame.rgb, frame.valid)
        return replace(self._track(frame, sharpness), usable=usable, sharpness=sharpness)

    def _track(self, frame: Frame, sharpness: float) -> Track:
        """Return the track of a frame with enough usable pixels."""
        self._is_unsharp = sharpness < self._min_sharpness
        keyframe, was_lost = self._keyframe, self._motion.frames_lost > 0
        if keyframe is None:
            return self._lost(frame, _unsharp(sharpness)) if self._is_unsharp else self._first(frame)
        if not self._is_searched():
            self._sharp_frames_lost += not self._is_unsharp
            skipped = f"not searched: one of {self._searched_every} lost frames is"
            return self._lost(frame, TrackingLoss(LossCause.OTHER, skipped))
        alignment, pyramid = self._aligner.align(keyframe, frame)
        if self._choice.reason(alignment) and not was_lost and not self._rejection(alignment):
            alignment = self._against_earlier_keyframe(frame, alignment)
        failure = self._failure(frame, alignment, sharpness)
        if failure is not None or was_lost or alignment.coverage < _WEAK_COVERAGE:
            found = self._found(frame, pyramid, sharpness, failed=failure is not None)
            if found is not None and (failure is not None or found[1].agreement > alignment.agreement):
                return self._accept_found(frame, *found)
        if failure is not None:
            return self._failed(frame, alignment, failure)
        return self._accept(frame, alignment)

    def _is_searched(self) -> bool:
        """Whether a frame is looked for; of many in a row that are lost only some are."""
        lost, every = self._motion.frames_lost, self._searched_every
        return lost <= MAX_EXTRAPOLATION or lost % every == 0

    def _failure(self, frame: Frame, alignment: Alignment, sharpness: float) -> _Failure | None:
        """Return why an alignment with the keyframe gives no pose; None where it does.

        Tissue that the camera touches fills the picture without structure. What is aligned after that may be anywhere,
        until features confirm it.
        """
        assert self._keyframe is not None
        failure, rejection = None, self._rejection(alignment)
        if is_obscured(sharpness, alignment, self._min_sharpness):
            failure = _Failure(_unsharp(sharpness), is_obscured=True)
        elif rejection is not None:
            failure = _Failure(rejection, is_obscured=False)
        if failure is not None and is_close_up(frame, self._keyframe):
            self._after_close_up = True
            return failure._replace(loss=_in_contact(failure.loss))
        if failure is None and self._after_close_up and self.settings.relocalisation_keyframes:
            return _Failure(TrackingLoss(LossCause.VIEW_CHANGED, _UNCONFIRMED), is_obscured=False)
        return failure

    def _failed(self, frame: Frame, alignment: Alignment, failure: _Failure) -> Track:
        """Return the track of a frame without a pose: it is lost, or after many sharp ones it begins a new map."""
        if failure.is_obscured:
            self._sharp_frames_lost = 0
            return self._lost(frame, failure.loss, alignment)
        self._sharp_frames_lost += 1
        most = self.settings.new_map_after * (2 if self._after_close_up else 1)
        if self._sharp_frames_lost > most > 0 and not self._is_unsharp:
            return self._new_map(frame)
        return self._lost(frame, failure.loss._replace(reason=f"rejected: {failure.loss.reason}"), alignment)

    def update(self, frame: Frame, decision: KeyframeDecision, *, measured: bool) -> bool:
        """Take a tracked frame as decided; a new keyframe has planes if `measured`, and is refused without depth.

        A frame that is no keyframe is kept until the next one. Where tissue moves further than flow follows, features
        still match successive frames: the next track may promote it to a keyframe.
        """
        if frame.depth_mm is None or frame.T_world_camera is None:
            raise ValueError("a tracked frame needs a depth and a pose")
        if decision.kind == "none":
            self._last = None if self._is_unsharp else frame
            return self._last is not None
        if decision.kind == "revisited":
            self._is_revisited, self._choice.frames_since = False, 0
            return True
        keyframe = self._keyframe_of(frame, measured)
        if keyframe is None:
            return False
        self._use_keyframe(keyframe)
        self._motion.T_world_last = frame.T_world_camera  # it may have been adjusted
        self._relocaliser.add(keyframe)
        self._earlier_keyframes.append(replace(frame, depth_sigma_mm=None))
        self._choice.begin()
        return True

    def replay(self, frame: Frame, track: Track) -> None:
        """Take a frame as it was tracked before the run was resumed, in place of `track`: nothing is aligned."""
        self._choice.see(frame)
        if too_few_pixels(frame, self.settings) is None:
            sharpness = self._sharpness.relative_sharpness(frame.rgb, frame.valid)
            self._is_unsharp = sharpness < self._min_sharpness
        if track.status == "lost":
            self._motion.frames_lost += 1
            self._sharp_frames_lost = 0 if track.cause in _OBSCURED else self._sharp_frames_lost + 1
            self._after_close_up |= track.cause == LossCause.CONTACT
        elif track.status == "initial":
            if self._keyframe is not None:
                self._new_map(frame)
        else:
            self._replay_pose(frame, track)

    def _replay_pose(self, frame: Frame, track: Track) -> None:
        keyframe = self._known_keyframe(track.keyframe)
        if track.decision.promotes_previous:
            self._relocaliser.add(keyframe)
            self._choice.frames_since = 1
        if keyframe is not self._keyframe:
            self._use_keyframe(keyframe)
        self._aligner.set_keyframe(keyframe, frame, inverse(track.T_world_camera) @ keyframe.T_world_camera)
        self._follow(keyframe.map, track.T_world_camera, track.inlier_share * track.overlap)

    def _known_keyframe(self, number: int) -> Keyframe:
        """Return the keyframe of the frame with this number, which is the current one, one of those before, or due."""
        current = self._keyframe
        assert current is not None
        known = [current, *self._relocaliser.keyframes]
        frames = [*self._earlier_keyframes, *([] if self._last is None else [self._last])]
        found = next((one for one in known if one.frame.index == number), None)
        frame = next((one for one in frames if one.index == number), None)
        made = self._keyframe_of(frame, current.measured) if found is None and frame is not None else found
        if made is None:
            raise InputError(f"the keyframe {number}, which frames were tracked against, is not among those before")
        return made

    def _against_earlier_keyframe(self, frame: Frame, alignment: Alignment) -> Alignment:
        """Return the alignment with an earlier keyframe where one is nearer than the current one, which it replaces."""
        current = self._keyframe
        assert current is not None
        self._is_revisited = False
        if not self._aligner.has_corners(current):
            return alignment
        T_world_camera = current.pose_by(alignment)
        nearest = nearer_keyframe(self._earlier_keyframes, T_world_camera, current)
        keyframe = None if nearest is None else self._keyframe_of(nearest, current.measured)
        if keyframe is None:
            return alignment
        T_start = inverse(T_world_camera) @ keyframe.T_world_camera
        self._aligner.set_keyframe(keyframe, frame, T_start)
        found = self._aligner.by_corners(keyframe, frame, T_start)
        if found is None or found.coverage < _REVISITED_COVERAGE or self._aligner.rejection(keyframe, found):
            self._aligner.set_keyframe(current)
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
        return Keyframe(frame, frame.T_world_camera, pyramid, mean_mm, measured, self._motion.map)

    def _found(
        self, frame: Frame, pyramid: list[PyramidLevel] | None, sharpness: float, *, failed: bool
    ) -> tuple[Keyframe, Alignment] | None:
        """Return the keyframe in which features find a frame, and its accepted alignment; None without any.

        failed : whether the alignment without features failed; then all maps are searched. After a loss the current one
        is, else the keyframe and the frame tracked last.
        """
        assert self._keyframe is not None
        if sharpness < self._min_sharpness / 2:
            return None  # whatever features find, `is_obscured` would refuse it
        views = pyramid or self._aligner.pyramid(self._keyframe, frame)
        near = [self._keyframe]
        if self._last is not None and self._last.index != self._keyframe.frame.index:
            last = self._keyframe_of(self._last, self._keyframe.measured)
            near += [] if last is None else [last]
        found = self._relocaliser.find(
            frame,
            lambda keyframe, relative: self._aligner.align_from(keyframe, frame, views, relative),
            lambda keyframe, alignment: (
                self._aligner.rejection(keyframe, alignment) is None
                and alignment.overlap >= _FOUND_OVERLAP
                # Of many keyframes one always fits a picture without texture.
                and (keyframe.measured or alignment.texture >= MIN_TEXTURE)
                and not is_obscured(sharpness, alignment, self._min_sharpness)
            ),
            near=near,
            recent=failed or self._motion.frames_lost > 0,
            other_maps=failed,
        )
        self._aligner.set_keyframe(self._keyframe)
        return found

    def _accept_found(self, frame: Frame, keyframe: Keyframe, alignment: Alignment) -> Track:
        """Return the track of a frame that features found in a keyframe, which becomes the current one."""
        relocalised = keyframe.map != self._motion.map or self._motion.frames_lost > 0
        promotes_previous = self._last is not None and keyframe.frame.index == self._last.index
        if promotes_previous:
            self._relocaliser.add(keyframe)
            self._choice.frames_since = 1
        self._use_keyframe(keyframe)
        track = self._accept(frame, alignment, found_by_features=True)
        decision = replace(track.decision, promotes_previous=promotes_previous)
        reason = "relocalised" if relocalised else ""
        return replace(track, reason=reason, relocalised=relocalised, decision=decision)

    def _use_keyframe(self, keyframe: Keyframe) -> None:
        self._keyframe, self._last = keyframe, None
        self._choice.change(keyframe.depth_mm)
        self._aligner.set_keyframe(keyframe)

    def _rejection(self, alignment: Alignment) -> TrackingLoss | None:
        """Return why an alignment with the current keyframe is rejected, or None."""
        assert self._keyframe is not None
        return self._aligner.rejection(self._keyframe, alignment)

    def _accept(self, frame: Frame, alignment: Alignment, *, found_by_features: bool = False) -> Track:
        """Return the track of a frame with the pose of its alignment with the current keyframe."""
        keyframe = self._keyframe
        assert keyframe is not None
        T_world_camera = keyframe.pose_by(alignment)
        ratio = depth_ratio(keyframe, frame, T_world_camera) if self._after_close_up else float("nan")
        self._follow(keyframe.map, T_world_camera, alignment.agreement)
        decision = self._decide(alignment, found_by_features=found_by_features)
        track = Track(frame.index, "ok", "", T_world_camera, keyframe.frame.index, decision=decision)
        return replace(_fitted(track, keyframe, alignment), depth_ratio=ratio)

    def _follow(self, map_number: int, T_world_camera: np.ndarray, agreement: float) -> None:
        """Go on from an accepted pose in the world of a map, which has this agreement with the current keyframe."""
        if map_number != self._motion.map:
            self._motion.enter_map(map_number, T_world_camera)
            self._forget_map()
        self._after_close_up, self._sharp_frames_lost = False, 0
        self._motion.follow(T_world_camera)
        self._relocaliser.count(map_number)
        self._choice.accept(agreement)

    def _decide(self, alignment: Alignment, *, found_by_features: bool) -> KeyframeDecision:
        """Return whether a frame with this accepted alignment becomes a keyframe."""
        if self._is_unsharp:  # its depth is no better than its image
            return KeyframeDecision()
        if self._is_revisited:
            return KeyframeDecision("revisited", "an earlier keyframe is nearer than the last one")
        reason = "flow fails, features find the frame" if found_by_features else self._choice.reason(alignment)
        return KeyframeDecision("new", reason) if reason else KeyframeDecision()

    def _lost(self, frame: Frame, loss: TrackingLoss, alignment: Alignment | None = None) -> Track:
        self._motion.frames_lost += 1
        reference = self._keyframe.frame.index if self._keyframe else frame.index
        T_world_camera, number = self._motion.T_world_last, self._motion.map
        track = Track(frame.index, "lost", loss.reason, T_world_camera, reference, map=number, cause=loss.cause)
        return track if self._keyframe is None or alignment is None else _fitted(track, self._keyframe, alignment)

    def _new_map(self, frame: Frame) -> Track:
        """Begin a new map with this frame; its relative pose to the other maps is unknown."""
        self._motion.begin_map()
        self._forget_map()
        self._keyframe, self._after_close_up, self._sharp_frames_lost = None, False, 0
        self._is_revisited = False
        return self._first(frame, "new map")

    def _first(self, frame: Frame, reason: str = "first frame of the map") -> Track:
        decision = KeyframeDecision("new", "first frame of the map")
        return Track(frame.index, "initial", reason, np.eye(4), frame.index, map=self._motion.map, decision=decision)

    def _forget_map(self) -> None:
        self._earlier_keyframes.clear()
        self._last = None
        self._relocaliser.enter_map(self._motion.map)


def _unsharp(sharpness: float) -> TrackingLoss:
    return TrackingLoss(LossCause.UNSHARP, f"only {sharpness:.0%} of the usual sharpness: blur, smoke or fluid")


def _in_contact(loss: TrackingLoss) -> TrackingLoss:
    """Return a loss as that of a frame in which a close-up without structure fills the picture."""
    return TrackingLoss(LossCause.CONTACT, f"close-up without structure: {loss.reason}")


def _fitted(track: Track, keyframe: Keyframe, alignment: Alignment) -> Track:
    """Return a track with how well it fits the keyframe."""
    return replace(
        track,
        residual=alignment.residual,
        inlier_share=alignment.inlier_share,
        correlation=alignment.correlation,
        overlap=alignment.overlap,
        iterations=alignment.iterations,
        map=keyframe.map,
        nonrigidity=alignment.nonrigidity,
    )
