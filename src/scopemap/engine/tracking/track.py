"""Track: the tracking result of one frame; FrameTracker: the protocol of trackers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from scopemap.engine.frame import Frame, percentiles
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.tracking.causes import LossCause

Status = Literal["initial", "ok", "lost"]

_DARK_LEVEL = 40  # by hand: of the brightest channel, in an image with few usable pixels
_BRIGHT_LEVEL = 200  # by hand
MOVING_SIGMAS = 2.0  # by hand
"""Standard deviations of noise beyond which tissue moves on its own."""


class TrackingLoss(NamedTuple):
    """Why a frame is lost: the cause, and one phrase with its figures."""

    cause: LossCause
    reason: str


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


def unusable(frame: Frame) -> TrackingLoss:
    """Return why few pixels of an image are usable: it is dark, overexposed, or something covers the view."""
    low, middle = percentiles(frame.rgb[::2, ::2].max(axis=2), [20.0, 50.0])
    reason = f"only {frame.valid.mean():.0%} of the image is usable"
    if middle < _DARK_LEVEL:
        return TrackingLoss(LossCause.TOO_DARK, f"{reason}, it is too dark")
    if low > _BRIGHT_LEVEL:
        return TrackingLoss(LossCause.OVEREXPOSED, f"{reason}, it is overexposed")
    return TrackingLoss(LossCause.VIEW_COVERED, reason)


class FrameTracker(Protocol):
    """Protocol of trackers, which take frames in order: `Tracker`, and those that derive from it, as baselines do."""

    def track(self, frame: Frame) -> Track:
        """Return a frame's pose by its raw `depth_mm`, or why it is lost; the first usable one is "initial"."""

    def needs_keyframe(self) -> bool:
        """Return whether the frame that was tracked last should become a reference for those to come."""

    def insert_keyframe(self, frame: Frame, *, measured: bool) -> bool:
        """Make a tracked frame, with its refined depth and its pose, the reference; False where it cannot be one."""

    def remember(self, frame: Frame) -> bool:
        """Take the last tracked frame, which is no keyframe; return whether later ones may be tracked against it."""
        return False

    def another(self) -> FrameTracker | None:
        """Return a tracker that has seen no frame, to track lost frames anew; None where that is not possible."""
        return None


def motion_between(previous: Track | None, current: Track) -> np.ndarray | None:
    """Return T_current_previous (4, 4); None unless both frames are tracked in one map."""
    if previous is None or "lost" in (previous.status, current.status) or previous.map != current.map:
        return None
    return inverse(current.T_world_camera) @ previous.T_world_camera
