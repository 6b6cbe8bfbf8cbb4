"""The command line: one file per command; parse, call, print.

A known error is one line and exit code 1, wrong usage exit code 2, anything else a traceback.
"""

from __future__ import annotations

import atexit
import gc
import io
import sys

import typer

from scopemap.cli import models
from scopemap.cli.batch import batch
from scopemap.cli.calibrate import calibrate
from scopemap.cli.compare_exams import compare_exams
from scopemap.cli.coverage import coverage
from scopemap.cli.demo import demo
from scopemap.cli.evaluate import evaluate
from scopemap.cli.export import export
from scopemap.cli.inspect import inspect
from scopemap.cli.live import live
from scopemap.cli.locate import locate
from scopemap.cli.measure import measure
from scopemap.cli.report import report
from scopemap.cli.run import run
from scopemap.cli.verify import verify
from scopemap.cli.view import view
from scopemap.errors import ScopemapError
from scopemap.plugins import plugins

app = typer.Typer(
    help="From a monocular endoscope video to camera poses and a tissue surface.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_OWN = (
    *(run, batch, live, view, report, demo, inspect, evaluate, export, measure, coverage, locate),
    *(compare_exams, verify, calibrate, models.app),
)
_COMMANDS = {getattr(command, "__name__", "models").replace("_", "-"): command for command in _OWN} | dict(
    plugins("scopemap.commands")
)
for name, command in _COMMANDS.items():
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=name)
    else:
        app.command(name)(command)


def _version(requested: bool) -> None:
    if requested:
        from scopemap import __version__

        typer.echo(f"scopemap {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    """From a monocular endoscope video to camera poses and a tissue surface."""


def main() -> None:
    """Run the command line."""
    atexit.register(gc.freeze)  # else Python looks through all that the libraries made once more: .4 s
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A pipe on Windows has a code page that lacks most letters.
            stream.reconfigure(errors="replace")
    try:
        app(prog_name="scopemap")
    except ScopemapError as error:
        typer.echo("; ".join([f"scopemap: {error}", *getattr(error, "__notes__", [])]), err=True)
        sys.exit(1)
    except KeyboardInterrupt as error:
        typer.echo("; ".join(["scopemap: stopped", *getattr(error, "__notes__", [])]), err=True)
        sys.exit(130)
