"""The one signature that ours and every baseline share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from scopemap.config import Config
from scopemap.datasets import Sequence


@dataclass(frozen=True)
class Task:
    """What every method is given: the same frames, camera, masks and depth.

    Attributes
    ----------
    sequence : rectified frames; a method sees `frames()`, never the truth.
    config : settings that all methods share: depth, its anchor, masks, fusion. A method changes nothing in `mask` and
        `depth` but what its own description says.
    seed : for methods with chance in them; `name` : of the sequence.
    """

    sequence: Sequence
    config: Config
    seed: int = 0
    name: str = ""


class Method(Protocol):
    """Turns a task into a run's folder, which is then scored by the same code for all.

    Attributes
    ----------
    title : for tables. description : what it is and where it comes from, one or two sentences.
    """

    title: str
    description: str

    def run(self, task: Task, out: Path) -> dict[str, Any]:
        """Write at least trajectory.tum, frames.csv and provenance.json to `out`; return seconds by stage.

        Raises what the method raises: the benchmark makes a row of it.
        """
