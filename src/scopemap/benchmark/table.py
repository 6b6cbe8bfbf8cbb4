"""A table and its three forms: Markdown for people, CSV for programs, LaTeX (booktabs) for papers.

All forms are functions of the table alone: no date, no order of a set, no width of a terminal.
"""

from __future__ import annotations

import csv
import io
import math
import re
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

Better = Literal["lower", "higher", "one", ""]
"""Which value of a column is the best: the lowest, the highest, the nearest to 1; empty: none is."""

_ARROWS = {"lower": " ↓", "higher": " ↑", "one": " →1", "": ""}
_LATEX_ARROWS = {"lower": r" $\downarrow$", "higher": r" $\uparrow$", "one": r" $\to 1$", "": ""}
_LATEX = {
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    # Behind a line's end LaTeX would take it for an option.
    "[": "{[}",
    "±": r"$\pm$",
}
_MARKDOWN = re.compile(r"[\\`*|<>]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")


@dataclass(frozen=True)
class Value:
    """A figure and, where it is known, what is printed behind "±"; NaN is an empty cell."""

    mean: float
    spread: float = math.nan


Cell = str | Value


@dataclass(frozen=True)
class Column:
    """How a column is headed and its figures are printed.

    Attributes
    ----------
    title, unit : of the head; the unit may be empty. better : which value is the best.
    digits : behind the point; None marks a column of text. spread : what stands behind "±", for the CSV's head.
    timing : whether two runs of the same plan may differ here.
    """

    title: str
    unit: str = ""
    better: Better = ""
    digits: int | None = None
    spread: str = "spread"
    timing: bool = False

    @property
    def head(self) -> str:
        """Title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title


@dataclass(frozen=True)
class Table:
    """Rows under columns.

    Attributes
    ----------
    name : of its files. title, caption : for people; the caption says how the figures were reached.
    rows : each as long as `columns`. marks : (row, column) of the best values, printed bold.
    """

    name: str
    title: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    marks: frozenset[tuple[int, int]] = frozenset()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"table '{self.name}': a row of {len(row)} cells under {len(self.columns)} columns")

    def without_timing(self) -> Table:
        """Return the table without the columns that two runs of the same plan do not share."""
        return self._only([place for place, column in enumerate(self.columns) if not column.timing])

    def without_empty(self) -> Table:
        """Return the table without the columns in which no row has a figure."""
        empty = {
            place
            for place in range(len(self.columns))
            if all(isinstance(cell := row[place], Value) and not math.isfinite(cell.mean) for row in self.rows)
        }
        return self._only([place for place in range(len(self.columns)) if place not in empty])

    def _only(self, kept: list[int]) -> Table:
        return replace(
            self,
            columns=tuple(self.columns[place] for place in kept),
            rows=tuple(tuple(row[place] for place in kept) for row in self.rows),
            marks=frozenset((row, kept.index(place)) for row, place in self.marks if place in kept),
        )

    def markdown(self) -> str:
        """Return the rows as a Markdown table, without title and caption."""
        heads = [escape_markdown(column.head) + _ARROWS[column.better] for column in self.columns]
        rules = ["---" if column.digits is None else "---:" for column in self.columns]
        lines = [heads, rules] + [
            [self._cell(row, place, bold="**{}**", markdown=True) for place in range(len(self.columns))]
            for row in range(len(self.rows))
        ]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def csv(self) -> str:
        """Return the rows as CSV: figures to six significant digits, what stands behind "±" in a column of its own."""
        with_spread = {
            place
            for place in range(len(self.columns))
            for row in self.rows
            if isinstance(cell := row[place], Value) and math.isfinite(cell.spread)
        }
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self._csv_heads(with_spread))
        for row in self.rows:
            writer.writerow([part for place, cell in enumerate(row) for part in _csv_parts(cell, place in with_spread)])
        return text.getvalue()

    def latex(self) -> str:
        """Return a floating table; its document needs the packages booktabs and graphicx."""
        layout = "".join("l" if column.digits is None else "r" for column in self.columns)
        heads = [_escape_latex(column.head) + _LATEX_ARROWS[column.better] for column in self.columns]
        lines = [
            "% needs \\usepackage{booktabs,graphicx}",
            r"\begin{table*}",
            r"\centering",
            rf"\caption{{{_escape_latex(f'{self.title}. {self.caption}')}}}",
            rf"\label{{tab:{re.sub('[^A-Za-z0-9-]+', '-', self.name)}}}",
            r"\resizebox{\textwidth}{!}{%",
            rf"\begin{{tabular}}{{{layout}}}",
            r"\toprule",
            " & ".join(heads) + r" \\",
            *self._latex_rows(),
            r"\bottomrule",
            r"\end{tabular}}",
            r"\end{table*}",
        ]
        return "\n".join(lines) + "\n"

    def _latex_rows(self) -> list[str]:
        lines = [r"\midrule"] if self.rows else []
        firsts = [row[0] for row in self.rows]
        # A rule where the first column changes, unless it changes with every row: then it groups nothing.
        grouped = any(above == below for above, below in pairwise(firsts))
        for row, first in enumerate(firsts):
            if grouped and row and firsts[row - 1] != first:
                lines.append(r"\midrule")
            cells = [
                self._cell(row, place, bold=r"\textbf{{{}}}", markdown=False) for place in range(len(self.columns))
            ]
            lines.append(" & ".join(cells) + r" \\")
        return lines

    def _cell(self, row: int, place: int, *, bold: str, markdown: bool) -> str:
        cell, digits = self.rows[row][place], self.columns[place].digits
        plain = cell if isinstance(cell, str) else _shown(cell, digits)
        text = escape_markdown(plain) if markdown else _escape_latex(plain)
        return bold.format(text) if (row, place) in self.marks else text

    def _csv_heads(self, with_spread: set[int]) -> list[str]:
        heads = []
        for place, column in enumerate(self.columns):
            unit = f" [{column.unit}]" if column.unit else ""
            heads.append(column.title + unit)
            if place in with_spread:
                heads.append(f"{column.title} {column.spread}{unit}")
        return heads


def best_of(values: list[float], better: Better, digits: int) -> list[int]:
    """Return the places of the best values, as they are printed with `digits`; none where fewer than two compete."""
    known = [place for place, value in enumerate(values) if math.isfinite(value)]
    if len(known) < 2 or not better:
        return []
    ranks = {place: _rank(round(values[place], digits), better) for place in known}
    return [place for place in known if ranks[place] == min(ranks.values())]


def _rank(value: float, better: Better) -> float:
    """Lower is better, whatever the column says."""
    if better == "higher":
        return -value
    # Rounded again: 1.1 - 1 and 1 - 0.9 differ in the last bit.
    return round(abs(value - 1.0), 9) if better == "one" else value


def _shown(value: Value, digits: int | None) -> str:
    if not math.isfinite(value.mean):
        return ""
    text = _number(value.mean, digits)
    return f"{text} ± {_number(value.spread, digits)}" if math.isfinite(value.spread) else text


def _number(value: float, digits: int | None) -> str:
    text = f"{value:.{digits or 0}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def _csv_parts(cell: Cell, with_spread: bool) -> list[str]:
    if isinstance(cell, str):
        parts = [_one_line(cell), ""]
    else:
        parts = [f"{part:.6g}" if math.isfinite(part) else "" for part in (cell.mean, cell.spread)]
    return parts if with_spread else parts[:1]


def _one_line(text: str) -> str:
    return " ".join(text.split())


def escape_markdown(text: str) -> str:
    """Return text as one line that Markdown shows as it is, in a cell of a table, too."""
    return _MARKDOWN.sub(r"\\\g<0>", _one_line(text))


def _escape_latex(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in _one_line(text))
