"""`scopemap export`: a run in the layout that somebody else reads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from scopemap.apps.export.formats import FORMATS, export_run, frames_of_lines
from scopemap.terminal.figures import print_json
from scopemap.terminal.options import AsJson, InputNow, Quiet, Unit, warn_of_damage


def export(
    to: Annotated[
        str, typer.Option("--to", metavar=f"<{'|'.join(FORMATS)}>", help="Format to write (docs/exports.md).")
    ],
    out: Annotated[
        Path,
        typer.Option(help="File or folder to write, depending on the format (docs/exports.md)."),
    ],
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or of a submap such as result/maps/1.")],
    units: Annotated[Unit | None, typer.Option(help="Unit of lengths; default: the format's own, else mm.")] = None,
    axes: Annotated[
        Literal["lps", "ras", "opencv", "gltf"] | None,
        typer.Option(help="Axes of ply, obj, stl and surfaces; default: lps."),
    ] = None,
    source: InputNow = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Convert a run to the format of another tool.

    The export holds the tracked frames, the surface or depth, depending on the format.
    """
    if to not in FORMATS:
        raise typer.BadParameter(f"'{to}' is not one of {', '.join(FORMATS)}.", param_hint="--to")
    warn_of_damage(run, silent=quiet)
    scale = export_run(run, to, out, units, axes, source=source)
    lines = frames_of_lines(run, to, out)
    if as_json:
        print_json({"out": str(out), "format": to, "scale": scale} | ({"lines": lines} if lines else {}))
    elif not quiet:
        typer.echo("\n".join(filter(None, (f"{out}: written; {scale}", lines))))
