"""All tables of a benchmark, and their files.

A group of figures that no run has is no table. The figures of a named protocol stand in a table of that name and
nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from scopemap.benchmark.layout import SEEDS, Figure, lay_out, line_of
from scopemap.benchmark.paper_tables import paper_tables
from scopemap.benchmark.protocol_tables import protocol_tables
from scopemap.benchmark.result import RunResult
from scopemap.benchmark.sections import OVERVIEW, SECTIONS, TIMED, Section
from scopemap.benchmark.summary import Summary, summarise
from scopemap.benchmark.table import Table, escape_markdown
from scopemap.errors import InputError

TIMING_COLUMNS = tuple(figure.title for figure in TIMED)
"""Titles of the overview's columns that two runs of one plan do not share; `Table.without_timing` leaves them out. The
table "time" holds nothing else."""

_FACTS = ("machine", "device", "commit", "versions", "truth")


def benchmark_tables(results: Iterable[RunResult], *, paper_units: bool = False) -> tuple[Table, ...]:
    """Return all tables that the results give something for, the overview first and the times last.

    Rows stand in the order in which sequences and methods first appear; a method that died is a row that says so, and
    why in the overview. `paper_units`: angles of tables 1 to 3 in radians instead of degrees.
    """
    results = tuple(results)
    summaries = summarise(results)
    measured = [section for section in SECTIONS if _is_measured(section, summaries)]
    return (
        section_table(OVERVIEW, summaries),
        *paper_tables(summaries, paper_units=paper_units),
        *(section_table(section, summaries).without_empty() for section in measured),
        *protocol_tables(summaries),
        _times(results),
    )


def write_tables(
    results: Iterable[RunResult],
    folder: Path,
    *,
    paper_units: bool = False,
    title: str = "Results",
    notes: Sequence[str] = (),
) -> tuple[Path, ...]:
    """Write FOLDER/results.md, which holds all tables, and FOLDER/tables/NAME.md, .csv, .tex; return the files.

    `title` and `notes` stand at the head of results.md, with machine, commit and versions. The same results give the
    same bytes. Raises `InputError` where the folder cannot be written.
    """
    results = tuple(results)
    tables = benchmark_tables(results, paper_units=paper_units)
    texts = {"results.md": _document(results, tables, title, notes)}
    for table in tables:
        texts[f"tables/{table.name}.md"] = _chapter(table, "#")
        texts[f"tables/{table.name}.csv"] = table.csv()
        texts[f"tables/{table.name}.tex"] = table.latex()
    try:
        (Path(folder) / "tables").mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write tables to {folder}: {error.strerror or error}") from None
    return tuple(Path(folder) / name for name in texts)


def section_table(section: Section, summaries: Sequence[Summary]) -> Table:
    """Return a section's table, one row per sequence and method; columns of text that would be empty are left out."""
    head, *place = section.word
    words = [s.text(*place) for s in summaries]
    texts = {
        "sequence": [s.sequence for s in summaries],
        "method": [s.method for s in summaries],
        "runs": [s.count for s in summaries],
        "frames tracked": [s.tracked for s in summaries],
        head: words,
    }
    kept = {head: column for head, column in texts.items() if any(column)}
    lines = [
        line_of(summary, row, section.figures, reached=(word,), reason=section is OVERVIEW)
        for summary, row, word in zip(summaries, zip(*kept.values(), strict=True), words, strict=True)
    ]
    return lay_out(Table(section.name, section.title, section.caption, (), ()), tuple(kept), section.figures, lines)


def _is_measured(section: Section, summaries: Sequence[Summary]) -> bool:
    return any(section.group in run.figures for summary in summaries for run in summary.runs)


def _times(results: Sequence[RunResult]) -> Table:
    summaries = summarise(replace(result, timing=_per_frame(result)) for result in results)
    stages = sorted({key for s in summaries for run in s.done for key in run.timing if key.startswith("ms_of_")})
    figures = [
        *TIMED,
        *(Figure("timing", stage, stage.removeprefix("ms_of_").replace("_", " "), "ms", 1, "") for stage in stages),
        Figure("timing", "seconds_total", "whole run", "s", 1, ""),
    ]
    caption = (
        "Wall time. Per frame: from the first finished frame to the last; tracking: the odometry alone. Stages: "
        "their sum over the run by its frames; stages in two threads overlap. Whole run: with start-up. Peak "
        f"memory: of the process that ran the method. {SEEDS}."
    )
    lines = [line_of(s, (s.sequence, s.method, s.count), figures) for s in summaries]
    return lay_out(Table("time", "Time and memory", caption, (), ()), ("sequence", "method", "runs"), figures, lines)


def _per_frame(result: RunResult) -> dict[str, float]:
    """Return the timing with the stages as milliseconds per frame, where the number of frames is known."""
    frames = result.figures.get("poses", {}).get("frames")
    stages = {key.removeprefix("seconds_"): s for key, s in result.timing.items() if key.startswith("seconds_")}
    stages.pop("total", None)
    return result.timing | ({f"ms_of_{stage}": 1e3 * s / frames for stage, s in stages.items() if s} if frames else {})


def _document(results: Sequence[RunResult], tables: Sequence[Table], title: str, notes: Sequence[str]) -> str:
    facts = [(name, _stated(results, name)) for name in _FACTS]
    stated = [(name, text) for name, text in facts if text] + [("note", note) for note in notes]
    head = [f"# {escape_markdown(title)}\n"]
    if stated:
        head.append("".join(f"- {name}: {escape_markdown(text)}\n" for name, text in stated))
    return "\n".join([*head, *(_chapter(table, "##") for table in tables)])


def _stated(results: Sequence[RunResult], name: str) -> str:
    """Return a fact of all results; where they differ, each that occurs."""
    facts = [fact for result in results if (fact := result.facts.get(name))]
    texts = [
        ", ".join(f"{k} {v}" for k, v in fact.items()) if isinstance(fact, Mapping) else str(fact) for fact in facts
    ]
    return "; ".join(dict.fromkeys(texts))


def _chapter(table: Table, level: str) -> str:
    return f"{level} {escape_markdown(table.title)}\n\n{table.markdown()}\n{escape_markdown(table.caption)}\n"
