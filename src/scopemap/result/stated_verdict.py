"""The verdict on a result, as its run has stated it."""

from __future__ import annotations

from typing import NamedTuple

from scopemap.engine.notices import Level


class StatedVerdict(NamedTuple):
    """The verdict on a result: the level (good, doubtful, bad) and the codes of its reasons, worst first."""

    level: Level
    codes: tuple[str, ...]
