"""Rows of results and tables of them, the best figures marked, as Markdown, CSV and LaTeX (booktabs).

Rows are a data frame. Its columns are texts, the figures by their keys ("poses.ate_rmse_mm"), the spread printed after
"±" ("poses.ate_rmse_mm ±"), "failure" (empty where the method came to an end) and "competes" (whether figures
of the row may be the best).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import pandas as pd

from scopemap_bench.result import RunResult

Better = Literal["lower", "higher", "one", ""]
"""Which value of a column is the best: the lowest, the highest, the nearest to 1; empty: none is."""

SPREAD = " ±"
"""Behind the key of a figure: its half range over the seeds, NaN for one seed."""

_ARROWS = {"lower": " ↓", "higher": " ↑", "one": " →1", "": ""}
_LATEX_ARROWS = {"lower": r" $\downarrow$", "higher": r" $\uparrow$", "one": r" $\to 1$", "": ""}
_LATEX = str.maketrans(
    {letter: f"\\{letter}" for letter in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
    # At the start of a line LaTeX would take it for an option of the line break before.
    | {"[": "{[}"}
)
_MARKDOWN = re.compile(r"[\\`*|<>]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")
MIN_COVERAGE = 0.9
"""Share of the frames that a method must track for its figures to compete: a method that loses the hard frames has
smaller errors."""

_LONGEST_ERROR = 80
# Columns of text, and where the runs keep their words: rows compete where the figures were measured alike.
_WORDS = {"alignment": "poses.align", "path": "poses.straight", "turn": "poses.turn", "surface turn": "surface.turn"}
_WORDS |= {"contradiction": "poses.contradiction", "flow": "consistency.flow", "scaling": "depth.scaling"}
_WORDS |= {"depth": "facts.depth"}


@dataclass(frozen=True)
class Figure:
    """A column of figures.

    key : "group.name". digits : behind the point. better : which value is the best. factor : from the stored to the
    printed unit. spread_key : what stands behind "±"; empty: the half range over the seeds, if `seeds`. unless : column
    of text whose word stands instead of the figure, which then does not compete.
    """

    key: str
    title: str
    unit: str = ""
    digits: int = 3
    better: Better = "lower"
    spread_key: str = ""
    factor: float = 1.0
    seeds: bool = False
    unless: str = ""

    @property
    def head(self) -> str:
        """Title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    @property
    def csv_heads(self) -> tuple[str, str]:
        """Heads of the column and of its spread in a CSV file."""
        unit = f" [{self.unit}]" if self.unit else ""
        spread = "std" if self.spread_key else "half range over seeds"
        return f"{self.title}{unit}", f"{self.title} {spread}{unit}"

    def values(self, rows: pd.DataFrame) -> tuple[pd.Series, pd.Series]:
        """Return the figures and what stands behind "±", both in the printed unit, NaN where there is none."""
        spread_key = self.spread_key or (self.key + SPREAD if self.seeds else "")
        found = rows.reindex(columns=[self.key, spread_key]).astype(float) * self.factor
        found = found.where(self.words(rows) == "")
        return found[self.key], found[spread_key]

    def words(self, rows: pd.DataFrame) -> pd.Series:
        """Return the words that stand instead of the figure, "" where it stands."""
        return rows[self.unless] if self.unless else pd.Series("", index=rows.index)

    def texts(self, rows: pd.DataFrame) -> list[str]:
        """Return the figures as they are printed, the word of `unless` instead of them, "" where there is none."""
        values = zip(*self.values(rows), self.words(rows), strict=True)
        return [word or self.text(value, spread) for value, spread, word in values]

    def text(self, value: float, spread: float = math.nan) -> str:
        """Return a figure as it is printed; "" for NaN."""
        if math.isnan(value):
            return ""
        number = f"{value:.{self.digits}f}"
        number = number.removeprefix("-") if float(number) == 0 else number
        return number if math.isnan(spread) else f"{number} ± {spread:.{self.digits}f}"

    def best(self, values: pd.Series, groups: Sequence[pd.Series]) -> pd.Series:
        """Return which values are the best of their group, as printed; NaN and single values do not compete."""
        if not self.better:
            return pd.Series(False, index=values.index)
        cost = values.map(lambda value: round(value, self.digits))
        cost = {"lower": cost, "higher": -cost, "one": (cost - 1).abs().round(9)}[self.better]
        grouped = cost.groupby(list(groups))
        return (cost == grouped.transform("min")) & (grouped.transform("count") > 1)


