"""Tables of other people's pose protocols: a protocol's figures under its own names, in a table of its own.

One protocol's number is never printed under another's name. Protocols have up to seventy figures: these are the rows,
the methods the columns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from scopemap.benchmark.layout import SEEDS
from scopemap.benchmark.sections import OWN_GROUPS
from scopemap.benchmark.summary import Summary
from scopemap.benchmark.table import Cell, Column, Table

_UNITS = {"_mm": "mm", "_deg": "deg", "_rad": "rad", "_percent": "%", "_px": "px", "_s": "s"}


def protocol_tables(summaries: Sequence[Summary]) -> tuple[Table, ...]:
    """Return a table for each group of figures that is none of our own: one row per sequence and figure."""
    leaves: dict[str, dict[str, Any]] = {}
    for run in (run for summary in summaries for run in summary.runs):
        for group, figures in run.figures.items():
            if group not in OWN_GROUPS:
                leaves.setdefault(group, {}).update(_flat(figures))
    return tuple(_table(group, found, summaries) for group, found in leaves.items())


def _table(group: str, leaves: Mapping[str, Any], summaries: Sequence[Summary]) -> Table:
    keys = [key for key, value in leaves.items() if not isinstance(value, str)]
    found = {(summary.sequence, summary.method): summary for summary in summaries}
    methods = list(dict.fromkeys(summary.method for summary in summaries))
    rows: list[tuple[Cell, ...]] = []
    for sequence in dict.fromkeys(summary.sequence for summary in summaries):
        of_methods = [found.get((sequence, method)) for method in methods]
        rows.append((sequence, "frames tracked", "", *(_tracked(summary) for summary in of_methods)))
        rows += [(sequence, *_named(key), *(_shown(summary, group, key) for summary in of_methods)) for key in keys]
    caption = str(leaves.get("description", f"As the protocol {group} defines them."))
    source = f" Source: {leaves['source']}." if "source" in leaves else ""
    columns = (Column("sequence"), Column("figure"), Column("unit"), *(Column(method, digits=4) for method in methods))
    foreign = "Not to be compared with figures of another protocol."
    return Table(
        f"protocol-{group}", f"Protocol {group}", f"{caption}{source} {foreign} {SEEDS}.", columns, tuple(rows)
    )


def _tracked(summary: Summary | None) -> str:
    if summary is None:
        return ""
    return "failed" if summary.failure else summary.tracked


def _shown(summary: Summary | None, group: str, key: str) -> str:
    """Return a figure to five significant digits, for it may be a count as well as a hundredth of a radian."""
    value = math.nan if summary is None else summary.value(group, key).mean
    return f"{value:.5g}" if math.isfinite(value) else ""


def _flat(figures: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested groups, points in their keys; lists are no figures."""
    leaves: dict[str, Any] = {}
    for key, value in figures.items():
        if isinstance(value, Mapping):
            leaves |= _flat(value, f"{prefix}{key}.")
        elif not isinstance(value, list | tuple):
            leaves[prefix + key] = value
    return leaves


def _named(key: str) -> tuple[str, str]:
    name = key.rpartition(".")[2]
    suffix = next((suffix for suffix in _UNITS if name.endswith(suffix)), "")
    return name.removesuffix(suffix).replace("_", " "), _UNITS.get(suffix, "")
