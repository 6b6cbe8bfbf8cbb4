"""`scopemap inspect`: report the peculiarities of a clinical video, and the options for them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from scopemap.benchmark.result import without_nan
from scopemap.cli.figures import print_findings, value_table
from scopemap.cli.options import AsJson, Quiet, parse_slice
from scopemap.cli.progress import count_progress
from scopemap.errors import InputError

if TYPE_CHECKING:
    from scopemap.inspection.inspecting import Inspection


def inspect(
    source: Annotated[
        Path,
        typer.Argument(metavar="VIDEO", help="A video file, a folder of images, the folder of a data set's sequence."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The picture, a PNG; by default NAME_inspection.png in this folder."),
    ] = None,
    masks: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write one mask of overlays and of pictures in the picture, for mask.files.",
        ),
    ] = None,
    dataset: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Its reader, where the guess is wrong (`scopemap datasets list`)."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(metavar="FILE|NUMBERS", help="Calibration, as for `run`: for the mask that a run finds."),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(metavar="A:B:S", help="Which frames, as a Python slice: 0:5000, ::10.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier picture and masks.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Read a video once and show what was found in it: format, timing, field of view, overlays, bad segments.

    That takes as long as decoding, plus some 20 ms for each frame: for a video of 2 h more than an hour, ::10 of it a
    fraction.
    """
    file = out or Path(f"{source.resolve().stem if source.is_file() else source.resolve().name}_inspection.png")
    _refuse(file, masks, overwrite)

    from scopemap.inspection.inspecting import inspect as inspection_of
    from scopemap.inspection.picture import MASK_NAME, draw_inspection, write_mask

    with count_progress("inspecting", "inspected", silent=quiet or as_json) as listener:
        selection = parse_slice(frames) if frames else None
        found = inspection_of(source, dataset=dataset, camera=camera, frames=selection, listener=listener)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        draw_inspection(found, file)
        written = masks is not None and write_mask(found, masks)
    except OSError as error:
        raise InputError(f"writing the inspection of {source}: {error.strerror or error}") from None
    if as_json:
        report = found.report | {"path": str(source), "picture": str(file)}
        typer.echo(json.dumps(without_nan(report), indent=2))
    elif not quiet:
        _print(source, found)
        typer.echo(f"picture: {file}")
        if masks is not None:
            typer.echo(f"mask: {masks / MASK_NAME}, for all frames" if written else "mask: none, nothing to leave out")


def _refuse(file: Path, masks: Path | None, overwrite: bool) -> None:
    from scopemap.inspection.picture import MASK_NAME

    if file.suffix.lower() != ".png":
        raise InputError(f"cannot write the picture {file}: its name must end in .png")
    if file.is_dir():
        raise InputError(f"cannot write the picture {file}: there is a folder of that name")
    if file.exists() and not overwrite:
        raise InputError(f"{file} exists; give another name with --out, or --overwrite")
    if masks is not None and masks.exists() and not masks.is_dir():
        raise InputError(f"cannot write masks into {masks}: it is no folder")
    if masks is not None and masks.is_dir() and any(masks.iterdir()) and not overwrite:
        raise InputError(f"{masks} is not empty; give another folder with --masks, or --overwrite")
    # A run would take them for masks of single frames.
    if masks is not None and masks.is_dir() and any(file.name != MASK_NAME for file in masks.iterdir()):
        raise InputError(f"{masks} holds other files than {MASK_NAME}; give another folder with --masks")


def _print(source: Path, found: Inspection) -> None:
    typer.echo(str(source))
    Console().print(value_table(found.facts, head="fact"))
    print_findings([(finding.severity, finding.code, finding.message) for finding in found.findings])
    for finding in found.findings:
        if finding.advice:
            typer.echo(f"advice: {finding.code}: {finding.advice}")
    if not found.findings:
        typer.echo("nothing peculiar was found")
