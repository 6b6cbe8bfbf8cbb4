"""The one signature that ours and every baseline share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from scopemap.io.sequence import Sequence


@dataclass(frozen=True)
class Task:
    """What every method is given: the same frames, camera, masks and depth.

    Attributes
    ----------
    sequence : rectified frames; a method sees `frames()`, never the truth.
    settings : dotted names to values, shared by all methods: depth and its anchor, masks, fusion.
    seed : for methods with chance in them. name : of the sequence.
    """

    sequence: Sequence
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    name: str = ""


@dataclass(frozen=True)
class Timing:
    """How long a method took; NaN where it was not measured (an imported trajectory).

    Attributes
    ----------
    ms_per_frame : wall time from the first finished frame to the last, per frame: start-up is left out.
    track_ms_per_frame : the odometry alone.
    seconds : by stage; stages in different threads overlap.
    """

    ms_per_frame: float = float("nan")
    track_ms_per_frame: float = float("nan")
    seconds: Mapping[str, float] = field(default_factory=dict)


class Method(Protocol):
    """Turns a task into a run's folder, which is then scored by the same code for all."""

    def run(self, task: Task, out: Path) -> Timing:
        """Write at least trajectory.tum, frames.csv and provenance.json to `out`.

        Raises what the method raises: the benchmark makes a row of it.
        """
