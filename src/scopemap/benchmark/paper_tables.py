"""Tables 1, 2 and 3 in the shape of arXiv 2508.11282: ours as measured, the paper's rows beside them as printed.

The paper's rows come from other data, after an alignment that it does not state, and with an RPE over an interval that
it does not state: they are marked, stand in columns of their own where they would not compare, and never compete.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from scopemap.benchmark.layout import BOLD, SEEDS, Figure, Line, alignment_of, lay_out, line_of
from scopemap.benchmark.published import PublishedRow, PublishedTable, published_rows
from scopemap.benchmark.summary import Summary
from scopemap.benchmark.table import Better, Table, Value

_RADIANS = "R of the published rows are radians under the paper's degree sign"
_PUBLISHED = (
    "Rows marked published are the figures of arXiv 2508.11282 as printed: other data (SCARED), an alignment that is "
    "not stated, an RPE over an interval that is not stated. They show what the paper reports; they are no comparison."
)
_ERRORS = (
    "T: norm of the translation error, R: angle of the rotation error, both after the stated alignment (with the scale "
    "that it found) and over the tracked frames; fin: last tracked frame."
)


def paper_tables(summaries: Sequence[Summary], *, paper_units: bool = False) -> tuple[Table, ...]:
    """Return the three tables; none where no run has the figures of the paper ("paper").

    Angles are degrees, radians with `paper_units`, published ones included.
    """
    if not any(math.isfinite(summary.value("paper", "t_avg_mm").mean) for summary in summaries):
        return ()
    return _table_1(summaries, paper_units), _table_2(summaries, paper_units), _table_3(summaries, paper_units)


def _table_1(summaries: Sequence[Summary], paper_units: bool) -> Table:
    figures = (
        _scale(),
        _mm("t_avg_mm", "T_avg", spread_key="t_std_mm"),
        _angle("r_avg_rad", "R_avg", paper_units, spread_key="r_std_rad"),
        _mm("rmse_mm", "RMSE"),
        _mm("t_fin_mm", "T_fin"),
        _angle("r_fin_rad", "R_fin", paper_units),
        *_rpe(spread=True),
        _mm("t_max_mm", "T_max"),
        _angle("r_max_rad", "R_max", paper_units),
    )
    caption = f"{_ERRORS} ± is the standard deviation over the frames, RMSE^2 = T_avg^2 + std^2. {_notes(paper_units)}"
    table = _titled("table1", "Table 1: pose errors per sequence", caption)
    return lay_out(table, _texts("framework"), figures, _lines(summaries, figures, "table1_pose_scared"))


def _table_2(summaries: Sequence[Summary], paper_units: bool) -> Table:
    figures = (
        _mm("t_avg_mm", "T_avg"),
        _angle("r_avg_rad", "R_avg", paper_units),
        _mm("t_fin_mm", "T_fin"),
        _angle("r_fin_rad", "R_fin", paper_units),
        *_rpe(spread=False),
        _mm("t_max_mm", "T_max"),
        _angle("r_max_rad", "R_max", paper_units),
        Figure("paper", "t_below_avg_percent", "T<T_avg", "%", 2, ""),
        Figure("paper", "r_below_avg_percent", "R<R_avg", "%", 2, ""),
    )
    caption = (
        f"{_ERRORS} Means over the sequences. T<T_avg and R<R_avg are shares of frames below the method's own mean: "
        "they cannot rank methods. Only methods that came to an end on every sequence, and tracked enough of each, "
        f"compete. {_notes(paper_units)}"
    )
    methods = dict.fromkeys(summary.method for summary in summaries)
    sequences = len({summary.sequence for summary in summaries})
    lines = [_mean_line([s for s in summaries if s.method == method], sequences, figures) for method in methods]
    published = published_rows("table2_methods_scared")
    lines += [_published_line((row.method, "published", "", "", "not stated"), row, figures) for row in published]
    texts = ("framework", "source", "sequences", "frames tracked", "alignment")
    return lay_out(_titled("table2", "Table 2: methods, mean over sequences", caption), texts, figures, lines)


def _table_3(summaries: Sequence[Summary], paper_units: bool) -> Table:
    figures = (
        Figure("paper", "tlr", "TLR", "", 3, "one"),
        _mm("t_avg_mm", "T_avg", spread_key="t_std_mm"),
        _angle("r_avg_rad", "R_avg", paper_units, spread_key="r_std_rad"),
        _mm("t_fin_mm", "T_fin"),
        _angle("r_fin_rad", "R_fin", paper_units),
        _mm("t_max_mm", "T_max"),
        _angle("r_max_rad", "R_max", paper_units),
    )
    caption = (
        f"TLR: estimated over true path length, before the alignment. {_ERRORS} ± is the standard deviation over the "
        f"frames. {_notes(paper_units)}"
    )
    table = _titled("table3", "Table 3: ablations", caption)
    return lay_out(table, _texts("variant"), figures, _lines(summaries, figures, "table3_ablation_scared"))


def _titled(name: str, title: str, caption: str) -> Table:
    return Table(name, title, caption, (), ())


def _texts(method: str) -> tuple[str, ...]:
    return "sequence", method, "source", "frames tracked", "alignment"


def _mm(key: str, title: str, *, spread_key: str = "", better: Better = "lower") -> Figure:
    return Figure("paper", key, title, "mm", 3, better, spread_key)


def _angle(key: str, title: str, paper_units: bool, *, spread_key: str = "") -> Figure:
    unit, factor = ("rad", 1.0) if paper_units else ("deg", math.degrees(1))
    return Figure("paper", key, title, unit, 3, "lower", spread_key, factor)


def _scale() -> Figure:
    return Figure("poses", "scale", "scale", "", 3, "")


def _rpe(*, spread: bool) -> tuple[Figure, ...]:
    stds = ("rpe_1_frame_std_mm", "rpe_10_mm_path_std_mm", "rpe_unstated_std_mm") if spread else ("", "", "")
    return (
        _mm("rpe_1_frame_mm", "RPE 1 frame", spread_key=stds[0]),
        _mm("rpe_10_mm_path_mm", "RPE 10 mm path", spread_key=stds[1]),
        _mm("rpe_unstated_mm", "RPE interval not stated", spread_key=stds[2], better=""),
    )


def _notes(paper_units: bool) -> str:
    unit = f"in radians, the paper's unit; {_RADIANS}" if paper_units else f"in degrees; {_RADIANS}, converted"
    return f"{SEEDS}. Angles {unit}. {_PUBLISHED} {BOLD}"


def _lines(summaries: Sequence[Summary], figures: Sequence[Figure], table: PublishedTable) -> list[Line]:
    ours = []
    for s in summaries:
        aligned = alignment_of(s)
        ours.append(line_of(s, (s.sequence, s.method, "measured", s.tracked, aligned), figures, reached=(aligned,)))
    published = [
        _published_line((row.sequence, row.method, "published", "", "not stated"), row, figures)
        for row in published_rows(table)
    ]
    return ours + published


def _mean_line(of_method: Sequence[Summary], sequences: int, figures: Sequence[Figure]) -> Line:
    done = [summary for summary in of_method if summary.done]
    counts = [summary.frames for summary in done]
    tracked, frames = sum(count[0] for count in counts), sum(count[1] for count in counts)
    aligned = "/".join(dict.fromkeys(alignment_of(summary) for summary in done))
    of_frames = f"{tracked} of {frames}" if frames else ""
    texts = (of_method[0].method, "measured", f"{len(done)} of {sequences}", of_frames, aligned)
    values = tuple(Value(_mean([figure.value(summary).mean for summary in done])) for figure in figures)
    scored = all(math.isfinite(figures[0].value(summary).mean) for summary in done)
    everywhere = len(of_method) == sequences and scored and all(summary.competes for summary in of_method)
    return Line(texts, values, (aligned,), everywhere, "" if done else "failed")


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else math.nan


def _published_line(texts: tuple[str, ...], row: PublishedRow, figures: Sequence[Figure]) -> Line:
    found = ((figure.factor, row.figure(figure.key), row.figure(figure.spread_key)) for figure in figures)
    values = tuple(Value(factor * mean, factor * spread) for factor, mean, spread in found)
    return Line(texts, values, ("published",), competes=False)
