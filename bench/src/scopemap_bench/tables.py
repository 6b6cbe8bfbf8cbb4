"""All tables of a benchmark, and their files. `tables.toml` lists the columns.

A group of figures that no run has is no table. A named protocol has a table of its name. Tables 1 to 3 have the form of
arXiv 2508.11282, with the paper's rows as printed: they are marked as published and never compete, and their RPE, over
an interval that is not stated, has a column of its own.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from scopemap.engine.errors import InputError
from scopemap_bench.climb.figures import ClimbScore, climb_score
from scopemap_bench.climb.ranking import ranked
from scopemap_bench.result import RunResult
from scopemap_bench.table import SPREAD, Figure, Table, escape_markdown, joined, of_frames, summarise

PublishedTable = Literal["table1_pose_scared", "table2_methods_scared", "table3_ablation_scared"]

_SECTIONS = {"tracking": "poses", "consistency": "consistency", "depth": "depth", "surface": "surface"}
_OWN_GROUPS = {"paper", *_SECTIONS.values()}
_JOINED = ("alignment", "path", "turn", "depth")
_CLIMB_SCORES = ("climb.climb_score", "climb.climb_rotation_score")
_FACTS = ("machine", "device", "commit", "versions", "truth")
_UNITS = {"_mm": "mm", "_deg": "deg", "_rad": "rad", "_percent": "%", "_px": "px", "_s": "s"}


def benchmark_tables(results: Iterable[RunResult], *, paper_units: bool = False) -> tuple[Table, ...]:
    """Return all tables that the results have figures for, the overview first and the times last.

    Rows stand in the order in which sequences and methods first appear; without figures they hold the failure.
    `paper_units`: angles of tables 1 to 3 in radians instead of degrees.
    """
    results = tuple(results)
    rows = summarise(results)
    short = rows.assign(failure=rows["failure"].str.partition(":")[0])
    groups = list(dict.fromkeys(group for result in results for group in result.figures))
    return (
        read_table("overview", rows),
        *_paper_tables(short, paper_units),
        *(read_table(name, short).without_empty() for name, group in _SECTIONS.items() if group in groups),
        *(_protocol_table(group, short, results) for group in groups if group not in _OWN_GROUPS),
        *_climb_ranking(rows),
        _times(short),
    )


def write_tables(
    results: Iterable[RunResult],
    folder: Path,
    *,
    paper_units: bool = False,
    title: str = "Results",
    notes: Sequence[str] = (),
) -> tuple[Path, ...]:
    """Write FOLDER/results.md with all tables, and tables/NAME.md, .csv, .tex, and return the files."""
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


def read_table(name: str, rows: pd.DataFrame, *, paper_units: bool = False) -> Table:
    """Return the table of `tables.toml` with these rows; columns of text that are empty everywhere are left out."""
    file = resources.files("scopemap_bench") / "tables.toml"
    tree = tomllib.loads(file.read_text(encoding="utf-8"))
    phrases = tree["phrases"] | {"angles": tree["phrases"]["radians" if paper_units else "degrees"]}
    table = tree[name]
    kept = tuple(text for text in table["texts"] if (rows[text] != "").any())
    figures = tuple(_figure(figure, paper_units) for figure in table["figures"])
    caption = table["caption"].format(**phrases)
    return Table(name, table["title"], caption, kept, figures, rows, tuple(table["compete_within"]))


def _figure(column: dict[str, Any], paper_units: bool) -> Figure:
    if column.get("unit") != "angle":
        return Figure(**column)
    unit, factor = ("rad", 1.0) if paper_units else ("deg", math.degrees(1))
    return Figure(**column | {"unit": unit, "factor": factor})


def _paper_tables(rows: pd.DataFrame, paper_units: bool) -> Iterator[Table]:
    if not rows.reindex(columns=["paper.t_avg_mm"]).notna().any(axis=None):
        return
    published: tuple[PublishedTable, ...] = ("table1_pose_scared", "table2_methods_scared", "table3_ablation_scared")
    for number, file in enumerate(published, start=1):
        ours = (_means_over_sequences(rows) if number == 2 else rows).assign(source="measured")
        both = pd.concat([ours, published_rows(file)], ignore_index=True)
        both = both.rename(columns={"method": "variant" if number == 3 else "framework"})
        yield read_table(f"table{number}", both, paper_units=paper_units)


def published_rows(table: PublishedTable) -> pd.DataFrame:
    """Return the rows of one of the paper's tables, in its order, with the columns of `summarise`: mm and rad.

    The interval of its RPE is not stated: it is none of ours.
    """
    with (resources.files("scopemap_bench") / "published" / f"{table}.csv").open(encoding="utf-8") as file:
        rows = pd.read_csv(file)
    empty = dict.fromkeys(("depth", "frames tracked", "sequences", "path", "turn", "failure"), "")
    return rows.assign(competes=False, alignment="not stated", source="published", **empty)


def _means_over_sequences(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row per method: means over its sequences that came to an end."""
    sequences, methods = rows["sequence"].nunique(), rows["method"].unique()
    done = rows[rows["failure"] == ""].groupby("method", sort=False)
    finished = done.size().reindex(methods, fill_value=0)
    scored = done["paper.t_avg_mm"].count().reindex(methods, fill_value=0)
    whole = rows.groupby("method")["competes"].agg(lambda runs: len(runs) == sequences and bool(runs.all()))
    return (
        done.mean(numeric_only=True)
        .reindex(methods)
        .assign(
            **{"frames tracked": of_frames(done[["tracked", "frames"]].sum().reindex(methods))},
            sequences=[f"{count} of {sequences}" for count in finished],
            **{key: rows.groupby("method")[key].agg(joined).reindex(methods) for key in _JOINED},
            failure=rows.groupby("method")["failure"].first().reindex(methods).where(finished == 0, ""),
            competes=whole & (scored == finished),
        )
        .reset_index()
    )


