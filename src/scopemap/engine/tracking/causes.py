"""Why frames are lost."""

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
