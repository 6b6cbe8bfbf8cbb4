"""What is found in a video: a finding of `datasets.checking` with advice, and stretches of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scopemap.io.datasets import checking

_NAMED = 4

Stretch = tuple[int, int]
"""First and last position of frames that follow each other; positions count from 0, as `--frames` does."""


@dataclass(frozen=True)
class Finding(checking.Finding):
    """One thing that was found.

    Attributes
    ----------
    advice : what to do about it, the option in full, or "".
    stretches : the frames that it is about; empty: the whole video.
    """

    advice: str = ""
    stretches: tuple[Stretch, ...] = ()


def stretches_of(flags: np.ndarray, least: int = 1, gap: int = 0) -> tuple[Stretch, ...]:
    """Return where `flags` (N,) bool is True for `least` frames or more; up to `gap` False between two are bridged."""
    true = np.flatnonzero(flags)
    if not true.size:
        return ()
    cuts = [0, *(i for i, (a, b) in enumerate(pairwise(true), start=1) if b - a > gap + 1), len(true)]
    found = ((int(true[a]), int(true[b - 1])) for a, b in pairwise(cuts))
    return tuple((first, last) for first, last in found if last - first + 1 >= least)


def covered(stretches: Sequence[Stretch], count: int) -> np.ndarray:
    """Return (count,) bool: which frames lie in any of the stretches."""
    flags = np.zeros(count, bool)
    for first, last in stretches:
        flags[first : last + 1] = True
    return flags


def worded(stretches: Sequence[Stretch]) -> str:
    """Return the stretches in words, those after the fourth counted."""
    named = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in stretches[:_NAMED])
    return named + (f" and {len(stretches) - _NAMED} more" if len(stretches) > _NAMED else "")