def _protocol_table(group: str, rows: pd.DataFrame, results: Sequence[RunResult]) -> Table:
    """Return the figures of another paper's protocol: one row per sequence and figure, one column per method.

    Figures have five significant digits, for they may be counts as well as hundredths of a radian.
    """
    words = next(result.figures[group] for result in results if group in result.figures)
    keys = [name for name in rows if name.startswith(f"{group}.") and not name.endswith(SPREAD)]
    lines = []
    for sequence, here in rows.groupby("sequence", sort=False):
        by_method = here.set_index("method")
        tracked = by_method["frames tracked"].where(by_method["failure"] == "", "failed")
        lines.append({"sequence": sequence, "figure": "frames tracked", "unit": "", **tracked})
        for key in keys:
            name = key.rpartition(".")[2]
            suffix = next((suffix for suffix in _UNITS if name.endswith(suffix)), "")
            named = {"figure": name.removesuffix(suffix).replace("_", " "), "unit": _UNITS.get(suffix, "")}
            values = by_method[key].map(lambda value: "" if math.isnan(value) else f"{value:.5g}")
            lines.append({"sequence": sequence, **named, **values})
    table = pd.DataFrame(lines).fillna("").assign(failure="", competes=False)
    caption = words.get("description", f"As the protocol {group} defines them.")
    caption += f" Source: {words['source']}." if "source" in words else ""
    caption += " Not to be compared with figures of another protocol. Over several seeds: median."
    texts = ("sequence", "figure", "unit", *dict.fromkeys(rows["method"]))
    return Table(f"protocol-{group}", f"Protocol {group}", caption, texts, (), table)


def _climb_ranking(rows: pd.DataFrame) -> Iterator[Table]:
    """Yield the order of the methods that have CLiMB's score on any clip; a clip without one counts as failed."""
    ate, rotation = _CLIMB_SCORES
    if ate not in rows:
        return
    scored = rows.groupby("method", sort=False)[ate].count()
    failed = climb_score(math.nan, math.nan, 0.0, math.inf)
    whole = rows.fillna({ate: failed.ate, rotation: failed.rotation})
    means = whole.groupby("method", sort=False)[[ate, rotation]].mean()[scored > 0]
    order = ranked({name: ClimbScore(*scores) for name, *scores in means.itertuples()})
    clips = [f"{scored[name]} of {rows['sequence'].nunique()}" for name in order]
    places = [str(place) for place in range(1, len(order) + 1)]
    words = {"rank": places, "clips with a score": clips, "failure": "", "competes": False}
    yield read_table("climb-ranking", means.loc[order].reset_index().assign(**words))


def _times(rows: pd.DataFrame) -> Table:
    table = read_table("time", rows)
    keys = sorted(key for key in rows if key.startswith("timing.ms_of_") and not key.endswith(SPREAD))
    stages = [Figure(key, key.removeprefix("timing.ms_of_").replace("_", " "), "ms", 1, "") for key in keys]
    return replace(table, figures=(*table.figures[:-1], *stages, table.figures[-1]))


def _document(results: Sequence[RunResult], tables: Sequence[Table], title: str, notes: Sequence[str]) -> str:
    facts = [(name, _stated(results, name)) for name in _FACTS]
    stated = [(name, text) for name, text in facts if text] + [("note", note) for note in notes]
    head = [f"# {escape_markdown(title)}\n"]
    if stated:
        head.append("".join(f"- {name}: {escape_markdown(text)}\n" for name, text in stated))
    return "\n".join([*head, *(_chapter(table, "##") for table in tables)])


def _stated(results: Sequence[RunResult], name: str) -> str:
    """Return a fact of all results; where they differ, each value that occurs."""
    facts = [fact for result in results if (fact := result.facts.get(name))]
    texts = [
        ", ".join(f"{k} {v}" for k, v in fact.items()) if isinstance(fact, Mapping) else str(fact) for fact in facts
    ]
    return "; ".join(dict.fromkeys(texts))


def _chapter(table: Table, level: str) -> str:
    return f"{level} {escape_markdown(table.title)}\n\n{table.markdown()}\n{escape_markdown(table.caption)}\n"
