"""Why frames are lost, and what the operator can do about it."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Protocol

FAST_MOTION = 0.03
"""Median flow between two frames, share of the width, beyond which a frame is lost for its motion."""


class LossCause(StrEnum):
    """Why a frame is lost; the values are those of the column `cause` of frames.csv."""

    NONE = ""
    FAST_MOTION = "fast motion"
    MOTION_BLUR = "motion blur"
    UNSHARP = "smoke, fluid or out of focus"
    TOO_DARK = "too dark"
    OVEREXPOSED = "overexposed"
    VIEW_COVERED = "view covered"
    CONTACT = "contact with the wall"
    NO_TEXTURE = "no texture"
    VIEW_CHANGED = "view changed"
    NOT_FOUND_AGAIN = "not found again"
    OTHER = "other"


ADVICE = {
    LossCause.FAST_MOTION: "turn and withdraw more slowly, and record all frames: none left out, as many a second as "
    "possible",
    LossCause.MOTION_BLUR: "move more slowly; more light shortens the exposure",
    LossCause.UNSHARP: "wait until the view is clear; rinse the lens, suck off fluid and smoke",
    LossCause.TOO_DARK: "go nearer, or turn the light up",
    LossCause.OVEREXPOSED: "withdraw from the wall until it is no longer white",
    LossCause.VIEW_COVERED: "withdraw from the wall, or take out of the view what covers it",
    LossCause.CONTACT: "withdraw from the wall, until the lumen or a fold is in view again",
    LossCause.NO_TEXTURE: "keep folds or vessels in view; near a bare wall there is nothing to follow",
    LossCause.VIEW_CHANGED: "hold the camera still while tissue or instruments move, or the wall fills the picture",
    LossCause.NOT_FOUND_AGAIN: "go back to where the camera was before the loss, and look from a similar angle",
    LossCause.OTHER: "see the reason in frames.csv",
}
"""What can be done, by the cause of a loss."""

_OF_ITS_OWN = {
    *(LossCause.TOO_DARK, LossCause.OVEREXPOSED, LossCause.VIEW_COVERED, LossCause.CONTACT, LossCause.NO_TEXTURE)
}


class TrackedFrame(Protocol):
    """What is known of a frame: its status, the cause that the tracker gave, and the flow since the frame before."""

    @property
    def status(self) -> str:
        """As in `Trajectory`."""

    @property
    def cause(self) -> LossCause:
        """`NONE` where it is not lost."""

    @property
    def motion(self) -> float:
        """Median flow, share of the width; NaN where it is not known."""


def causes_of_loss(frames: Sequence[TrackedFrame]) -> list[LossCause]:
    """Return for each frame, in order, why it is lost; `NONE` where it is not.

    Motion tells blur from smoke, and explains a rejected pose. A frame without a fault of its own that follows lost
    ones is not found again.
    """
    found: list[LossCause] = []
    for frame in frames:
        before = found[-1] if found else LossCause.NONE
        is_fast = frame.motion > FAST_MOTION
        found.append(_cause(frame.cause, is_fast, before) if frame.status == "lost" else LossCause.NONE)
    return found


def _cause(cause: LossCause, is_fast: bool, before: LossCause) -> LossCause:
    if cause in _OF_ITS_OWN:
        return cause
    if cause is LossCause.UNSHARP:
        return LossCause.MOTION_BLUR if is_fast else cause
    if is_fast:
        return LossCause.FAST_MOTION
    return LossCause.NOT_FOUND_AGAIN if before else cause
