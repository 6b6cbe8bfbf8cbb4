"""Pictures that repeat the last one, singly as conversions between rates make them, or frozen for a while."""

from __future__ import annotations

import numpy as np

from scopemap.inspection.clip import Clip, frames_of
from scopemap.inspection.finding import Finding, covered, stretches_of
from scopemap.io.video_format.redundant_frames import LEAST_DIFFERENCE

_FREEZE_S, _FREEZE_FRAMES = 0.3, 4


def repeated(clip: Clip) -> np.ndarray:
    """Return which pictures repeat the last one that did not, (N,) bool; what shows nothing repeats nothing."""
    return (clip["change"] < LEAST_DIFFERENCE) & ~clip["blank"]


def check_repeats(clip: Clip) -> list[Finding]:
    """Return duplicates and frozen stretches."""
    flags = repeated(clip)
    frozen = stretches_of(flags, clip.frames_in(_FREEZE_S, _FREEZE_FRAMES))
    single = stretches_of(flags & ~covered(frozen, len(clip)))
    left_out = "runs leave them out (--set input.skip_duplicates=false keeps them)"
    found = []
    if frozen:
        message = f"the picture is frozen for {frames_of(clip, frozen)}"
        found.append(Finding("warning", "frozen", message, left_out, clip.positions(frozen)))
    if single:
        message = f"the same picture as before: {frames_of(clip, single)}{_rhythm(single) if clip.step == 1 else ''}"
        found.append(Finding("info", "duplicates", message, left_out, clip.positions(single)))
    return found


def _rhythm(single: tuple[tuple[int, int], ...]) -> str:
    """Say so where duplicates come at an even pace, as from 25 to 30 pictures per second."""
    steps = np.diff([first for first, _ in single])
    if steps.size < 3 or np.percentile(steps, 90) - np.percentile(steps, 10) > 1:
        return ""
    return f", about every {np.median(steps):.0f}th: the video was converted to a higher rate"
