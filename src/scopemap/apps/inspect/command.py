"""`scopemap inspect`: report the peculiarities of a clinical video, and the options for them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scopemap.engine.errors import InputError
from scopemap.terminal import options
from scopemap.terminal.figures import print_findings, print_json, print_values
from scopemap.terminal.progress import count_progress

if TYPE_CHECKING:
    from scopemap.apps.inspect.inspecting import Inspection


def inspect(
    source: options.Input,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="PNG picture to write; default: none."),
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write a mask of overlays and inset pictures to this folder, for mask.files.",
        ),
    ] = None,
    dataset: options.Dataset = None,
    camera: options.CameraFile = None,
    frames: options.Frames = None,
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Check a video, and name the options that help.

    It looks at format, field of view, overlays, useless frames and motion.

    Of a long video 12 short parts are read, 300 frames. A run reads them all; --frames inspects a part of it.
    """
    _refuse(out, masks, overwrite)
    from scopemap.apps.inspect.inspecting import inspect as inspection_of
    from scopemap.apps.inspect.inspection_sheet import MASK_NAME, draw_inspection, write_mask

    with count_progress("inspecting", "inspected", silent=quiet or as_json) as listener:
        found = inspection_of(source, dataset=dataset, camera=camera, frames=frames, listener=listener)
    try:
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            draw_inspection(found, out)
        written = masks is not None and write_mask(found, masks)
    except OSError as error:
        raise InputError(f"writing the inspection of {source}: {error.strerror or error}") from None
    if as_json:
        print_json(found.report | {"path": str(source), "picture": None if out is None else str(out)})
    elif not quiet:
        _print(source, found)
        typer.echo(f"picture: {'none; --out FILE.png draws the findings' if out is None else out}")
        if masks is not None:
            typer.echo(f"mask: {masks / MASK_NAME}, {'for all frames' if written else 'empty: nothing to leave out'}")


def _refuse(file: Path | None, masks: Path | None, overwrite: bool) -> None:
    from scopemap.apps.inspect.inspection_sheet import MASK_NAME

    if file is not None:
        options.check_output(file, (".png",), overwrite)
    if masks is None or not masks.exists():
        return
    if not masks.is_dir():
        raise InputError(f"cannot write masks into {masks}: it is no folder")
    names = {file.name for file in masks.iterdir()}
    if names and not overwrite:
        raise InputError(f"{masks} is not empty; give another folder with --masks, or --overwrite")
    # A run would take them for masks of single frames.
    if names - {MASK_NAME}:
        raise InputError(f"{masks} holds other files than {MASK_NAME}; give another folder with --masks")


def _print(source: Path, found: Inspection) -> None:
    typer.echo(str(source))
    print_values(found.facts, head="fact")
    print_findings([(finding.severity, finding.code, finding.message) for finding in found.findings])
    for finding in found.findings:
        if finding.advice:
            typer.echo(f"advice: {finding.code}: {finding.advice}")
    if not found.findings:
        typer.echo("nothing was found that calls for an option")
    if len(found.clip) < found.clip.count:
        typer.echo(f"read: {len(found.clip)} of {found.clip.count} frames; problems between them are not seen")
    typer.echo(f"forecast: {found.forecast}")
