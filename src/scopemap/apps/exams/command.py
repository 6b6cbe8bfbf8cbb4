"""`scopemap compare-exams`: two examinations in one frame of reference, and what changed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scopemap.terminal import options
from scopemap.terminal.figures import print_json


def compare_exams(
    first: Annotated[Path, typer.Argument(metavar="FIRST", help="Folder of the first examination's run.")],
    second: Annotated[Path, typer.Argument(metavar="SECOND", help="Folder of the second examination's run.")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for the page, its pictures and tables.")],
    source: options.InputNow = None,
    second_input: Annotated[
        Path | None,
        typer.Option("--second-input", metavar="INPUT", help="Where the second run's input is now, if it has moved."),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a film along the first run's path, coloured by what changed."),
    ] = None,
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Register two examinations and show what changed.

    Both must show the same place. The first sentence says whether they fit. The page shows matched views, changes, and
    what only one examination saw.
    """
    options.check_output(out / "compare.html", (".html",), overwrite)
    from scopemap.apps.exams.change_painting import change_painting
    from scopemap.apps.exams.compare_exams import compare_exams as compare
    from scopemap.apps.exams.examination import as_compared
    from scopemap.apps.exams.exams_page import PAGE, facts_of, write_comparison
    from scopemap.apps.exams.wording import names_of, summary
    from scopemap.apps.view.fly_through import write_fly_through

    for folder in (first, second):
        options.warn_of_damage(folder, silent=quiet)
    found = compare(first, second, source, second_input)
    write_comparison(found, first, second, out)
    if video is not None:
        write_fly_through(first, video, source, change_painting(first, found))
    run = as_compared(first)
    if as_json:
        print_json(facts_of(found, "mm" if run.scale_known else "unit"))
    elif not quiet:
        for line in summary(found, run.scale, names_of(first.resolve().name, second.resolve().name)):
            typer.echo(line)
        typer.echo(f"look at {out / PAGE}")
