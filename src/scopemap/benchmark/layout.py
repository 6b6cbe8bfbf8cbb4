"""From figures to a table: where each column's figure lies in a result, and which value of a column is the best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from scopemap.benchmark.summary import MIN_COVERAGE, Summary
from scopemap.benchmark.table import Better, Cell, Column, Table, Value, best_of

BOLD = (
    f"Bold: the best of a sequence, where all runs came to an end and at least {100 * MIN_COVERAGE:g} % of the frames "
    "were tracked; TLR: the nearest to 1; values that print alike are all bold."
)
SEEDS = "Over several seeds: mean of two, median of more"


@dataclass(frozen=True)
class Figure:
    """A column of figures.

    Attributes
    ----------
    group, key : where the figure lies: `RunResult.figures[group][key]`, or `RunResult.timing[key]` for "timing"; points
        in the key lead into groups within the group.
    title, unit, digits, better : of the column. factor : from the stored to the printed unit.
    spread_key : what stands behind "±", in the same group; empty: half the range over the seeds, if `seeds`.
    """

    group: str
    key: str
    title: str
    unit: str = ""
    digits: int = 3
    better: Better = "lower"
    spread_key: str = ""
    factor: float = 1.0
    seeds: bool = False

    @property
    def column(self) -> Column:
        """How it is headed."""
        spread = "std" if self.spread_key else "half range over seeds"
        return Column(self.title, self.unit, self.better, self.digits, spread, self.group == "timing")

    def value(self, summary: Summary) -> Value:
        """Return the figure of one method on one sequence, in the printed unit."""
        found = summary.value(self.group, self.key)
        spread = found.spread if self.seeds else math.nan
        if self.spread_key:
            spread = summary.value(self.group, self.spread_key).mean
        return Value(self.factor * found.mean, self.factor * spread)


@dataclass(frozen=True)
class Line:
    """A row that is still to be judged.

    Attributes
    ----------
    texts : its cells of text. values : its figures. group : lines of one group compete for the best value.
    competes : whether this one does. failure : stands in the place of the first figure where a method died.
    """

    texts: tuple[str, ...]
    values: tuple[Value, ...]
    group: tuple[str, ...] = ()
    competes: bool = True
    failure: str = ""

    def cells(self) -> tuple[Cell, ...]:
        """Return the row."""
        first: tuple[Cell, ...] = (self.failure,) if self.failure and self.values else self.values[:1]
        return (*self.texts, *first, *self.values[1:])


def line_of(
    summary: Summary,
    texts: tuple[str, ...],
    figures: Sequence[Figure],
    *,
    reached: tuple[str, ...] = (),
    reason: bool = False,
) -> Line:
    """Return the line of one method on one sequence; a failed one says so, with the `reason` if wanted.

    Lines of a sequence compete where their figures were `reached` alike: by the same alignment, for one.
    """
    failure = summary.failure if reason or not summary.failure else "failed"
    values = tuple(figure.value(summary) for figure in figures)
    return Line(texts, values, (summary.sequence, *reached), summary.competes, failure)


def alignment_of(summary: Summary) -> str:
    """Return how the trajectory was aligned with the truth; empty where it was not."""
    return summary.text("poses", "align")


def lay_out(table: Table, texts: Sequence[str], figures: Sequence[Figure], lines: Sequence[Line]) -> Table:
    """Return a table's name, title and caption with these columns and lines, the best values marked."""
    columns = (*(Column(text) for text in texts), *(figure.column for figure in figures))
    marks = {
        (row, len(texts) + place)
        for group in {line.group for line in lines}
        for place, figure in enumerate(figures)
        for row in _best_rows(lines, group, place, figure)
    }
    rows = tuple(line.cells() for line in lines)
    return Table(table.name, table.title, table.caption, columns, rows, frozenset(marks))


def _best_rows(lines: Sequence[Line], group: tuple[str, ...], place: int, figure: Figure) -> list[int]:
    rows = [row for row, line in enumerate(lines) if line.group == group and line.competes and not line.failure]
    best = best_of([lines[row].values[place].mean for row in rows], figure.better, figure.digits)
    return [rows[position] for position in best]
