"""Printing of results as tables, JSON or CSV."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

import typer

from scopemap.result.json_numbers import without_nan

_LABELS = {
    "ate_rmse_mm": "ATE RMSE, tracked frames (mm)",
    "ate_as_recorded_mm": "ATE RMSE without the clock offset (mm)",
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
    "time_offset_s": "truth read so much later (s)",
    "time_offset": "this clock offset is",
    "time_offset_within_s": "clock offset to within (s)",
    "coverage": "tracked share of the true poses in its span",
    "longest_tracked": "longest segment without loss (frames)",
    "frames_until_loss": "frames until the first loss",
    "mesh_accuracy_mm": "mesh to true surface, mean (mm)",
    "mesh_accuracy_p90_mm": "mesh to true surface, 90th percentile (mm)",
    "mesh_completeness_mm": "true surface to mesh, mean (mm)",
}
_GROUP_LABELS = {
    "against_video": "the surface against its own video",
    "held_out": "frames kept out of fusion",
    "fused": "frames that were fused",
    "nearest_frame": "the nearest fused frame, about the best possible",
}
_MEMBER_LABELS = {
    "frames": "frames",
    "coverage_mean": "share of the picture that the surface covers, mean",
    "coverage_least": "share of the picture that the surface covers, least",
    "within_10_percent_mean": "share of the picture within 10 % of the depth, mean",
    "within_10_percent_least": "share of the picture within 10 % of the depth, least",
    "depth_error": "relative difference of depth, median",
    "ssim": "structural similarity (SSIM), mean",
    "lpips": "perceptual distance (LPIPS), mean",
    "worst_frames": "the worst frames, drawn in worst.png",
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


OutputForm = Literal["table", "json", "csv", "line"]


def show(figures: dict[str, Any], form: OutputForm) -> None:
    """Print the figures of a trajectory, if any, and of the groups of further measures as dictionaries."""
    if form == "json":
        print_json(figures)
    elif form == "csv":
        rows = [("figure", "value"), *_flat(without_nan(figures))]
        csv.writer(sys.stdout, lineterminator="\n").writerows(rows)
    elif form == "line":
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


def _one_line(figures: dict[str, Any]) -> str:
    if "ate_rmse_mm" not in figures:  # no true poses: depth alone was measured
        return ", ".join(f"{name} {_text(value)}" for name, value in _flat(figures) if isinstance(value, float))
    clock = f", truth {figures['time_offset_s']:+.3f} s ({figures['time_offset']})" if "time_offset" in figures else ""
    return (
        f"ATE {figures['ate_rmse_mm']:.3f} mm, rotation {figures['rotation_unaligned_mean_deg']:.2f} deg unaligned, "
        f"TLR {figures['tlr']:.3f} (align {figures['align']}, "
        f"{figures['tracked']} of {figures['frames']} frames tracked){clock}"
    )


def _tables(figures: dict[str, Any]) -> None:
    if "ate_rmse_mm" in figures:
        title = (
            f"{figures['tracked']} of {figures['frames']} frames tracked, align {figures['align']}, "
            f"scale {figures['scale']:.5g}"
        )
        rows = {_LABELS[key]: _text(value) for key, value in figures.items() if key in _LABELS}
        print_values(rows, title=title)
    for name, group in figures.items():
        if name == "paper":
            rows = {label: " +- ".join(_text(group[key]) for key in keys) for label, *keys in _PAPER_ROWS}
            print_values(rows, title="in the paper's units")
        elif isinstance(group, dict) and name != "sources":
            rows = {_label(key): _text(value) for key, value in _flat(group)}
            print_values(rows, title=_GROUP_LABELS.get(name, name))


def _label(key: str) -> str:
    """Return what a figure of a group is called, "held_out.ssim": frames kept out of fusion: ..."""
    *groups, last = key.split(".")
    return ": ".join([*(_GROUP_LABELS.get(group, group) for group in groups), _MEMBER_LABELS.get(last, last)])


def _text(value: Any) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.4f}"
    return str(value)


def print_json(content: Any) -> None:
    """Print plain values, mappings and lists as JSON, NaN as null."""
    typer.echo(json.dumps(without_nan(content), indent=2))


def print_table(
    heads: Sequence[str], rows: Iterable[Iterable[str]], *, numbers: Sequence[str] = (), title: str | None = None
) -> None:
    """Print a table with columns `heads`, then those of `numbers`, which are aligned right."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(*heads, title=title, title_justify="left")
    for head in numbers:
        table.add_column(head, justify="right")
    for row in rows:
        table.add_row(*map(escape, row))
    Console().print(table)


def print_values(values: Mapping[str, Any], *, title: str | None = None, head: str = "figure") -> None:
    """Print a table of one name and value per row."""
    print_table((head,), ((name, _short(value)) for name, value in values.items()), numbers=("value",), title=title)


def print_findings(findings: Sequence[tuple[str, str, str]]) -> None:
    """Print a table of (severity, code, message), if there are any."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if findings:
        table = Table("severity", "code", "what was found")
        for severity, code, message in findings:
            table.add_row(severity, code, escape(message), style=_COLOURS[severity])
        Console().print(table)


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def print_warnings(provenance: Mapping[str, Any]) -> None:
    """Print the notices of a run that are more than assumptions, with their next steps, to the standard error."""
    from scopemap.result.evidence import notices_of
    from scopemap.result.wording import in_words

    scale_known = bool((provenance.get("scale") or {}).get("known"))
    for notice in notices_of(provenance):
        if notice.level != "info":
            typer.echo(f"warning: {in_words(notice, scale_known=scale_known)}", err=True)
