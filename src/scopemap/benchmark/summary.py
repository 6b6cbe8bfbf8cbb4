"""The runs of one method on one sequence, over the seeds, as one row of a table."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from scopemap.benchmark.result import RunResult
from scopemap.benchmark.table import Value

MIN_COVERAGE = 0.9
"""Share of the frames that a method must track for its figures to compete: who loses the hard frames errs less."""

_LONGEST_ERROR = 80


@dataclass(frozen=True)
class Summary:
    """What one method reached on one sequence.

    Attributes
    ----------
    sequence, method : names as the plan gives them. runs : one per seed, failed ones included.
    frames_of_sequence : the most frames with a true pose that any method's run on the sequence has; one that ended
        early has fewer.
    """

    sequence: str
    method: str
    runs: tuple[RunResult, ...]
    frames_of_sequence: int = 0

    @property
    def done(self) -> tuple[RunResult, ...]:
        """The runs that came to an end."""
        return tuple(run for run in self.runs if run.status == "done")

    @property
    def failure(self) -> str:
        """Why no run came to an end, in one short line; empty where one did."""
        if self.done:
            return ""
        reason = " ".join(self.runs[0].error.split())
        short = reason if len(reason) <= _LONGEST_ERROR else f"{reason[: _LONGEST_ERROR - 1]}…"
        return f"failed: {short}" if short else "failed"

    @property
    def count(self) -> str:
        """Number of runs, and how many of them came to an end where not all did."""
        return str(len(self.runs)) if len(self.done) == len(self.runs) else f"{len(self.done)} of {len(self.runs)}"

    @property
    def frames(self) -> tuple[int, int]:
        """Tracked frames and those of the sequence, of all finished runs together; zeros where no poses were scored."""
        tracked = [run.figure("poses", "tracked") for run in self.done]
        scored = [int(count) for count in tracked if math.isfinite(count)]
        return sum(scored), len(scored) * self.frames_of_sequence

    @property
    def coverage(self) -> float:
        """Share of the sequence's frames that were tracked, 0..1; NaN where no poses were scored."""
        tracked, frames = self.frames
        return tracked / frames if frames else math.nan

    @property
    def tracked(self) -> str:
        """Frames tracked, for people: "270 of 276"; empty where no poses were scored."""
        tracked, frames = self.frames
        return f"{tracked} of {frames}" if frames else ""

    @property
    def competes(self) -> bool:
        """Whether its figures may be called the best: every run came to an end and tracked enough frames."""
        return len(self.done) == len(self.runs) and not self.coverage < MIN_COVERAGE

    def value(self, group: str, key: str) -> Value:
        """Return a figure over the runs, as `over_seeds` joins them; NaN where there is none.

        Group "timing" is `RunResult.timing`; points in the key lead into groups within the group ("opw.mean_mm").
        """
        if group == "timing":
            # A time that was not measured is null in the file.
            times = [run.timing.get(key) for run in self.done]
            return over_seeds([math.nan if time is None else time for time in times])
        return over_seeds([run.figure(group, key) for run in self.done])

    def text(self, group: str, key: str) -> str:
        """Return a word that is kept among the figures ("align" of "poses"); runs that differ are all named."""
        words = [run.figures.get(group, {}).get(key) for run in self.done]
        return "/".join(dict.fromkeys(word for word in words if isinstance(word, str)))


def summarise(results: Iterable[RunResult]) -> tuple[Summary, ...]:
    """Group results by sequence, then method, both in the order in which they first appear; runs by seed.

    A sequence that bears its seed behind its name ("colon, seed 1"), as those of a plan do, is that sequence.
    """
    runs: dict[str, dict[str, list[RunResult]]] = {}
    for result in results:
        sequence = result.sequence.removesuffix(f", seed {result.seed}")
        runs.setdefault(sequence, {}).setdefault(result.method, []).append(result)
    return tuple(
        Summary(sequence, method, tuple(sorted(of_method, key=lambda run: run.seed)), _frames(of_sequence))
        for sequence, of_sequence in runs.items()
        for method, of_method in of_sequence.items()
    )


def _frames(of_sequence: dict[str, list[RunResult]]) -> int:
    counts = [run.figure("poses", "frames") for of_method in of_sequence.values() for run in of_method]
    return int(max((count for count in counts if math.isfinite(count)), default=0))


def over_seeds(values: Sequence[float]) -> Value:
    """Return the mean of one or two known values, the median of more; the spread is half their range if several."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return Value(math.nan)
    centre = statistics.median(known) if len(known) >= 3 else statistics.fmean(known)
    return Value(centre, 0.5 * (max(known) - min(known)) if len(known) > 1 else math.nan)
