"""Track: the tracking result of one frame, with the decision on keyframes; FrameTracker: the protocol of trackers."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.tracking.causes import LossCause

Status = Literal["initial", "ok", "lost"]
KeyframeKind = Literal["none", "new", "revisited"]

MOVING_SIGMAS = 2.0
"""Standard deviations of noise beyond which tissue moves on its own."""


class TrackingLoss(NamedTuple):
    """Why a frame is lost: the cause, and one phrase with its figures."""

    cause: LossCause
    reason: str


@dataclass(frozen=True)
class KeyframeDecision:
    """Whether a tracked frame becomes a keyframe, and why.

    kind : "new": later frames are tracked against it; "revisited": they are tracked against an earlier keyframe again,
    and the frame is a keyframe in mapping alone; "none": it is no keyframe.
    reason : one phrase; "" where it is no keyframe.
    promotes_previous : whether the frame tracked before it has become the keyframe that it is tracked against.
    """

    kind: KeyframeKind = "none"
    reason: str = ""
    promotes_previous: bool = False


@dataclass(frozen=True)
class Track:
    """Tracking result of one frame: its pose, or the reason why it is lost.

    status : "initial" for the frame that fixes the world of its map, "ok", or "lost".
    reason : one phrase; for a lost frame, what was wrong. cause : of the loss, as the tracker judged it.
    relocalised : whether features found the lost camera in this frame.
    T_world_camera : (4, 4) float64; a lost frame repeats the last tracked pose. keyframe : number of its reference.
    residual, inlier_share, correlation, overlap, iterations : see `rtdl.Alignment`; NaN if there was no alignment.
    map : number of the map that the pose is in; each has its own world.
    depth_ratio : where the camera is found after a close-up, the keyframe's depth over the frame's own; NaN elsewhere.
    rotation : (3, 3) of a lost frame, from its camera to that of the last tracked frame; None: not known.
    usable : share of the image that shows tissue. sharpness : that of the image over the usual one. motion : median
        optical flow since the frame before, share of the width. quality : see `Frame`. NaN where they are not known.
    nonrigidity : `REGIONS` float32, by how many standard deviations the tissue in each region of the picture moves
        against the rigid scene, NaN where too few corners are matched; None: not measured.
    decision : whether the frame becomes a keyframe.
    """

    index: int
    status: Status
    reason: str
    T_world_camera: np.ndarray
    keyframe: int
    residual: float = float("nan")
    inlier_share: float = float("nan")
    correlation: float = float("nan")
    overlap: float = float("nan")
    iterations: int = 0
    map: int = 0
    usable: float = float("nan")
    sharpness: float = float("nan")
    motion: float = float("nan")
    quality: float = float("nan")
    nonrigidity: np.ndarray | None = None
    depth_ratio: float = float("nan")
    rotation: np.ndarray | None = None
    cause: LossCause = LossCause.NONE
    relocalised: bool = False
    decision: KeyframeDecision = KeyframeDecision()

    @property
    def row(self) -> dict[str, Any]:
        """Its columns of a `FrameTable`, and others."""
        return vars(self) | dict(zip(("moving_share", "moving_x", "moving_y"), self.moving, strict=True))

    @property
    def moving(self) -> tuple[float, float, float]:
        """Share of the measured regions whose tissue moves on its own, their mean place, x, y over the size; or NaN."""
        if self.nonrigidity is None or not np.isfinite(self.nonrigidity).any():
            return np.nan, np.nan, np.nan
        moves = np.nan_to_num(self.nonrigidity) > MOVING_SIGMAS
        share = float(moves.sum() / np.isfinite(self.nonrigidity).sum())
        if not moves.any():
            return share, np.nan, np.nan
        y, x = (np.argwhere(moves).mean(0) + 0.5) / moves.shape
        return share, float(x), float(y)


@dataclass(frozen=True)
class TrackedFrames:
    """All frames of a run as tracked, in order.

    index : (F,) int, their numbers. lost : (F,) bool. map : (F,) int, number of the map that a tracked frame is in.
    T_world_camera : (F, 4, 4), in the world of the map, NaN where a frame is lost. median_depth_mm, motion, quality :
    (F,), the latter two as in `Track`, NaN where unknown.
    """

    index: np.ndarray
    lost: np.ndarray
    map: np.ndarray
    T_world_camera: np.ndarray
    median_depth_mm: np.ndarray
    motion: np.ndarray
    quality: np.ndarray

    def poses_of(self, frames: Collection[int]) -> dict[int, np.ndarray]:
        """Return T_world_camera (4, 4) by number of the frames with these numbers."""
        chosen = np.isin(self.index, list(frames))
        return dict(zip(self.index[chosen].tolist(), self.T_world_camera[chosen], strict=True))


class FrameTracker(Protocol):
    """Protocol of trackers, which take frames in order: `track` each, then `update` with it unless it is lost."""

    def track(self, frame: Frame) -> Track:
        """Return a frame's pose by its raw `depth_mm`, or why it is lost; the first usable one is "initial".

        The track says whether the frame becomes a keyframe.
        """

    def update(self, frame: Frame, decision: KeyframeDecision, *, measured: bool) -> bool:
        """Take the frame that was tracked last, with its refined depth and its pose, as its track decided.

        measured : whether the depth is measured, not predicted; then only keyframes are given. Return whether the frame
        can be used so: a new keyframe needs depth, and not every tracker uses frames that are none.
        """


@runtime_checkable
class ResumableTracker(FrameTracker, Protocol):
    """A `FrameTracker` with which a run that was killed is resumed: it takes the frames tracked before once more."""

    def replay(self, frame: Frame, track: Track) -> None:
        """Take a frame with its refined `depth_mm` as it was tracked, in place of `track`, in order.

        `update` follows as it did, with the pose of the track. Frames that the tracker has not seen, because nothing
        was estimated of them, come without a usable pixel.
        """


def motion_between(previous: Track | None, current: Track) -> np.ndarray | None:
    """Return T_current_previous (4, 4); None unless both frames are tracked in one map."""
    if previous is None or "lost" in (previous.status, current.status) or previous.map != current.map:
        return None
    return inverse(current.T_world_camera) @ previous.T_world_camera
