"""Why frames are lost, in few words, and what the one who films can do about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

FAST_MOTION = 0.03
"""Median flow between two frames, share of the width, beyond which a frame is lost for its motion."""

NOT_FOUND_AGAIN = "not found again"
_UNSHARP, _NO_TEXTURE, _WALL = "usual sharpness", "hardly any texture", "the wall fills the picture"

ADVICE = {
    "fast motion": "turn and withdraw more slowly, and record all frames: none left out, as many a second as possible",
    "motion blur": "move more slowly; more light shortens the exposure",
    "smoke, fluid or out of focus": "wait until the view is clear; rinse the lens, suck off fluid and smoke",
    "too dark": "go nearer, or turn the light up",
    "overexposed": "withdraw from the wall until it is no longer white",
    "view covered": "withdraw from the wall, or take out of the view what covers it",
    "contact with the wall": "withdraw from the wall, until the lumen or a fold is in view again",
    "no texture": "keep folds or vessels in view; near a bare wall there is nothing to follow",
    "view changed": "hold the camera still while tissue or instruments move, or the wall fills the picture",
    NOT_FOUND_AGAIN: "go back to where the camera was before the loss, and look from a similar angle",
    "other": "see the reason in frames.csv",
}
"""What can be done, by the cause of a loss."""


class TrackedFrame(Protocol):
    """What is known of a frame: its status, the reason in words, and the median flow since the frame before."""

    @property
    def status(self) -> str:
        """As in `Trajectory`."""

    @property
    def reason(self) -> str:
        """One phrase."""

    @property
    def motion(self) -> float:
        """Share of the width; NaN where it is not known."""


def causes_of_loss(frames: Sequence[TrackedFrame]) -> list[str]:
    """Return for each frame, in order, why it is lost, a key of `ADVICE`; "" where it is not.

    A frame that is itself in order, but follows lost ones, is "not found again".
    """
    found: list[str] = []
    for frame in frames:
        before = found[-1] if found else ""
        found.append(_cause(frame.reason, frame.motion > FAST_MOTION, before) if frame.status == "lost" else "")
    return found


def _cause(reason: str, is_fast: bool, before: str) -> str:
    if "of the image is usable" in reason:
        return next((word for word in ("too dark", "overexposed") if word in reason), "view covered")
    if _WALL in reason:
        return "contact with the wall"
    if _UNSHARP in reason:
        return "motion blur" if is_fast else "smoke, fluid or out of focus"
    if _NO_TEXTURE in reason:
        return "no texture"
    if is_fast:
        return "fast motion"
    if before:
        return NOT_FOUND_AGAIN
    return "view changed" if reason.startswith("rejected") else "other"
