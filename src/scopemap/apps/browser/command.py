"""`scopemap app`: choose a video in the browser, watch its surface grow, ask it questions."""

from __future__ import annotations

import signal
import threading
import webbrowser
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scopemap.terminal.options import Quiet

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_OPEN_TO_ALL = "warning: whoever reaches {host} sees the pictures and can start runs; a tunnel is safer (docs/app.md)"


def app(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Folder of videos; results are written to FOLDER/scopemap.")
    ] = Path(),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0: any free port.")] = 0,
    host: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS", help="Address to serve at; any but the default is reachable from other machines."
        ),
    ] = "127.0.0.1",
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    anonymous: Annotated[bool, typer.Option("--anonymous", help="Show no names of files.")] = False,
    keep_uploads: Annotated[
        bool, typer.Option("--keep-uploads", help="Keep videos that are sent to the page in FOLDER/scopemap/uploads.")
    ] = False,
    upload_limit: Annotated[
        float, typer.Option(min=0.001, metavar="GB", help="Largest video that the page takes, GB.")
    ] = 4.0,
    quiet: Quiet = False,
    watch: Annotated[
        Path | None, typer.Option("--watch", hidden=True, help="Show the run that writes to this folder.")
    ] = None,
    result: Annotated[
        Path | None, typer.Option("--result", hidden=True, help="Folder of the result of --watch.")
    ] = None,
    live: Annotated[bool, typer.Option("--live", hidden=True, help="Show that run as a live stream.")] = False,
) -> None:
    """Reconstruct, look and measure in a browser window.

    Everything stays on this machine. Ctrl-C ends the window and the run that it shows; the run resumes next time.
    """
    from scopemap.apps.browser.serving import LOOPBACK
    from scopemap.apps.browser.start_page import StartPage
    from scopemap.apps.browser.window import BrowserWindow
    from scopemap.apps.browser.workspace import Workspace
    from scopemap.engine.errors import InputError

    if watch is not None:
        _beside_a_command(BrowserWindow(port, host, anonymous=anonymous), watch, result, live=live, browser=browser)
        return
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder: name the folder of the videos")
    if host not in (LOOPBACK, "localhost", "::1"):
        typer.echo(_OPEN_TO_ALL.format(host=host), err=True)
    with Workspace(folder, keep_uploads=keep_uploads, most_bytes=round(upload_limit * 1e9)) as workspace:
        window = BrowserWindow(port, host, anonymous=anonymous)
        window.always(workspace.runs.tick)
        window.show(StartPage(workspace))
        serve(window, browser=browser, quiet=quiet)


def _beside_a_command(window: BrowserWindow, view: Path, result: Path | None, *, live: bool, browser: bool) -> None:
    """Show the run of another command, and then its result; lines of text go to and fro."""
    from scopemap.apps.browser.beside import LIVE_BUTTONS, RunBeside
    from scopemap.apps.browser.result_page import ResultPage
    from scopemap.apps.browser.run_page import RunPage

    run = RunBeside()

    def finished() -> None:
        if result is not None:
            window.show(ResultPage(result))

    name = "Live" if live else "" if result is None else result.name
    buttons = {name: partial(run.press, button) for name, button in LIVE_BUTTONS.items()} if live else None
    window.show(RunPage(run, view, name, finished, buttons=buttons))
    typer.echo(window.url)
    serve(window, browser=browser, quiet=True, ends=lambda: run.is_gone)


def serve(window: BrowserWindow, *, browser: bool, quiet: bool, ends: Callable[[], bool] = lambda: False) -> None:
    """Run a window until Ctrl-C, or until it `ends`."""

    def stop(number: int, frame: object) -> None:
        # A KeyboardInterrupt in the middle of a call would leave viser locked; a second Ctrl-C raises it all the same.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        window.stop()

    is_main = threading.current_thread() is threading.main_thread()
    # A job in the background of a shell ignores Ctrl-C, and goes on.
    heeds = is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_main:
        signal.signal(signal.SIGTERM, lambda number, frame: window.stop())
    if heeds:
        signal.signal(signal.SIGINT, stop)
    try:
        # Whoever has read the address may press Ctrl-C at once.
        if not quiet:
            typer.echo(f"{window.url} until Ctrl-C")
        if browser:
            webbrowser.open(window.url)
        window.run(ends)
    except KeyboardInterrupt:
        pass
    finally:
        window.close()
        if heeds:
            signal.signal(signal.SIGINT, signal.default_int_handler)
    if not quiet:
        typer.echo("ended", err=True)
