"""Frames that are skipped because they repeat the last one kept or exceed the rate; the others keep their numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial

from scopemap.engine.errors import SettingsError
from scopemap.input.picture_difference import is_at_rest, is_repeat
from scopemap.input.source import SkippedFrame, SourceFrame

_SLICE = re.compile(r"(-?\d{1,15})?:(-?\d{1,15})?(:\d{0,15})?")
# Rounding of stamps to milliseconds must not skip a frame; the tolerance is at most a share of a frame.
_SLACK_S = 1e-3
_SLACK_SHARE = 0.25


@dataclass(frozen=True)
class FrameChoice:
    """Which of the selected frames are used.

    fps : at most so many frames per second, by the time stamps; None: all. skip_repeated : leave out pictures that
    repeat the last one used, but for noise. skipped : by number, those left out so far; grows while frames are read.
    """

    fps: float | None = None
    skip_repeated: bool = False
    skipped: dict[int, SkippedFrame] = field(default_factory=dict)

    def __call__(self, frames: Iterable[SourceFrame]) -> Iterator[SourceFrame]:
        """Yield the frames that are used; the first always is."""
        start_s, taken, last = math.nan, -math.inf, None
        for frame in frames:
            start_s = frame.time_s if last is None else start_s
            due = math.inf
            if self.fps is not None:
                due = math.floor((frame.time_s - start_s) * self.fps + min(_SLACK_S * self.fps, _SLACK_SHARE))
            skipped = partial(SkippedFrame, frame.index, frame.time_s, frame.name)
            if due <= taken and self.fps is not None:
                self.skipped[frame.index] = skipped("thinned", f"beyond {self.fps:g} frames/s")
            elif last is not None and self.skip_repeated and is_repeat(last.rgb, frame.rgb):
                self.skipped[frame.index] = skipped("repeated", f"repeats frame {last.index}")
            elif last is not None and self.skip_repeated and is_at_rest(last.rgb, frame.rgb):
                self.skipped[frame.index] = skipped("repeated", f"at rest: as frame {last.index}, but for noise")
            else:
                taken, last = due, frame
                yield frame


def slice_of(frames: slice | str | None) -> slice:
    """Return the slice of "A:B:S", a Python slice over the input's frames; A, B and S may be left out, None: all.

    Raises `SettingsError`.
    """
    if frames is None or isinstance(frames, slice):
        return frames or slice(None)
    if not isinstance(frames, str) or not _SLICE.fullmatch(frames):
        expected = "expected START:STOP or START:STOP:STEP such as 0:100, in Python a slice, too"
        raise SettingsError(f"cannot read the frames '{str(frames)[:80]}': {expected}")
    return slice(*(int(part) if part else None for part in frames.split(":")))


def selection_text(selection: slice) -> str:
    """Return the text of a slice as `slice_of` reads it; "" for all frames."""
    if selection == slice(None):
        return ""
    start, stop, step = (
        "" if part is None else str(part) for part in (selection.start, selection.stop, selection.step)
    )
    return f"{start}:{stop}" + (f":{step}" if step else "")
