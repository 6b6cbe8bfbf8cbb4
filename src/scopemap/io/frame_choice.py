"""Frames that are skipped because they repeat another or exceed the rate; the others keep their numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Literal

from scopemap.io.source import SourceFrame
from scopemap.io.video_format.redundant_frames import is_repeat

# Rounding of stamps to milliseconds must not skip a frame; the tolerance is at most a share of a frame.
_SLACK_S, _SLACK_SHARE = 1e-3, 0.25


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that was read and not used.

    index, time_s, name : the frame's. kind : why, in one word. reason : why, one phrase.
    """

    index: int
    time_s: float
    name: str
    kind: Literal["repeated", "thinned"]
    reason: str


@dataclass(frozen=True)
class FrameChoice:
    """Which of the selected frames are used.

    fps : at most so many frames per second, by the time stamps; None: all. skip_repeated : leave out pictures that
    repeat the last one used. skipped : by number, what was left out so far; grows while frames are read.
    """

    fps: float | None = None
    skip_repeated: bool = False
    skipped: dict[int, SkippedFrame] = field(default_factory=dict)

    def __call__(self, frames: Iterable[SourceFrame]) -> Iterator[SourceFrame]:
        """Yield the frames that are used; the first always is."""
        start_s, taken, last = math.nan, -math.inf, None
        for frame in frames:
            start_s = frame.time_s if last is None else start_s
            due = math.inf if self.fps is None else _slot(frame.time_s - start_s, self.fps)
            if due <= taken and self.fps is not None:
                self._skip(frame, "thinned", f"beyond {self.fps:g} frames/s")
            elif last is not None and self.skip_repeated and is_repeat(last.rgb, frame.rgb):
                self._skip(frame, "repeated", f"repeats frame {last.index}")
            else:
                taken, last = due, frame
                yield frame

    def _skip(self, frame: SourceFrame, kind: Literal["repeated", "thinned"], reason: str) -> None:
        self.skipped[frame.index] = SkippedFrame(frame.index, frame.time_s, frame.name, kind, reason)


def _slot(passed_s: float, fps: float) -> int:
    return math.floor(passed_s * fps + min(_SLACK_S * fps, _SLACK_SHARE))
