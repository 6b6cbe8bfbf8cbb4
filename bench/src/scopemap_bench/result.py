"""RunResult: the figures of one method on one sequence, kept as `result.json` in the run's folder."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from scopemap.engine.errors import InputError
from scopemap.result.json_numbers import without_nan

FILE_NAME = "result.json"
Figures = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class RunResult:
    """One row of a benchmark.

    sequence, method, seed : what was run; names as in the plan.
    status : "failed" where the method died, "missing" without its packages, weights or trajectory; `error` is the
    reason in a line.
    figures : by group: "poses" (`pose_report`), "paper" (`paper_figures`), "depth", "consistency", "surface", and named
    protocols; what could not be measured is absent, or NaN (null in the file).
    timing : "ms_per_frame", "track_ms_per_frame", "seconds_STAGE", "peak_memory_mb"; not the same in two runs.
    facts : machine, commit, versions, settings, alignment, depth, quality of the truth.
    """

    sequence: str
    method: str
    seed: int = 0
    status: Literal["done", "failed", "missing"] = "done"
    error: str = ""
    figures: Figures = field(default_factory=dict)
    timing: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)

    def figure(self, group: str, name: str) -> float:
        """Return one figure, a nested one as "part.name"; NaN where it is absent or was not measured."""
        value: Any = self.figures.get(group, {})
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        return float(value) if isinstance(value, int | float) else math.nan

    def save(self, folder: Path) -> None:
        """Write `result.json`; the file appears whole or not at all."""
        draft = Path(folder) / f"{FILE_NAME}.part"
        draft.write_text(json.dumps(without_nan(asdict(self)), indent=2) + "\n", encoding="utf-8")
        draft.replace(Path(folder) / FILE_NAME)

    @classmethod
    def load(cls, folder: Path) -> RunResult:
        """Read `result.json`; raises `InputError` where it is missing or cannot be read."""
        path = Path(folder) / FILE_NAME
        try:
            return cls(**json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise InputError(f"cannot read the result of a benchmark run {path}: {error}") from None
