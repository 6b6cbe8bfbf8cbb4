"""`scopemap coverage`: which share of the tissue was never seen, and where."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scopemap.terminal import options
from scopemap.terminal.figures import print_json


def coverage(
    run: Annotated[
        Path, typer.Argument(metavar="RESULT", help="Folder of a run, or of a submap such as result/maps/1.")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the map and the figures; default: RESULT/coverage.")
    ] = None,
    export: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the blind spots for 3D Slicer (.mrk.json) or as a DICOM report (.dcm)."
        ),
    ] = None,
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Estimate what share of the tissue no frame saw, and where.

    The share has a 90 % interval. Writes coverage.json, map.csv, map.png and coverage.ply. The intervals are calibrated
    on synthetic colons and cavities: do not use them for decisions about a patient.
    """
    from scopemap.report.page import PAGE, write_report
    from scopemap.report.page_data import COVERAGE

    folder = out or run / COVERAGE
    from scopemap.apps.coverage.coverage import FILES
    from scopemap.apps.coverage.coverage import coverage as covered
    from scopemap.apps.measure.findings import FINDING_ENDINGS, write_findings

    for name in FILES:
        options.check_output(folder / name, (Path(name).suffix,), overwrite)
    if export is not None:
        options.check_output(export, FINDING_ENDINGS, overwrite)
    options.warn_of_damage(run, silent=quiet)
    found = covered(run)
    found.save(folder)
    if export is not None:
        write_findings(run, found.findings, found.scale, export)
    if out is None and (run / PAGE).is_file():
        write_report(run)
    if as_json:
        print_json(found.facts | {"out": str(folder)})
    elif not quiet:
        typer.echo(str(found))
        typer.echo(f"{folder}: {', '.join(FILES)}")