@dataclass(frozen=True)
class Table:
    """Rows (see the module's docstring) under columns of text and of figures.

    name : of its files. caption : describes how the figures were measured. texts : names of the columns of text.
    compete_within : columns of `rows`; values compete where these are equal.
    """

    name: str
    title: str
    caption: str
    texts: tuple[str, ...]
    figures: tuple[Figure, ...]
    rows: pd.DataFrame
    compete_within: tuple[str, ...] = ()

    def without_empty(self) -> Table:
        """Return the table without the columns in which no row has a text or a figure."""
        texts = tuple(text for text in self.texts if (self.rows[text] != "").any())
        figures = tuple(figure for figure in self.figures if figure.values(self.rows)[0].notna().any())
        return replace(self, texts=texts, figures=figures or self.figures[:1])

    def markdown(self) -> str:
        """Return the rows as a Markdown table, without title and caption."""
        heads = [escape_markdown(text) for text in self.texts]
        heads += [escape_markdown(figure.head) + _ARROWS[figure.better] for figure in self.figures]
        rules = ["---"] * len(self.texts) + ["---:"] * len(self.figures)
        lines = [heads, rules, *self._cells(escape_markdown, "**{}**").to_numpy().tolist()]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def csv(self) -> str:
        """Return the rows as CSV: figures to six significant digits, what stands behind "±" in a column of its own."""
        cells = self.rows[list(self.texts)].map(_one_line)
        for number, figure in enumerate(self.figures):
            values, spreads = (column.map(_six_digits) for column in figure.values(self.rows))
            cells[figure.csv_heads[0]] = values if number else values.where(self.rows["failure"] == "", self._failures)
            if (spreads != "").any():
                cells[figure.csv_heads[1]] = spreads
        return str(cells.to_csv(index=False, lineterminator="\n"))

    def latex(self) -> str:
        """Return a floating table; its document needs the packages booktabs and graphicx."""
        cells = self._cells(_escape_latex, r"\textbf{{{}}}")
        cells.columns = [_escape_latex(text) for text in self.texts] + [
            _escape_latex(figure.head) + _LATEX_ARROWS[figure.better] for figure in self.figures
        ]
        layout = "l" * len(self.texts) + "r" * len(self.figures)
        tabular = cells.to_latex(index=False, escape=False, column_format=layout)
        return (
            "% needs \\usepackage{booktabs,graphicx}\n\\begin{table*}\n\\centering\n"
            f"\\caption{{{_escape_latex(f'{self.title}. {self.caption}')}}}\n"
            f"\\label{{tab:{re.sub('[^A-Za-z0-9-]+', '-', self.name)}}}\n"
            f"\\resizebox{{\\textwidth}}{{!}}{{%\n{tabular.rstrip()}}}\n\\end{{table*}}\n"
        )

    @property
    def _failures(self) -> pd.Series:
        return self.rows["failure"].map(_one_line)

    def _cells(self, escape: Callable[[str], str], bold: str) -> pd.DataFrame:
        """Return the cells as texts; the first figure of a row that failed is the failure."""
        cells = self.rows[list(self.texts)].map(escape)
        groups = [self.rows[name] for name in self.compete_within]
        # By whatever alignment: a camera that stands still has none to withhold a figure for.
        anyhow = [self.rows[name] for name in self.compete_within if name != "alignment"]
        everywhere = pd.Series(True, index=self.rows.index)
        for number, figure in enumerate(self.figures):
            values, _ = figure.values(self.rows)
            column = pd.Series(figure.texts(self.rows), index=cells.index, dtype=object).map(escape)
            best = figure.best(values.where(self.rows["competes"]), groups or [everywhere])
            withheld = (figure.words(self.rows) != "") & self.rows["competes"]
            best &= ~withheld.groupby(anyhow or [everywhere]).transform("any")
            column = column.where(~best, column.map(bold.format))
            if number == 0:
                column = column.where(self.rows["failure"] == "", self._failures.map(escape))
            cells[figure.head] = column
        return cells


def _one_line(text: Any) -> str:
    return " ".join(str(text).split())


def escape_markdown(text: str) -> str:
    """Return text as one line that Markdown shows as it is, also in a cell of a table."""
    return _MARKDOWN.sub(r"\\\g<0>", _one_line(text))


def _escape_latex(text: str) -> str:
    return _one_line(text).translate(_LATEX)


