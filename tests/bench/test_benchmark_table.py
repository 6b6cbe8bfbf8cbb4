"""A table in its three forms, to the letter; which value is the best."""

from __future__ import annotations

import pandas as pd
import pytest

from scopemap_bench.table import Figure, Table, escape_markdown

NAN = float("nan")
ROWS = pd.DataFrame(
    {
        "sequence": ["cecum_t1_a", "cecum_t1_a", "colon"],
        "method": ["ours", "A & B|C", "Park"],
        "ate": [1.005, 12.5, NAN],
        "ate std": [0.25, NAN, NAN],
        "below": [0.5, NAN, NAN],
        "tlr": [0.98, -0.0001, NAN],
        "failure": ["", "", "failed"],
        "competes": [True, True, False],
    }
)
SMALL = Table(
    "small",
    "A small table",
    "T<T_avg in 50 % of frames.",
    ("sequence", "method"),
    (
        Figure("ate", "ATE", "mm", 2, spread_key="ate std"),
        Figure("below", "T<T_avg", "%", 1, "higher", factor=100.0),
        Figure("tlr", "TLR", better="one"),
        Figure("absent", "absent"),
    ),
    ROWS,
    ("sequence",),
)


def test_markdown_to_the_letter() -> None:
    assert SMALL.without_empty().markdown() == (
        "| sequence | method | ATE, mm ↓ | T\\<T_avg, % ↑ | TLR →1 |\n"
        "| --- | --- | ---: | ---: | ---: |\n"
        "| cecum_t1_a | ours | **1.00 ± 0.25** | 50.0 | **0.980** |\n"
        "| cecum_t1_a | A & B\\|C | 12.50 |  | 0.000 |\n"
        "| colon | Park | failed |  |  |\n"
    )


def test_csv_to_the_letter() -> None:
    assert SMALL.csv() == (
        "sequence,method,ATE [mm],ATE std [mm],T<T_avg [%],TLR,absent\n"
        "cecum_t1_a,ours,1.005,0.25,50,0.98,\n"
        "cecum_t1_a,A & B|C,12.5,,,-0.0001,\n"
        "colon,Park,failed,,,,\n"
    )


def test_latex_to_the_letter() -> None:
    assert SMALL.without_empty().latex() == (
        "% needs \\usepackage{booktabs,graphicx}\n"
        "\\begin{table*}\n"
        "\\centering\n"
        "\\caption{A small table. T\\textless{}T\\_avg in 50 \\% of frames.}\n"
        "\\label{tab:small}\n"
        "\\resizebox{\\textwidth}{!}{%\n"
        "\\begin{tabular}{llrrr}\n"
        "\\toprule\n"
        "sequence & method & ATE, mm $\\downarrow$ & T\\textless{}T\\_avg, \\% $\\uparrow$ & TLR $\\to 1$ \\\\\n"
        "\\midrule\n"
        "cecum\\_t1\\_a & ours & \\textbf{1.00 $\\pm$ 0.25} & 50.0 & \\textbf{0.980} \\\\\n"
        "cecum\\_t1\\_a & A \\& B\\textbar{}C & 12.50 &  & 0.000 \\\\\n"
        "colon & Park & failed &  &  \\\\\n"
        "\\bottomrule\n"
        "\\end{tabular}}\n"
        "\\end{table*}\n"
    )


HOSTILE = "a|b `c` *d* <e> __f__ g_h \\ ~ ^ # $ & % {} [i]\nj"


def test_markup_is_escaped() -> None:
    escaped = escape_markdown(HOSTILE)
    assert escaped == "a\\|b \\`c\\` \\*d\\* \\<e\\> \\_\\_f\\_\\_ g_h \\\\ ~ ^ # $ & % {} [i] j"
    rows = pd.DataFrame({"x": [HOSTILE], "failure": [""], "competes": [True]})
    assert Table("t", "T", "", ("x",), (), rows).latex().splitlines()[10] == (
        "a\\textbar{}b `c` *d* \\textless{}e\\textgreater{} \\_\\_f\\_\\_ g\\_h \\textbackslash{} "
        "\\textasciitilde{} \\textasciicircum{} \\# \\$ \\& \\% \\{\\} {[}i] j \\\\"
    )


def _best(values: list[float], better: str, digits: int = 3) -> list[int]:
    found = Figure("x", "x", digits=digits, better=better).best(  # type: ignore[arg-type]
        pd.Series(values, dtype=float), [pd.Series(["all"] * len(values))]
    )
    return [place for place, best in enumerate(found) if best]


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
    ],
)
def test_the_best_value(values: list[float], better: str, best: list[int]) -> None:
    assert _best(values, better) == best
