"""Stretches far less clear than the rest: a smear on the lens, defocus, smoke, or tissue too near to be sharp."""

from __future__ import annotations

import numpy as np

from scopemap.inspection.clip import Clip, frames_of
from scopemap.inspection.finding import Finding, covered, stretches_of

_SHARE = 0.35
_LEAST_S, _LEAST_FRAMES, _GAP = 0.15, 3, 2


def check_blurred(clip: Clip) -> list[Finding]:
    """Return stretches with less than a third of the detail that the video usually has."""
    shown = ~clip["blank"]
    if not shown.any():
        return []
    detail = clip["detail"]
    flags = shown & (detail < _SHARE * np.median(detail[shown]))
    # Frames between two blank ones are no stretch of their own.
    stretches = stretches_of(flags, clip.frames_in(_LEAST_S, _LEAST_FRAMES), _GAP)
    if not stretches:
        return []
    share = np.median(detail[covered(stretches, len(clip))]) / np.median(detail[shown])
    message = (
        f"blurred, or without texture: {frames_of(clip, stretches)} show {share:.0%} of the usual detail (a smear on "
        "the lens, defocus, or tissue very near)"
    )
    return [Finding("warning", "blurred", message, clip.selecting(stretches), clip.positions(stretches))]