def _six_digits(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def summarise(results: Iterable[RunResult]) -> pd.DataFrame:
    """Return one row per sequence and method, both in the order in which they first appear.

    Figures are medians over the seeds, by "group.name", with half their range under the same name and `SPREAD`. Further
    columns: "sequence", "method", "runs", "frames tracked", "alignment", "path", "depth", "flow", "scaling", "failure",
    "done", "competes", "tracked", "frames", "turn", "surface turn", "contradiction". A sequence with its seed
    ("colon, seed 1") is without it.
    """
    runs = _runs(results)
    order = {name: place for place, name in enumerate(dict.fromkeys(runs["sequence"]))}
    runs = runs.sort_values("sequence", key=lambda names: names.map(order), kind="stable", ignore_index=True)
    by = [runs["sequence"], runs["method"]]
    figures = runs.drop(columns=["sequence", "method", "done", "error", *_columns_of(runs, str | list)])
    figures = figures.map(lambda cell: cell if isinstance(cell, int | float) and math.isfinite(cell) else math.nan)
    figures = figures.astype(float)
    over_seeds = figures.groupby(by, sort=False)
    half_range = (0.5 * (over_seeds.max() - over_seeds.min())).where(over_seeds.count() > 1)
    rows = over_seeds.median().join(half_range.add_suffix(SPREAD))

    count, rows["done"] = over_seeds.size(), runs["done"].groupby(by, sort=False).sum()
    tracked = over_seeds["poses.tracked"]
    longest = figures["poses.frames"].groupby(runs["sequence"]).max()
    rows["tracked"] = tracked.sum()
    # A run that ended early has fewer frames than the sequence: the others are lost.
    rows["frames"] = tracked.count() * longest.reindex(rows.index.get_level_values("sequence")).to_numpy()
    rows["competes"] = (rows["done"] == count) & ~(rows["tracked"] / rows["frames"] < MIN_COVERAGE)
    rows["runs"] = [str(n) if done == n else f"{done} of {n}" for n, done in zip(count, rows["done"], strict=True)]
    rows["frames tracked"] = of_frames(rows)
    for name, column in _WORDS.items():
        words = runs.get(column, pd.Series("", index=runs.index))
        rows[name] = words.groupby(by, sort=False).agg(joined)
    rows["failure"] = runs["error"].groupby(by, sort=False).first().where(rows["done"] == 0, "")
    return rows.reset_index()


def of_frames(rows: pd.DataFrame) -> list[str]:
    """Return "270 of 276" for the columns "tracked" and "frames"; "" where no poses were scored."""
    pairs = zip(rows["tracked"], rows["frames"], strict=True)
    return [f"{tracked:.0f} of {frames:.0f}" if frames > 0 else "" for tracked, frames in pairs]


def joined(words: Iterable[Any]) -> str:
    """Return the different words, joined by "/"; cells that are no text or empty do not count."""
    return "/".join(dict.fromkeys(word for word in words if isinstance(word, str) and word))


def _runs(results: Iterable[RunResult]) -> pd.DataFrame:
    """Return one row per run, its figures under "group.name", stages also in milliseconds per frame."""
    runs = pd.json_normalize(
        [
            {
                "sequence": result.sequence.removesuffix(f", seed {result.seed}"),
                "method": result.method,
                "done": result.status == "done",
                "error": _reason(result),
                "facts": {"depth": result.facts.get("depth", "")},
                "poses": {"frames": math.nan, "tracked": math.nan},
                **result.figures,
                "timing": _with_stages(result),
            }
            for result in results
        ]
    )
    return runs.reindex(columns=[*runs, *{"poses.frames", "poses.tracked"} - set(runs)])


def _with_stages(result: RunResult) -> dict[str, float]:
    frames = result.figure("poses", "frames")
    stages = {
        f"ms_of_{key.removeprefix('seconds_')}": 1e3 * seconds / frames
        for key, seconds in result.timing.items()
        if key.startswith("seconds_") and key != "seconds_total" and seconds and frames > 0
    }
    return result.timing | stages


def _columns_of(runs: pd.DataFrame, kind: Any) -> list[str]:
    return [name for name in runs if runs[name].map(lambda cell: isinstance(cell, kind)).any()]


def _reason(result: RunResult) -> str:
    """Return why a run has no figures, cut to the width of a cell."""
    reason = " ".join(result.error.split())
    short = reason if len(reason) <= _LONGEST_ERROR else f"{reason[: _LONGEST_ERROR - 1]}…"
    if result.status == "missing":
        return short
    return f"failed: {short}" if short else "failed"
