"""The tracker: aligns every frame to the keyframe, and says when it could not."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scopemap.config import TrackingSettings
from scopemap.flow.estimator import FlowEstimator
from scopemap.flow.follow import CornerFollower
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse, mean_near, orthonormalised, rotation_angle_rad
from scopemap.tracking.features import Landmarks, find_landmarks, locate
from scopemap.tracking.flow_pose import flow_error_px, pose_by_flow, refined_by_corners
from scopemap.tracking.pyramid import build_pyramid
from scopemap.tracking.residuals import View
from scopemap.tracking.rtdl import Alignment, Motion, align, judged
from scopemap.tracking.sharpness import Clarity
from scopemap.tracking.track import Status, Track

_BARE = 0.5  # texture of a wall that shows nothing but noise; tissue: 0.65 and more
_BELIEVABLE_PX = 2.0  # median error of flow's own motion, up to which that bears a pose out
_WORTH_KEEPING = 5  # frames tracked in a map, from which on it is looked for later
_STILL_ALIKE = 0.8  # share of the correlation that corners may cost; more, and flow has followed something else
_CONSISTENCY_PX = 1.0  # largest forward-backward error of flow at a corner
_LONGEST_EXTRAPOLATION = 5  # frames for which the last motion is believed to go on


@dataclass(frozen=True)
class _Keyframe:
    frame: Frame
    T_world_camera: np.ndarray
    pyramid: list[View]
    depth_mm: float  # mean
    measured: bool
    map: int

    @property
    def index(self) -> int:
        return self.frame.index

    @cached_property
    def landmarks(self) -> Landmarks:
        """Looked for when first asked for: most clips never need them."""
        return find_landmarks(self.frame)


class Tracker:
    """Tracks frames against keyframes (METHOD section WEMA-RTDL).

    The first usable frame fixes the world. Where a frame is lost, the record says so and why, and the next one starts
    from the last pose that is known, from where the last motion would have led, or from where the landmarks of a recent
    keyframe say that it is: whichever fits best, and that keyframe is tracked against from there. Where the points of
    the previous frame (`Frame.flow_correspondences`) contradict a frame's pose, they decide. Where frames stay lost
    although they are clear, a new map begins, with a world of its own; a later loss may lead back to an older one.
    """

    def __init__(self, settings: TrackingSettings, flow: FlowEstimator | None = None) -> None:
        self.settings = settings
        follows = flow is not None and flow.name != "none" and settings.corner_depth_share > 0
        self._follower = CornerFollower(flow, _CONSISTENCY_PX) if flow is not None and follows else None
        self._keyframe: _Keyframe | None = None
        self._remembered: deque[_Keyframe] = deque(maxlen=settings.remembered_keyframes)
        self._remembered_elsewhere: deque[_Keyframe] = deque(maxlen=2 * settings.remembered_keyframes)
        self._clarity = Clarity()
        self._T_world_last = np.eye(4)
        self._T_step = np.eye(4)
        self._frames_lost = 0
        self._frames_since_keyframe = 0
        self._agreement: list[float] = []
        self._flow_decided = self._flow_agrees = self._unclear = False
        self._map, self._maps = 0, 1
        self._tracked_in: Counter[int] = Counter()
        self._clear_frames_lost = 0

    def track(self, frame: Frame) -> Track:
        """Return the frame's pose relative to the first usable frame of its map, or say why there is none."""
        self._frames_since_keyframe += 1
        if self._follower is not None and self._keyframe is not None and not self._keyframe.measured:
            frame = replace(frame, keyframe_correspondences=self._follower.find(frame))
        if frame.valid.mean() < self.settings.min_valid_share:
            self._clear_frames_lost = 0
            return self._lost(frame, f"only {frame.valid.mean():.0%} of the image is usable")
        detail = self._clarity.against_recent(frame)
        self._unclear = detail < self.settings.least_detail
        if self._keyframe is None and self._unclear:
            return self._lost(frame, f"only {detail:.0%} of the usual detail: blur, smoke or fluid")
        if self._keyframe is None:
            return Track(frame.index, "initial", "fixes the world", np.eye(4), frame.index, map=self._map)
        # The keyframe's points are moved: the depth of the frame itself has no say, unless it was measured.
        depth_mm = frame.depth_mm if self._keyframe.measured else None
        pyramid = build_pyramid(replace(frame, depth_mm=depth_mm, depth_sigma_mm=None), self.settings)
        alignment = self._against(self._keyframe, frame, pyramid)
        by_flow = self._by_flow(frame, pyramid, alignment)
        # Where flow itself leads to nowhere, there is nothing to be said against the image alone.
        self._flow_decided = by_flow is not None and not self._trouble(self._keyframe, by_flow, by_flow=True)
        if by_flow is not None:
            self._flow_agrees, alignment = self._flow_decided, by_flow if self._flow_decided else alignment
        if self._veiled(detail, alignment):
            self._clear_frames_lost = 0
            return self._lost(frame, f"only {detail:.0%} of the usual detail: blur, smoke or fluid", alignment)
        trouble, reason = self._trouble(self._keyframe, alignment, by_flow=self._flow_agrees), ""
        if trouble or self._frames_lost:
            found = self._found_again(frame, pyramid, elsewhere=bool(trouble))
            if found is not None and (trouble or _agreement(found[1]) > _agreement(alignment)):
                self._keyframe, alignment = found
                self._flow_decided, self._agreement = False, []
                trouble, reason = "", "found again"
        if trouble:
            self._clear_frames_lost += 1
            if self._clear_frames_lost > self.settings.new_map_after > 0 and not self._unclear:
                return self._new_map(frame)
            return self._lost(frame, trouble, alignment)
        T_world_camera = self._T_world_camera(self._keyframe, alignment)
        if self._keyframe.map != self._map:
            # The last pose and the last step are of another world.
            self._enter(self._keyframe.map)
            self._T_world_last = T_world_camera
        self._tracked_in[self._map] += 1
        self._remember(T_world_camera)
        self._agreement.append(_agreement(alignment))
        reason = "flow decided" if self._flow_decided else reason
        return _tracked(frame.index, "ok", reason, T_world_camera, self._keyframe, alignment)

    def wants_keyframe(self) -> bool:
        """Return whether the frame that was tracked last should become a keyframe."""
        if self._keyframe is None:
            return True
        due = self._frames_since_keyframe >= self.settings.keyframe_every
        # What an unclear frame says of its depth is no better than what it shows.
        return (due or self._flow_decided or self._fades()) and not self._unclear

    def adopt(self, frame: Frame, *, measured: bool) -> bool:
        """Make a tracked frame, with its depth, the keyframe; False, and nothing changes, where its depth is unknown.

        `measured` says that the depth, and so its slope, can be trusted.
        """
        if frame.depth_mm is None or frame.T_world_camera is None:
            raise ValueError("a keyframe needs a depth and a pose")
        known = frame.valid & np.isfinite(frame.depth_mm)
        if known.mean() < self.settings.min_valid_share:
            return False
        pyramid = build_pyramid(frame, self.settings, trust_slope=measured)
        mean_mm = float(frame.depth_mm[known].mean())
        self._keyframe = _Keyframe(frame, frame.T_world_camera, pyramid, mean_mm, measured, self._map)
        self._remembered.append(self._keyframe)
        if self._follower is not None:
            self._follower.start(frame)
        self._frames_since_keyframe, self._agreement = 0, []
        return True

    def _fades(self) -> bool:
        """Whether the keyframe agrees much less with the last frame than with the first after it, however that was."""
        return bool(self._agreement) and self._agreement[-1] < self.settings.keyframe_agreement * self._agreement[0]

    def _against(self, keyframe: _Keyframe, frame: Frame, pyramid: list[View]) -> Alignment:
        """Return the alignment to the keyframe: by brightness, and by the keyframe's corners where these are seen.

        Corners end in the same place from wherever brightness took them, so its finest level is left out unless they
        cannot tell.
        """
        starts = [inverse(T) @ keyframe.T_world_camera for T in self._guesses()]
        down_to = 1 if self._has_corners(keyframe, frame) else 0
        found = [align(keyframe.pyramid, pyramid, start, self.settings, down_to=down_to) for start in starts]
        alignment = max(found, key=_agreement)
        by_corners = self._by_corners(keyframe, frame, pyramid, alignment)
        if by_corners is not alignment or down_to == 0:
            return by_corners
        start = alignment.motion.T_current_reference
        alignment = align(keyframe.pyramid[:1], pyramid[:1], start, self.settings)
        return self._by_corners(keyframe, frame, pyramid, alignment)

    def _found_again(self, frame: Frame, pyramid: list[View], *, elsewhere: bool) -> tuple[_Keyframe, Alignment] | None:
        """Return the remembered keyframe whose landmarks lead to the best alignment, and that; None where none does.

        Other maps are asked only if `elsewhere` says so, and this one does not know the place.
        """
        if self.settings.remembered_keyframes == 0:
            return None
        current = find_landmarks(replace(frame, depth_mm=None))
        for remembered in (self._remembered, self._remembered_elsewhere if elsewhere else ()):
            found = []
            for keyframe in remembered:
                place = locate(keyframe.landmarks, current, frame.camera, self.settings.least_landmarks)
                if place is not None:
                    alignment = align(keyframe.pyramid, pyramid, place.T_current_reference, self.settings)
                    if not self._trouble(keyframe, alignment, by_flow=False):
                        found.append((keyframe, self._by_corners(keyframe, frame, pyramid, alignment)))
            if found:
                return max(found, key=lambda pair: _agreement(pair[1]))
        return None

    def _enter(self, number: int) -> None:
        """Go on in a map; of the others, those that are more than a few frames are remembered."""
        known = [*self._remembered_elsewhere, *self._remembered]
        self._map = number
        self._remembered.clear()
        self._remembered_elsewhere.clear()
        self._remembered.extend(keyframe for keyframe in known if keyframe.map == number)
        self._remembered_elsewhere.extend(
            keyframe
            for keyframe in known
            if keyframe.map != number and self._tracked_in[keyframe.map] >= _WORTH_KEEPING
        )

    def _new_map(self, frame: Frame) -> Track:
        """Begin anew with this frame: what was seen so far cannot be found, and it is not known how this lies to it."""
        self._enter(self._maps)
        self._maps += 1
        self._keyframe, self._T_world_last, self._T_step = None, np.eye(4), np.eye(4)
        self._frames_lost = self._clear_frames_lost = 0
        self._flow_decided = False
        return Track(frame.index, "initial", "begins a new map", np.eye(4), frame.index, map=self._map)

    def _by_corners(self, keyframe: _Keyframe, frame: Frame, pyramid: list[View], alignment: Alignment) -> Alignment:
        """Return the alignment that the keyframe's corners make of this one, or this one where they cannot tell."""
        seen, share = frame.keyframe_correspondences, self.settings.corner_depth_share
        if seen is None or not self._has_corners(keyframe, frame):
            return alignment
        # What does not correlate is not nearly where it should be, and no start for anything.
        if alignment.correlation < self.settings.min_correlation:
            return alignment
        T = refined_by_corners(seen, frame.camera, alignment.motion.T_current_reference, share)
        if T is None:
            return alignment
        motion = alignment.motion._replace(T_current_reference=T)
        found = judged(keyframe.pyramid, pyramid, motion, self.settings, alignment.iterations)
        return found if found.correlation > _STILL_ALIKE * alignment.correlation else alignment

    def _has_corners(self, keyframe: _Keyframe, frame: Frame) -> bool:
        seen = frame.keyframe_correspondences
        return seen is not None and seen.host == keyframe.index and self.settings.corner_depth_share > 0

    def _by_flow(self, frame: Frame, pyramid: list[View], alignment: Alignment) -> Alignment | None:
        """Return what takes the alignment's place where flow from the frame before contradicts it, else None."""
        keyframe, seen, factor = self._keyframe, frame.flow_correspondences, self.settings.flow_contradiction
        self._flow_agrees = False
        if keyframe is None or seen is None or factor == 0 or self._frames_lost:
            return None
        if seen.share < self.settings.flow_least_share:
            return None
        T_last_keyframe = inverse(self._T_world_last) @ keyframe.T_world_camera

        def error_px(found: Alignment) -> float:
            T_current_last = found.motion.T_current_reference @ inverse(T_last_keyframe)
            return flow_error_px(seen, frame.camera, T_current_last)

        # Nothing within a pixel is contradicted, so flow need not be asked for its own motion.
        self._flow_agrees = error_px(alignment) <= 1
        if self._flow_agrees or (flow := pose_by_flow(seen, frame.camera)) is None:
            return None
        most_px = factor * flow.error_px + 1
        # Flow that no motion explains contradicts nothing, and bears nothing out.
        self._flow_agrees = flow.error_px <= _BELIEVABLE_PX
        if error_px(alignment) <= most_px:
            return None
        start = orthonormalised(flow.T_current_previous @ T_last_keyframe)
        again = align(keyframe.pyramid, pyramid, start, self.settings)
        if error_px(again) <= most_px:
            return again
        return judged(keyframe.pyramid, pyramid, Motion(start, np.array([1.0, 0.0])), self.settings)

    def _guesses(self) -> list[np.ndarray]:
        """Poses to start from: one while all is well, both the last and the extrapolated one after a loss."""
        steps = min(1 + self._frames_lost, _LONGEST_EXTRAPOLATION)
        onward = self._T_world_last @ np.linalg.matrix_power(self._T_step, steps)
        if self._frames_lost:
            return [self._T_world_last, onward]
        if self.settings.start == "identity":
            assert self._keyframe is not None
            return [self._keyframe.T_world_camera]
        return [onward if self.settings.start == "velocity" else self._T_world_last]

    def _veiled(self, detail: float, alignment: Alignment) -> bool:
        """Whether a frame shows too little detail, as a share of what is usual, for its alignment to be believed."""
        least = self.settings.least_detail
        doubtful = alignment.inlier_share < self.settings.doubtful_inlier_share
        # Below half of that even agreement says nothing: smoke agrees with smoke.
        return detail < (least if doubtful else least / 2)

    def _trouble(self, keyframe: _Keyframe, alignment: Alignment, *, by_flow: bool) -> str:
        """Return why a pose cannot be believed, or ""; flow follows tissue where grey values cannot."""
        settings, T_world_camera = self.settings, self._T_world_camera(keyframe, alignment)
        if not np.isfinite(T_world_camera).all():
            return "the alignment diverged"
        if alignment.overlap < settings.min_valid_share:
            return f"only {alignment.overlap:.0%} of the keyframe is in view"
        if alignment.inlier_share < settings.min_inlier_share and not by_flow:
            return f"only {alignment.inlier_share:.0%} of the pixels agree with the keyframe"
        # Measured depth holds a pose by shape alone.
        by_shape = keyframe.measured and settings.depth_share > 0
        if alignment.correlation < settings.min_correlation and not by_shape:
            if alignment.texture < _BARE:
                return "weakly constrained: hardly any texture"
            # A pose that flow bears out may be a pixel or two off, which is enough to spoil fine texture.
            if alignment.correlation < settings.min_correlation / 3 or not by_flow:
                return f"a correlation of {alignment.correlation:.2f} with the keyframe"
        if keyframe.map != self._map:
            return ""
        T_step = inverse(self._T_world_last) @ T_world_camera
        turn = float(rotation_angle_rad(T_step[:3, :3]))
        way = float(np.linalg.norm(T_step[:3, 3])) / keyframe.depth_mm
        if max(turn, way) > settings.max_step * (1 + self._frames_lost):
            return f"a jump of {np.degrees(turn):.0f} deg and {way:.2f} mean depths"
        return ""

    @staticmethod
    def _T_world_camera(keyframe: _Keyframe, alignment: Alignment) -> np.ndarray:
        T = keyframe.T_world_camera @ inverse(alignment.motion.T_current_reference)
        # A keyframe's own deviation from a rotation would be doubled by the next one's, and so on.
        return orthonormalised(T) if np.isfinite(T).all() else T

    def _remember(self, T_world_camera: np.ndarray) -> None:
        T_step = inverse(self._T_world_last) @ T_world_camera
        # After a gap the step is that of several frames: its share of one.
        self._T_step = mean_near(np.eye(4), [T_step], [1 / (1 + self._frames_lost)])
        self._T_world_last, self._frames_lost, self._clear_frames_lost = T_world_camera, 0, 0

    def _lost(self, frame: Frame, reason: str, alignment: Alignment | None = None) -> Track:
        self._frames_lost += 1
        self._flow_decided = False
        if self._keyframe is None or alignment is None:
            keyframe = self._keyframe.index if self._keyframe else frame.index
            return Track(frame.index, "lost", reason, self._T_world_last, keyframe, map=self._map)
        return _tracked(frame.index, "lost", reason, self._T_world_last, self._keyframe, alignment)


def _agreement(alignment: Alignment) -> float:
    return alignment.inlier_share * alignment.overlap


def _tracked(
    index: int, status: Status, reason: str, T_world_camera: np.ndarray, keyframe: _Keyframe, alignment: Alignment
) -> Track:
    return Track(
        index,
        status,
        reason,
        T_world_camera,
        keyframe.index,
        alignment.residual,
        alignment.inlier_share,
        alignment.correlation,
        alignment.overlap,
        alignment.iterations,
        keyframe.map,
    )
