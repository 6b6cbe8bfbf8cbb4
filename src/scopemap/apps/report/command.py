"""`scopemap report`: the page and the picture of a finished run, made again."""

from __future__ import annotations

from typing import Annotated

import typer

from scopemap.terminal.options import ResultFolder, warn_of_damage


def report(
    run: ResultFolder,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures", help="Read the frames' images from the input again; default: only if the result has none."
        ),
    ] = False,
) -> None:
    """Write report.html and summary.png of a run again."""
    from scopemap.engine.errors import InputError
    from scopemap.report.page import write_report
    from scopemap.result.result import Result
    from scopemap.runner.reread_frames import keep_pictures_again

    warn_of_damage(run)
    if pictures or not Result(run).pictured:
        try:
            keep_pictures_again(run)
        except InputError as fault:
            if pictures or not (run / "frames.csv").is_file():
                raise
            typer.echo(f"warning: the page shows no frames: {fault}", err=True)
    for file in write_report(run):
        typer.echo(f"{file}: {file.stat().st_size / 1e6:.1f} MB")
