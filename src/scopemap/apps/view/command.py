"""`scopemap view`: a run's page with its full surface, in the browser of this machine."""

from __future__ import annotations

import time
import webbrowser
from pathlib import Path
from typing import Annotated, Literal

import typer

from scopemap.terminal.options import InputNow, Overwrite, ResultFolder, check_output, warn_of_damage


def view(
    run: ResultFolder,
    port: Annotated[
        int, typer.Option(min=0, max=65535, metavar="PORT", help="Port of the page; 0: any free port.")
    ] = 0,
    turntable: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write a film of the turning surface (.mp4, .mkv, .webm) instead of opening the page."
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a film of the video beside the surface (.mp4, .mkv, .webm) instead of opening the page.",
        ),
    ] = None,
    colours: Annotated[
        Literal["coverage", "confidence"] | None,
        typer.Option(help="Colour the surface in --video by what was not seen, or by confidence."),
    ] = None,
    source: InputNow = None,
    overwrite: Overwrite = False,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Show a run's page with its full surface in a browser.

    The page is served at localhost until Ctrl-C. It writes only measurements.json, when you measure and save.
    """
    if colours is not None and video is None:
        raise typer.BadParameter("they are those of --video", param_hint="--colours")
    for film in filter(None, (turntable, video)):
        check_output(film, (".mp4", ".mkv", ".webm"), overwrite)
    warn_of_damage(run)
    if turntable is not None or video is not None:
        from scopemap.apps.view.fly_through import write_fly_through
        from scopemap.apps.view.paintings import confidence_painting, coverage_painting
        from scopemap.report.films import write_turntable

        if turntable is not None:
            write_turntable(run, turntable)
        if video is not None:
            paintings = {"coverage": coverage_painting, "confidence": confidence_painting}
            write_fly_through(run, video, source, None if colours is None else paintings[colours](run))
        for film in filter(None, (turntable, video)):
            typer.echo(f"{film}: {film.stat().st_size / 1e6:.1f} MB")
        return
    from scopemap.report.page import serve_view

    server = serve_view(run, port)
    typer.echo(f"{run}: {server.url} until Ctrl-C")
    if browser:
        webbrowser.open(server.url)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        typer.echo("ended", err=True)
    finally:
        server.close()
