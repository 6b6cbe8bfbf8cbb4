"""`scopemap measure`: distances and areas on the surface of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from scopemap.cli.options import AsJson


def measure(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or of a submap, result/maps/1.")],
    frame: Annotated[int, typer.Option(help="Number of the frame that the pixels are of.")],
    points: Annotated[str, typer.Option(help='Pixels "x,y x,y": two for a distance, more for the area inside.')],
    reference: Annotated[
        str, typer.Option(help='Two pixels "x,y x,y" of the same frame, whose distance is known.')
    ] = "",
    reference_mm: Annotated[
        float | None, typer.Option(min=1e-6, help="Their distance, mm; without it, measures are multiples of it.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure on the surface between pixels of a frame, with intervals of 95 %.

    Where the run's scale is unknown, a reference is needed.
    """
    pixels, known = _pixels(points, "--points"), _pixels(reference, "--reference") if reference else None
    if len(pixels) < 2:
        raise typer.BadParameter("at least two pixels are needed", param_hint="--points")
    if known is not None and len(known) != 2:
        raise typer.BadParameter("two pixels are needed", param_hint="--reference")
    import numpy as np

    from scopemap.actions import measure as measuring

    unit = None if known is None else np.array(known)
    found = measuring.measure(run, frame, np.array(pixels), unit, reference_mm)
    if as_json:
        facts = [vars(one) | {"value": one.value if np.isfinite(one.value) else None} for one in found]
        typer.echo(json.dumps(facts, indent=2))
    else:
        typer.echo("\n".join(map(str, found)))


def _pixels(text: str, option: str) -> list[list[float]]:
    try:
        return [[float(x), float(y)] for x, y in (word.split(",") for word in text.split())]
    except ValueError:
        raise typer.BadParameter(f'"{text}" is not "x,y x,y ..."', param_hint=option) from None
