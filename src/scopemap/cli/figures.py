"""Prints figures as tables, JSON or CSV."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from scopemap.benchmark.result import without_nan

_LABELS = {
    "ate_rmse_mm": "ATE RMSE, tracked frames (mm)",
    "ate_hold_rmse_mm": "ATE RMSE, lost frames held (mm)",
    "ate_mean_mm": "ATE mean (mm)",
    "ate_median_mm": "ATE median (mm)",
    "ate_max_mm": "ATE largest (mm)",
    "rotation_mean_deg": "rotation error, mean (deg)",
    "rotation_max_deg": "rotation error, largest (deg)",
    "rotation_unaligned_mean_deg": "rotation since frame 1, unaligned, mean (deg)",
    "rotation_unaligned_max_deg": "rotation since frame 1, unaligned, largest (deg)",
    "rpe_1_mm": "RPE over 1 frame, RMSE (mm)",
    "rpe_1_deg": "RPE over 1 frame, RMSE (deg)",
    "rpe_10_mm": "RPE over 10 frames, RMSE (mm)",
    "rpe_10_deg": "RPE over 10 frames, RMSE (deg)",
    "rpe_10mm_path_mm": "RPE over 10 mm of true path, RMSE (mm)",
    "rpe_10mm_path_deg": "RPE over 10 mm of true path, RMSE (deg)",
    "tlr": "TLR, path estimated / true, unaligned",
    "coverage": "tracked share of the true poses in its span",
    "longest_tracked": "longest segment without loss (frames)",
    "frames_until_loss": "frames until the first loss",
    "mesh_accuracy_mm": "mesh to true surface, mean (mm)",
    "mesh_accuracy_p90_mm": "mesh to true surface, 90th percentile (mm)",
    "mesh_completeness_mm": "true surface to mesh, mean (mm)",
}
_PAPER_ROWS = (
    ("T_avg +- std (mm)", "t_avg_mm", "t_std_mm"),
    ("R_avg +- std (rad)", "r_avg_rad", "r_std_rad"),
    ("RMSE (mm)", "rmse_mm"),
    ("T_fin (mm)", "t_fin_mm"),
    ("R_fin (rad)", "r_fin_rad"),
    ("RPE +- std over 1 frame (mm)", "rpe_1_frame_mm", "rpe_1_frame_std_mm"),
    ("RPE +- std over 10 mm of true path (mm)", "rpe_10_mm_path_mm", "rpe_10_mm_path_std_mm"),
    ("T_max (mm)", "t_max_mm"),
    ("R_max (rad)", "r_max_rad"),
    ("T < T_avg (%)", "t_below_avg_percent"),
    ("R < R_avg (%)", "r_below_avg_percent"),
    ("TLR", "tlr"),
    ("lost frames (%)", "lost_percent"),
)


_COLOURS = {"error": "red", "warning": "yellow", "info": "default"}


class OutputForm(Enum):
    """Ways to show figures."""

    TABLE = "table"
    JSON = "json"
    CSV = "csv"
    LINE = "line"


def show(figures: dict[str, Any], form: OutputForm) -> None:
    """Print the figures of a trajectory, if any, and of the groups of further measures as dictionaries."""
    if form is OutputForm.JSON:
        typer.echo(json.dumps(without_nan(figures), indent=2))
    elif form is OutputForm.CSV:
        typer.echo(_csv(figures), nl=False)
    elif form is OutputForm.LINE:
        typer.echo(_one_line(figures))
    else:
        _tables(figures)


def _flat(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield what is no list, names joined by dots."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif not isinstance(value, list | tuple):
            yield prefix + key, value


def _csv(figures: dict[str, Any]) -> str:
    text = io.StringIO()
    rows = ((name, "" if isinstance(value, float) and math.isnan(value) else value) for name, value in _flat(figures))
    csv.writer(text, lineterminator="\n").writerows([("figure", "value"), *rows])
    return text.getvalue()


def _one_line(figures: dict[str, Any]) -> str:
    if "ate_rmse_mm" not in figures:  # no true poses: depth alone was measured
        return ", ".join(f"{name} {_text(value)}" for name, value in _flat(figures) if isinstance(value, float))
    return (
        f"ATE {figures['ate_rmse_mm']:.3f} mm, rotation {figures['rotation_unaligned_mean_deg']:.2f} deg unaligned, "
        f"TLR {figures['tlr']:.3f} (align {figures['align']}, "
        f"{figures['tracked']} of {figures['frames']} frames tracked)"
    )


def _tables(figures: dict[str, Any]) -> None:
    console = Console()
    if "ate_rmse_mm" in figures:
        title = (
            f"{figures['tracked']} of {figures['frames']} frames tracked, align {figures['align']}, "
            f"scale {figures['scale']:.5g}"
        )
        rows = {_LABELS[key]: _text(value) for key, value in figures.items() if key in _LABELS}
        console.print(value_table(rows, title=title))
    for name, group in figures.items():
        if name == "paper":
            rows = {label: " +- ".join(_text(group[key]) for key in keys) for label, *keys in _PAPER_ROWS}
            console.print(value_table(rows, title="in the paper's units"))
        elif isinstance(group, dict) and name != "sources":
            console.print(value_table({key: _text(value) for key, value in _flat(group)}, title=name))


def _text(value: Any) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4f}"
    return str(value)


def value_table(rows: Mapping[str, Any], *, title: str | None = None, head: str = "figure") -> Table:
    """Return a table of one name and value per row."""
    table = Table(head, title=title, title_justify="left")
    table.add_column("value", justify="right")
    for name, value in rows.items():
        table.add_row(name, escape(value if isinstance(value, str) else _short(value)))
    return table


def print_findings(findings: Sequence[tuple[str, str, str]]) -> None:
    """Print a table of (severity, code, message), if there are any."""
    if findings:
        table = Table("severity", "code", "what was found")
        for severity, code, message in findings:
            table.add_row(severity, code, escape(message), style=_COLOURS[severity])
        Console().print(table)


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.5g}" if isinstance(value, float) else str(value)
