"""`scopemap view`: a run's page with its full surface, in the browser of this machine."""

from __future__ import annotations

import time
import webbrowser
from typing import Annotated

import typer

from scopemap.cli.options import RunFolder


def view(
    run: RunFolder,
    port: Annotated[int, typer.Option(min=0, max=65535, metavar="PORT", help="0: any free port.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Show a run's page with all triangles and pictures at localhost, until Ctrl-C; nothing is written."""
    from scopemap.report.page import full_page
    from scopemap.report.serving import LocalServer

    page = full_page(run).encode()
    server = LocalServer({"/": lambda: ("text/html; charset=utf-8", page)}, port=port)
    typer.echo(f"{run}: {server.url} ({len(page) / 1e6:.1f} MB); Ctrl-C ends it")
    if browser:
        webbrowser.open(server.url)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        typer.echo("ended", err=True)
    finally:
        server.close()
