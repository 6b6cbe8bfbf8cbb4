"""A table in its three forms, to the letter; which value is the best."""

from __future__ import annotations

import csv
import io
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scopemap.benchmark.table import Column, Table, Value, best_of, escape_markdown

NAN = float("nan")
SMALL = Table(
    "small",
    "A small table",
    "T<T_avg in 50 % of frames.",
    (
        Column("sequence"),
        Column("method"),
        Column("ATE", "mm", "lower", 2, "std"),
        Column("T<T_avg", "%", "higher", 1),
        Column("TLR", "", "one", 3),
        Column("time", "ms", "lower", 0, timing=True),
    ),
    (
        ("cecum_t1_a", "ours", Value(1.005, 0.25), Value(50.0), Value(0.98), Value(66.6)),
        ("cecum_t1_a", "A & B|C", Value(12.5, NAN), Value(NAN), Value(-0.0001), Value(1200.0)),
        ("colon", "Park", "failed", Value(NAN), Value(NAN), Value(NAN)),
    ),
    frozenset({(0, 2), (0, 4), (0, 5)}),
)


def test_markdown_to_the_letter() -> None:
    assert SMALL.markdown() == (
        "| sequence | method | ATE, mm ↓ | T\\<T_avg, % ↑ | TLR →1 | time, ms ↓ |\n"
        "| --- | --- | ---: | ---: | ---: | ---: |\n"
        "| cecum_t1_a | ours | **1.00 ± 0.25** | 50.0 | **0.980** | **67** |\n"
        "| cecum_t1_a | A & B\\|C | 12.50 |  | 0.000 | 1200 |\n"
        "| colon | Park | failed |  |  |  |\n"
    )


def test_csv_to_the_letter() -> None:
    assert SMALL.csv() == (
        "sequence,method,ATE [mm],ATE std [mm],T<T_avg [%],TLR,time [ms]\n"
        "cecum_t1_a,ours,1.005,0.25,50,0.98,66.6\n"
        "cecum_t1_a,A & B|C,12.5,,,-0.0001,1200\n"
        "colon,Park,failed,,,,\n"
    )


def test_latex_to_the_letter() -> None:
    assert SMALL.latex() == (
        "% needs \\usepackage{booktabs,graphicx}\n"
        "\\begin{table*}\n"
        "\\centering\n"
        "\\caption{A small table. T\\textless{}T\\_avg in 50 \\% of frames.}\n"
        "\\label{tab:small}\n"
        "\\resizebox{\\textwidth}{!}{%\n"
        "\\begin{tabular}{llrrrr}\n"
        "\\toprule\n"
        "sequence & method & ATE, mm $\\downarrow$ & T\\textless{}T\\_avg, \\% $\\uparrow$ & TLR $\\to 1$ & "
        "time, ms $\\downarrow$ \\\\\n"
        "\\midrule\n"
        "cecum\\_t1\\_a & ours & \\textbf{1.00 $\\pm$ 0.25} & 50.0 & \\textbf{0.980} & \\textbf{67} \\\\\n"
        "cecum\\_t1\\_a & A \\& B\\textbar{}C & 12.50 &  & 0.000 & 1200 \\\\\n"
        "\\midrule\n"
        "colon & Park & failed &  &  &  \\\\\n"
        "\\bottomrule\n"
        "\\end{tabular}}\n"
        "\\end{table*}\n"
    )


def test_latex_draws_no_rule_between_rows_that_are_no_groups() -> None:
    table = Table("t", "T", "", (Column("method"), Column("x", digits=1)), (("a", Value(1.0)), ("b", Value(2.0))))
    assert table.latex().count("\\midrule") == 1


HOSTILE = "a|b `c` *d* <e> __f__ g_h \\ ~ ^ # $ & % {} [i]\nj"


def test_what_markdown_would_read_as_markup_is_escaped() -> None:
    escaped = escape_markdown(HOSTILE)
    assert escaped == "a\\|b \\`c\\` \\*d\\* \\<e\\> \\_\\_f\\_\\_ g_h \\\\ ~ ^ # $ & % {} [i] j"


def test_what_latex_would_read_as_commands_is_escaped() -> None:
    line = Table("t", "T", "", (Column("x"),), ((HOSTILE,),)).latex().splitlines()[10]
    assert line == (
        "a\\textbar{}b `c` *d* \\textless{}e\\textgreater{} \\_\\_f\\_\\_ g\\_h \\textbackslash{} "
        "\\textasciitilde{} \\textasciicircum{} \\# \\$ \\& \\% \\{\\} {[}i] j \\\\"
    )


@given(st.lists(st.text(st.characters(exclude_categories=["Cs"]), max_size=12), min_size=2, max_size=4))
def test_csv_gives_back_every_text_as_one_line(texts: list[str]) -> None:
    table = Table("t", "T", "", tuple(Column("x") for _ in texts), (tuple(texts),))
    read = list(csv.reader(io.StringIO(table.csv())))
    assert read[1] == [" ".join(text.split()) for text in texts]


def test_a_row_of_the_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match="a row of 1 cells under 2 columns"):
        Table("t", "T", "", (Column("a"), Column("b")), (("x",),))


def test_without_timing_keeps_everything_else_and_its_marks() -> None:
    kept = SMALL.without_timing()
    assert [column.title for column in kept.columns] == ["sequence", "method", "ATE", "T<T_avg", "TLR"]
    assert kept.marks == {(0, 2), (0, 4)}
    assert kept.rows[0] == SMALL.rows[0][:5]


def test_without_empty_drops_columns_that_no_row_fills() -> None:
    rows = tuple((*row[:3], Value(NAN), *row[4:]) for row in SMALL.rows)
    kept = Table("t", "T", "", SMALL.columns, rows, SMALL.marks).without_empty()
    assert [column.title for column in kept.columns] == ["sequence", "method", "ATE", "TLR", "time"]
    assert kept.marks == {(0, 2), (0, 3), (0, 4)}


@pytest.mark.parametrize(
    ("values", "better", "best"),
    [
        ([3.0, 1.0, NAN, 2.0], "lower", [1]),
        ([3.0, 1.0, NAN, 2.0], "higher", [0]),
        ([0.7, 1.2, 1.4, NAN], "one", [1]),
        ([0.9, 1.1, 2.0], "one", [0, 1]),
        ([1.0004, 1.0001, 1.1], "lower", [0, 1]),
        ([3.0, 1.0], "", []),
        ([NAN, 1.0], "lower", []),
        ([], "lower", []),
    ],
)
def test_the_best_value(values: list[float], better: str, best: list[int]) -> None:
    assert best_of(values, better, 3) == best  # type: ignore[arg-type]


@given(st.lists(st.floats(-100, 100) | st.just(NAN), max_size=8), st.sampled_from(["lower", "higher", "one"]))
def test_no_value_is_printed_better_than_the_best(values: list[float], better: str) -> None:
    best = best_of(values, better, 2)  # type: ignore[arg-type]
    known = [value for value in values if not math.isnan(value)]
    assert bool(best) == (len(known) > 1)
    cost = {"lower": lambda x: x, "higher": lambda x: -x, "one": lambda x: abs(x - 1)}[better]
    for place in best:
        assert all(cost(round(values[place], 2)) <= cost(round(value, 2)) + 1e-8 for value in known)
