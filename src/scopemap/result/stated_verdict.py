"""The verdict on a result, as its run has stated it."""

from __future__ import annotations

from typing import NamedTuple


class StatedVerdict(NamedTuple):
    """The verdict on a result: the level (good, doubtful, bad) and the codes of its reasons, worst first."""

    level: str
    codes: tuple[str, ...]
