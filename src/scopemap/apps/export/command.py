"""`scopemap export`: a run in the layout that somebody else reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from scopemap.terminal.figures import print_json
from scopemap.terminal.options import AsJson, InputNow, Quiet, Unit, warn_of_damage

To = Literal[
    "nerfstudio", "colmap", "endogslam", "endonerf", "gaussians", "pointcloud", "ply", "obj", "stl", "glb",
    "surfaces", "slicer", "dicom", "tum", "kitti", "euroc", "mcap",
]  # fmt: skip


def export(
    to: Annotated[To, typer.Option("--to", help="The format (docs/exports.md).")],
    out: Annotated[
        Path,
        typer.Option(
            help="File or folder to write, by the format (docs/exports.md). kitti: a folder, or k.txt, poses alone."
        ),
    ],
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or of a submap, result/maps/1.")],
    units: Annotated[
        Unit | None, typer.Option(help="Unit of lengths; default: what the format prescribes, else mm.")
    ] = None,
    axes: Annotated[
        Literal["lps", "ras", "opencv", "gltf"] | None,
        typer.Option(help="Axes of ply, obj, stl, surfaces; default: lps."),
    ] = None,
    source: InputNow = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Write a run in the layout of another tool: its tracked frames, surface and depth."""
    from scopemap.apps.export.formats import export_run

    warn_of_damage(run, silent=quiet)
    scale = export_run(run, to, out, units, axes, source=source)
    if as_json:
        print_json({"out": str(out), "format": to, "scale": scale})
    elif not quiet:
        typer.echo(f"{out}: written; {scale}")
