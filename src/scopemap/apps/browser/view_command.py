"""`scopemap view`: a result in a window of the browser, alone or beside another one; or films of it."""

from __future__ import annotations

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
            metavar="FILE",
            help="Write a film of the turning surface (.mp4, .mkv, .webm) instead of opening the window.",
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a film of the video beside the surface (.mp4, .mkv, .webm) instead of opening the window.",
        ),
    ] = None,
    colours: Annotated[
        Literal["coverage", "confidence"] | None,
        typer.Option(help="Colour the surface in --video by what was not seen, or by confidence."),
    ] = None,
    source: InputNow = None,
    overwrite: Overwrite = False,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="OTHER",
            help="Compare with another result, of the same video or of another examination of the same place.",
        ),
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Show a result, or compare two, in a browser window.

    The window needs the extra app and is at localhost until Ctrl-C. Films need neither.
    """
    if colours is not None and video is None:
        raise typer.BadParameter("they are those of --video", param_hint="--colours")
    for film in filter(None, (turntable, video)):
        check_output(film, (".mp4", ".mkv", ".webm"), overwrite)
    if compare is not None and (turntable is not None or video is not None):
        raise typer.BadParameter("it is of the window, not of films", param_hint="--compare")
    for folder in filter(None, (run, compare)):
        warn_of_damage(folder)
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
    from scopemap.apps.browser.command import serve
    from scopemap.apps.browser.compare_page import ComparePage
    from scopemap.apps.browser.result_page import ResultPage
    from scopemap.apps.browser.window import BrowserWindow
    from scopemap.terminal.window_beside import check_installed

    check_installed()
    page = ResultPage(run) if compare is None else ComparePage(run, compare)
    window = BrowserWindow(port)
    window.show(page)
    serve(window, browser=browser, quiet=False)
