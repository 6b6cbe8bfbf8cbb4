"""The segments of a video in which the camera was lost: when, why, and what the operator can do about it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from scopemap.engine.tracking.causes import LossCause
from scopemap.input.trajectory.trajectory import SKIPPED
from scopemap.result.frame_table import FrameTable

ADVICE = {
    LossCause.FAST_MOTION: "Next time, turn and withdraw more slowly, and record every frame.",
    LossCause.MOTION_BLUR: "Next time, move more slowly; more light shortens the exposure.",
    LossCause.UNSHARP: "Next time, rinse the lens and remove smoke and fluid before moving on.",
    LossCause.TOO_DARK: "Next time, go nearer or turn the light up.",
    LossCause.OVEREXPOSED: "Next time, withdraw from the wall until it is no longer white.",
    LossCause.VIEW_COVERED: "Next time, withdraw from the wall or remove what covers the view.",
    LossCause.CONTACT: "Next time, withdraw from the wall until the lumen or a fold is in view.",
    LossCause.NO_TEXTURE: "Next time, keep folds or vessels in view.",
    LossCause.VIEW_CHANGED: "Next time, hold the camera still while tissue or instruments move.",
    LossCause.NOT_FOUND_AGAIN: "Next time, return to the last place and look from a similar angle.",
    LossCause.OTHER: "See the reason in frames.csv.",
}
"""What can be done, by the cause of a loss."""


@dataclass(frozen=True)
class LostSegment:
    """Successive frames that are lost: the rows and times of the first and the last, s, their number, and the cause."""

    first: int
    last: int
    begin_s: float
    end_s: float
    frames: int
    cause: LossCause

    @property
    def advice(self) -> str:
        """What the operator can do about it."""
        return ADVICE.get(self.cause, "")

    @property
    def size(self) -> str:
        """The number of frames in words."""
        return "1 frame" if self.frames == 1 else f"{self.frames} frames"

    @property
    def when(self) -> str:
        """The time in words."""
        return f"{self.begin_s:.2f} s" if self.first == self.last else f"{self.begin_s:.2f} to {self.end_s:.2f} s"


def losses(frames: FrameTable) -> list[LostSegment]:
    """Return the segments of lost frames of a run, in order; frames that were not used do not end one."""
    found, is_lost = [], frames.lost
    for lost, group in groupby(np.flatnonzero(frames["status"] != SKIPPED).tolist(), lambda row: is_lost[row]):
        rows = list(group)
        if lost:
            begin_s, end_s = (float(frames["time_s"][row]) for row in (rows[0], rows[-1]))
            counts = Counter(map(LossCause, frames["cause"][rows].tolist()))
            # What began the loss counts, not that the camera is not found again later.
            began = [cause for cause in counts if cause is not LossCause.NOT_FOUND_AGAIN]
            cause = max(began or counts, key=lambda cause: counts[cause])
            found.append(LostSegment(rows[0], rows[-1], begin_s, end_s, len(rows), cause))
    return found


def main_cause(found: list[LostSegment]) -> LossCause:
    """Return the cause of most of the lost frames; `NONE` where nothing is known of it."""
    frames: Counter[LossCause] = Counter()
    for loss in found:
        if loss.cause:
            frames[loss.cause] += loss.frames
    return frames.most_common(1)[0][0] if frames else LossCause.NONE
