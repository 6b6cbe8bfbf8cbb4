"""The command line: one file per command; parse, call, print.

A known error is one line and exit code 1, wrong usage exit code 2, anything else a traceback.
"""

from __future__ import annotations

import sys

import typer

from scopemap.cli import datasets, models
from scopemap.cli.bench import bench
from scopemap.cli.calibrate import calibrate
from scopemap.cli.compare import compare
from scopemap.cli.demo import demo
from scopemap.cli.evaluate import evaluate
from scopemap.cli.export import export
from scopemap.cli.inspect import inspect
from scopemap.cli.phantom import phantom
from scopemap.cli.run import run
from scopemap.errors import ScopemapError

app = typer.Typer(
    help="From a monocular endoscope video to camera poses and a tissue surface.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (run, demo, inspect, evaluate, compare, bench, export, phantom, calibrate):
    app.command()(command)
app.add_typer(models.app, name="models")
app.add_typer(datasets.app, name="datasets")


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
    try:
        app(prog_name="scopemap")
    except ScopemapError as error:
        typer.echo(f"scopemap: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("scopemap: stopped", err=True)
        sys.exit(130)
