"""`scopemap evaluate`: a run, or anyone's trajectory file, against the truth."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from scopemap.cli.options import AsJson
from scopemap.errors import InputError

if TYPE_CHECKING:
    import trimesh

    from scopemap.evaluation.poses import MatchedTrajectories
    from scopemap.geometry.align import Similarity

# Below this ratio of singular values the rotation about the path is hardly fixed by it.
_WEAK_LINE_RATIO = 1e-3

_LABELS = {
    "ate_rmse_mm": "ATE RMSE, tracked frames (mm)",
    "ate_hold_rmse_mm": "ATE RMSE, lost frames held (mm)",
    "ate_mean_mm": "ATE mean (mm)",
    "rotation_mean_deg": "rotation error, mean (deg)",
    "rotation_max_deg": "rotation error, largest (deg)",
    "rotation_unaligned_mean_deg": "rotation since frame 1, unaligned, mean (deg)",
    "rotation_unaligned_max_deg": "rotation since frame 1, unaligned, largest (deg)",
    "rpe_1_mm": "RPE over 1 frame, RMSE (mm)",
    "rpe_1_deg": "RPE over 1 frame, RMSE (deg)",
    "rpe_10_mm": "RPE over 10 frames, RMSE (mm)",
    "rpe_10_deg": "RPE over 10 frames, RMSE (deg)",
    "tlr": "TLR, path estimated / true, unaligned",
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


class AlignChoice(StrEnum):
    """Ways to align."""

    NONE = "none"
    ORIGIN = "origin"
    SE3 = "se3"
    SIM3 = "sim3"


class UnitChoice(StrEnum):
    """Units of foreign files."""

    MM = "mm"
    M = "m"


def evaluate(
    trajectory: Annotated[
        Path,
        typer.Argument(metavar="DIR|TRAJECTORY", help="A run's folder, or a TUM, KITTI or C3VD trajectory file."),
    ],
    truth: Annotated[
        Path,
        typer.Option(
            help="True poses: a C3VD, phantom or 7-Scenes folder, or a trajectory file. With a run's mesh.ply and a "
            "mesh_truth.ply here, the mesh is measured too, moved by the same alignment."
        ),
    ],
    align: Annotated[
        AlignChoice, typer.Option(help="Fit before measuring: origin = first frames onto each other.")
    ] = AlignChoice.SIM3,
    unit: Annotated[
        UnitChoice,
        typer.Option(
            help="Unit of TUM and KITTI files whose header does not say '# unit: mm' or m; all else is known."
        ),
    ] = UnitChoice.MM,
    paper_units: Annotated[
        bool, typer.Option("--paper-units", help="Also the figures of the paper's table 1, rotations in radians.")
    ] = False,
    as_json: AsJson = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="One line of figures, no warnings.")] = False,
) -> None:
    """Compare a trajectory with the truth.

    Frames are matched by number where both sides have one (line of the pose file, index in frames.csv, whole numbers
    as TUM time stamps), else by time within 0.01 s; files without times count 30 frames per s.
    """
    from scopemap.evaluation.poses import match, paper_report, pose_report
    from scopemap.trajectory import read_trajectory

    matched = match(read_trajectory(trajectory, unit=unit.value), read_trajectory(truth, unit=unit.value), align.value)
    figures: dict[str, Any] = asdict(pose_report(matched)) | _mesh_figures(trajectory, truth, matched.similarity)
    paper = asdict(paper_report(matched)) if paper_units else None
    if not quiet:
        _warn(matched)
    if as_json:
        typer.echo(json.dumps(_without_nan(figures | ({"paper": paper} if paper else {})), indent=2))
    elif quiet:
        typer.echo(_one_line(figures))
    else:
        _show(figures, paper)


def _mesh_figures(trajectory: Path, truth: Path, similarity: Similarity) -> dict[str, float]:
    mesh_file, truth_file = trajectory / "mesh.ply", truth / "mesh_truth.ply"
    if not (mesh_file.is_file() and truth_file.is_file()):
        return {}
    from scopemap.evaluation.surface import compare_surfaces

    mesh = _read_mesh(mesh_file)
    if not len(mesh.faces):  # a run that fused nothing still has poses to be measured
        return dict.fromkeys(("mesh_accuracy_mm", "mesh_accuracy_p90_mm", "mesh_completeness_mm"), math.nan)
    mesh.vertices = similarity.transform_points(mesh.vertices)
    report = compare_surfaces(mesh, _read_mesh(truth_file))
    return {
        "mesh_accuracy_mm": report.accuracy.mean_mm,
        "mesh_accuracy_p90_mm": report.accuracy.p90_mm,
        "mesh_completeness_mm": report.completeness.mean_mm,
    }


def _read_mesh(path: Path) -> trimesh.Trimesh:
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # the readers of mesh files raise whatever their parsers raise
        raise InputError(f"cannot read the mesh {path}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"the mesh {path} holds no surface")
    return mesh


def _warn(matched: MatchedTrajectories) -> None:
    lost = int((~matched.tracked).sum())
    if lost:
        typer.echo(
            f"warning: {lost} of {len(matched.tracked)} frames are lost and left out of all but one figure", err=True
        )
    if matched.similarity.line_ratio < _WEAK_LINE_RATIO:
        typer.echo(
            f"warning: the path is nearly a straight line (D2/D1 = {matched.similarity.line_ratio:.1e}); the rotation "
            "about it is poorly fixed, so are the rotation errors",
            err=True,
        )


def _without_nan(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _without_nan(value) for key, value in tree.items()}
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def _one_line(figures: dict[str, Any]) -> str:
    return (
        f"ATE {figures['ate_rmse_mm']:.3f} mm, rotation {figures['rotation_unaligned_mean_deg']:.2f} deg unaligned, "
        f"TLR {figures['tlr']:.3f} (align {figures['align']}, "
        f"{figures['tracked']} of {figures['frames']} frames tracked)"
    )


def _show(figures: dict[str, Any], paper: dict[str, float] | None) -> None:
    console = Console()
    title = (
        f"{figures['tracked']} of {figures['frames']} frames tracked, align {figures['align']}, "
        f"scale {figures['scale']:.5g}"
    )
    console.print(_table(title, {_LABELS[key]: _text(value) for key, value in figures.items() if key in _LABELS}))
    if paper:
        rows = {label: " +- ".join(_text(paper[key]) for key in keys) for label, *keys in _PAPER_ROWS}
        console.print(_table("in the paper's units", rows))


def _text(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"


def _table(title: str, rows: dict[str, str]) -> Table:
    table = Table("figure", title=title, title_justify="left")
    table.add_column("value", justify="right")
    for row in rows.items():
        table.add_row(*row)
    return table
