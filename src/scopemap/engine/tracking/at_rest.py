"""CameraAtRest: the tracker of a camera that is known not to move, so that all motion is the tissue's."""

from __future__ import annotations

import numpy as np

from scopemap.engine.config import TrackingSettings
from scopemap.engine.flow.corners import KeyframeMatcher
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.frame import Frame
from scopemap.engine.tracking.corner_pose import nonrigidity
from scopemap.engine.tracking.track import FrameTracker, KeyframeDecision, Track
from scopemap.engine.tracking.usable import too_few_pixels


class CameraAtRest(FrameTracker):
    """A `FrameTracker` that gives every frame the first pose, and measures where tissue moves.

    A frame is lost where too little of it is usable alone. flow : of the keyframe's corners; "none": motion is not
    measured.
    """

    _keyframe: int | None = None

    def __init__(self, settings: TrackingSettings, flow: FlowEstimator) -> None:
        self._settings, self._frames_since_keyframe = settings, 0
        self._matcher = None if flow.name == "none" else KeyframeMatcher(flow)

    def track(self, frame: Frame) -> Track:
        """Return the identity, with the motion of the tissue since the keyframe; "lost" where little is usable."""
        here, loss = np.eye(4), too_few_pixels(frame, self._settings)
        self._frames_since_keyframe += 1
        if loss is not None:
            reference = frame.index if self._keyframe is None else self._keyframe
            return Track(frame.index, "lost", loss.reason, here, reference, cause=loss.cause)
        if self._keyframe is None:
            first = "first frame of the map"
            return Track(frame.index, "initial", first, here, frame.index, decision=KeyframeDecision("new", first))
        found = None if self._matcher is None else self._matcher.match(frame)
        # Depth does not matter: nothing but tissue moves.
        moving = None if found is None else nonrigidity(found, frame.camera, here, 0.0)
        is_due = self._frames_since_keyframe >= self._settings.keyframe_every
        decision = KeyframeDecision("new", "its corners are found anew") if is_due else KeyframeDecision()
        return Track(frame.index, "ok", "", here, self._keyframe, nonrigidity=moving, decision=decision)

    def replay(self, frame: Frame, track: Track) -> None:
        """Count a frame that was tracked before the run was resumed, in place of `track`."""
        self._frames_since_keyframe += 1

    def update(self, frame: Frame, decision: KeyframeDecision, *, measured: bool) -> bool:
        """Follow the corners of a new keyframe from now on; False for others, or with too little known depth."""
        if decision.kind == "none":
            return False
        known = frame.valid & np.isfinite(np.asarray(frame.depth_mm))
        if known.mean() < self._settings.min_valid_share:
            return False
        if self._matcher is not None:
            self._matcher.set_keyframe(frame)
        self._keyframe, self._frames_since_keyframe = frame.index, 0
        return True
