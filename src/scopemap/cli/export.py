"""`scopemap export`: runs in the layout that somebody else reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from scopemap.cli.options import AsJson, Quiet, Unit
from scopemap.errors import InputError

To = Literal[
    "nerfstudio", "colmap", "endogslam", "endonerf", "gaussians", "pointcloud", "ply", "obj", "stl", "glb",
    "slicer", "dicom", "tum", "kitti", "euroc", "mcap", "climb",
]  # fmt: skip
_FOLDERS_HELP = "Folder of a run, or of a submap, result/maps/1; climb takes several, and without one checks --out."


def export(
    to: Annotated[To, typer.Option("--to", help="The format (docs/exports.md).")],
    out: Annotated[Path, typer.Option(help="File or folder to write, by the format; climb adds clips to a folder.")],
    runs: Annotated[list[Path] | None, typer.Argument(metavar="[RUN]...", help=_FOLDERS_HELP)] = None,
    units: Annotated[
        Unit | None, typer.Option(help="Unit of lengths; default: what the format prescribes, else mm.")
    ] = None,
    axes: Annotated[
        Literal["lps", "ras", "opencv", "gltf"] | None, typer.Option(help="Axes of ply, obj and stl; default: lps.")
    ] = None,
    clip: Annotated[str, typer.Option(help="climb: name of the clip; default: that of the run's input.")] = "",
    videos: Annotated[
        Path | None, typer.Option(help="climb: folder of the challenge's videos: each must have its clip.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a run in the layout of another tool: its tracked frames, surface and depth.

    climb writes each run as the five runs of a clip and checks the submission by the challenge's rules (exit code 1).
    """
    for option, given, wanted in (
        ("--units", units, to != "climb"),
        ("--axes", axes, to != "climb"),
        ("--clip", clip, to == "climb"),
        ("--videos", videos, to == "climb"),
    ):
        if given and not wanted:
            raise typer.BadParameter(f"not with --to {to}", param_hint=option)
    if to == "climb":
        written = _add_to_submission(runs or [], out, clip)
        _check_submission(out, videos, written, as_json=as_json, quiet=quiet)
        return
    if len(runs or []) != 1:
        raise typer.BadParameter(f"{to} takes one run", param_hint="RUN")
    from scopemap.benchmark.exports.formats import export_run

    scale = export_run((runs or [])[0], to, out, units, axes)
    if as_json:
        typer.echo(json.dumps({"out": str(out), "format": to, "scale": scale}, indent=2))
    elif not quiet:
        typer.echo(f"{out}: written; {scale}")


def _add_to_submission(runs: list[Path], out: Path, clip: str) -> list[str]:
    from scopemap.benchmark.climb_submission import write_submission

    return [write_submission(run, out, clip) for run in runs]


def _check_submission(out: Path, videos: Path | None, written: list[str], *, as_json: bool, quiet: bool) -> None:
    from scopemap.benchmark.climb_check import submission_problems

    problems = submission_problems(out, videos)
    if as_json:
        facts = {"out": str(out), "format": "climb", "written": written, "problems": problems}
        typer.echo(json.dumps(facts, indent=2))
    elif not quiet:
        typer.echo("\n".join(problems) or f"{out}: valid")
    if problems:
        raise InputError(f"{out}: {len(problems)} problems, the first: {problems[0]}")
