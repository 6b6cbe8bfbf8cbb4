"""Pictures from all parts of an input, each with the one after it that shows another moment."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import TypeVar

import numpy as np

from scopemap.input.picture_difference import is_repeat

SAMPLED_EVERY = 10
"""A picture out of so many is looked at where an input can only be read in order."""

MOST_REPEATS = 4
"""Pictures after a sample among which one that differs from it is sought."""

_Frame = TypeVar("_Frame")
SampledPair = tuple[np.ndarray, np.ndarray]
"""A picture (h, w, 3) uint8, and the next one of its size that does not repeat it; itself where there is none."""


def pair_of(pictures: Iterable[np.ndarray]) -> SampledPair | None:
    """Return the first of successive pictures with the next one that differs from it; None without any."""
    following = iter(pictures)
    first = next(following, None)
    if first is None:
        return None
    same_size = (rgb for rgb in islice(following, MOST_REPEATS) if rgb.shape == first.shape)
    return first, next((rgb for rgb in same_size if not is_repeat(first, rgb)), first)


def pairs_in_order(frames: Iterator[_Frame], count: int, picture: Callable[[_Frame], np.ndarray]) -> list[SampledPair]:
    """Return up to `count` pairs of an input that is read in order, from its begin on.

    picture : returns that of a frame; it is called for the frames that are looked at.
    """
    found, run = list[SampledPair](), islice(frames, 0)
    for _ in range(count):
        deque(run, maxlen=0)
        run = islice(frames, SAMPLED_EVERY)
        pair = pair_of(map(picture, run))
        if pair is None:
            break
        found.append(pair)
    return found
