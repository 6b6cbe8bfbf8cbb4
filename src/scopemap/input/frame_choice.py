"""Frames that are skipped because they repeat the last one kept or exceed the rate; the others keep their numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from scopemap.engine.errors import SettingsError
from scopemap.engine.frame import is_constant
from scopemap.engine.kept import Kept

if TYPE_CHECKING:
    from scopemap.input.source import SourceFrame

_SLICE = re.compile(r"(-?\d{1,15})?:(-?\d{1,15})?(:\d{0,15})?")
LEAST_DIFFERENCE = 0.5
"""Mean absolute difference below which a frame repeats another, grey levels of 255: what lossy coding leaves."""

# Means of so many blocks along the shorter side hold little of a sensor's noise: below these differences (mean, 99th
# percentile), grey levels, the camera and the tissue are at rest. The least of 497 clinical frames were 0.37 and 1.3.
_BLOCKS = 32
_REST = (0.33, 1.2)
_MOST_NOISE = 8.0
# Black borders are the same in all frames: they are not compared.
_BLACK_LEVEL = 16
_COMPARED_SIDE_PX = 160  # at least
_RESTING_SIDE_PX = 256  # every n-th pixel of larger pictures is compared
# Rounding of stamps to milliseconds must not skip a frame; the tolerance is at most a share of a frame.
_SLACK_S = 1e-3
_SLACK_SHARE = 0.25


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that was read and not used: its index, time and name, and why, in one word and as a phrase."""

    index: int
    time_s: float
    name: str
    kind: Literal["repeated", "thinned", "size"]
    reason: str


@dataclass(frozen=True)
class FrameChoice:
    """Which of the selected frames are used.

    fps : at most so many frames per second, by the time stamps; None: all. skip_repeated : leave out pictures that
    repeat the last one used, but for noise. skipped : by number, those left out so far; grows while frames are read.
    """

    fps: float | None = None
    skip_repeated: bool = False
    skipped: Kept[dict[int, SkippedFrame]] = field(default_factory=dict)

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


def mean_difference(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean absolute difference, grey levels, of (h, w, 3) uint8 over pixels not black in both, or all."""
    step = max(1, min(one.shape[:2]) // _COMPARED_SIDE_PX)
    one, other = (np.ascontiguousarray(rgb[::step, ::step]) for rgb in (one, other))
    difference, (red, green, blue) = cv2.absdiff(one, other), cv2.split(cv2.max(one, other))
    lit = (cv2.max(cv2.max(red, green), blue) > _BLACK_LEVEL).astype(np.uint8)
    return float(np.mean(cv2.mean(difference, lit if lit.any() else None)[:3]))


def is_repeat(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two (h, w, 3) uint8 of one size, not constant, differ by no more than lossy coding changes."""
    return mean_difference(one, other) < LEAST_DIFFERENCE and not is_constant(other)


def is_at_rest(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two (h, w, 3) uint8 of one size, not constant, differ by no more than a sensor's noise."""
    if mean_difference(one, other) > _MOST_NOISE:
        return False
    every = max(1, min(one.shape[:2]) // _RESTING_SIDE_PX)
    one, other = (np.ascontiguousarray(rgb[::every, ::every]) for rgb in (one, other))
    height, width = one.shape[:2]
    step = max(1, min(height, width) // _BLOCKS)
    columns, rows = width // step, height // step
    # Blocks of whole pixels take a quarter of the time.
    whole = (rgb[: rows * step, : columns * step] for rgb in (one, other))
    before, now = (cv2.resize(rgb, (columns, rows), interpolation=cv2.INTER_AREA) for rgb in whole)
    change = cv2.absdiff(before, now).mean(axis=2)
    limits = (change.mean() < _REST[0]) & (np.percentile(change, 99) < _REST[1])
    return bool(limits) and not is_constant(now)
