"""Why frames are lost, and what the operator can do about it."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

FAST_MOTION = 0.03  # by hand
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
    LossCause.TOO_DARK,
    LossCause.OVEREXPOSED,
    LossCause.VIEW_COVERED,
    LossCause.CONTACT,
    LossCause.NO_TEXTURE,
}


def causes_of_loss(status: np.ndarray, cause: np.ndarray, motion: np.ndarray) -> list[LossCause]:
    """Return for each frame, in order, why it is lost; `NONE` where it is not.

    status : (N,) as in `Trajectory`. cause : (N,) as the tracker judged it. motion : (N,) median flow since the frame
    before, share of the width, NaN = unknown: it tells blur from smoke, and explains a rejected pose. A frame without a
    fault of its own that follows lost ones is not found again.
    """
    found: list[LossCause] = []
    for lost, judged, is_fast in zip(status == "lost", cause.tolist(), motion > FAST_MOTION, strict=True):
        before = found[-1] if found else LossCause.NONE
        found.append(_cause(LossCause(judged), bool(is_fast), before) if lost else LossCause.NONE)
    return found


def _cause(cause: LossCause, is_fast: bool, before: LossCause) -> LossCause:
    if cause in _OF_ITS_OWN:
        return cause
    if cause is LossCause.UNSHARP:
        return LossCause.MOTION_BLUR if is_fast else cause
    if is_fast:
        return LossCause.FAST_MOTION
    return LossCause.NOT_FOUND_AGAIN if before else cause
