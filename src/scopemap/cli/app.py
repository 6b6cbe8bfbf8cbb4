"""The command line: one file per command; parse, call, print.

A known error is one line and exit code 1, wrong usage exit code 2, anything else a traceback.
"""

from __future__ import annotations

import atexit
import gc
import io
import sys
import warnings
from typing import Any

import typer
from typer.core import TyperGroup

from scopemap.apps.batch.command import batch
from scopemap.apps.browser.command import app as window_app
from scopemap.apps.browser.view_command import view
from scopemap.apps.calibrate.command import calibrate
from scopemap.apps.coverage.command import coverage
from scopemap.apps.demo.command import demo
from scopemap.apps.evaluate.command import evaluate
from scopemap.apps.evaluate.measures import with_measures
from scopemap.apps.exams.command import compare_exams
from scopemap.apps.export.command import export
from scopemap.apps.inspect.command import inspect
from scopemap.apps.live.command import live
from scopemap.apps.locate.command import locate
from scopemap.apps.measure.command import measure
from scopemap.apps.models import command as models
from scopemap.apps.report.command import report
from scopemap.apps.run.command import run
from scopemap.apps.verify.command import verify
from scopemap.engine.errors import ScopemapError
from scopemap.input.plugins import plugins

_OF_BENCH = ("bench", "climb", "compare", "datasets", "phantom")
"""Commands of scopemap-bench, which may not be installed."""


class _Commands(TyperGroup):
    """The commands; one whose package is missing is no misspelt other one."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return a command by its name; an error names the package of one that is not installed."""
        if args and args[0] in _OF_BENCH and args[0] not in self.commands:
            ctx.fail(
                f"{args[0]} is a command of the package scopemap-bench, which is not installed; in the folder of "
                "scopemap's source: pip install -c constraints.txt -e bench"
            )
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=_Commands,
    help="From a monocular endoscope video to camera poses and a tissue surface.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_MEASURES = [one for _, added in plugins("scopemap.measures") for one in added]
_GROUPS: dict[str, tuple[Any, ...]] = {
    "Reconstruct": (window_app, run, demo, live),
    "Look": (view, report, export, verify),
    "Measure": (measure, coverage, locate, compare_exams),
    "Compare and evaluate": (with_measures(evaluate, _MEASURES), "compare", "bench", "climb"),
    "Prepare": (inspect, calibrate, "datasets", "phantom", models.app),
    "Many videos": (batch,),
}
"""Commands in the groups of --help, those of scopemap-bench by their names; others stand in a group of their own."""


def _name_of(command: Any) -> str:
    """Return the name of a command of a group."""
    return command if isinstance(command, str) else getattr(command, "__name__", "models").replace("_", "-")


def commands() -> tuple[dict[str, Any], list[str]]:
    """Return the commands, scopemap's own and those of other packages; and names of theirs that scopemap has itself."""
    grouped = [command for group in _GROUPS.values() for command in group]
    own = {_name_of(command): command for command in grouped if not isinstance(command, str)}
    added = dict(plugins("scopemap.commands"))
    return own | {name: command for name, command in added.items() if name not in own}, sorted(
        own.keys() & added.keys()
    )


_COMMANDS, _LEFT_OUT = commands()
_GROUP_OF = {_name_of(command): group for group, of_group in _GROUPS.items() for command in of_group}
for name in sorted(_COMMANDS, key=lambda name: [*_GROUP_OF, name].index(name)):
    command, group = _COMMANDS[name], _GROUP_OF.get(name)
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=name, rich_help_panel=group)
    else:
        app.command(name, rich_help_panel=group)(command)


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


def _freeze() -> None:
    """Keep Python from looking through all that the libraries made once more at exit, which takes .4 s."""
    # Triton, which comes with torch, prints as leaked what is not collected.
    if "triton" not in sys.modules:
        gc.freeze()


def main() -> None:
    """Run the command line."""
    atexit.register(_freeze)
    warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A pipe on Windows has a code page that lacks most letters.
            stream.reconfigure(errors="replace")
    for name in _LEFT_OUT:
        typer.echo(
            f"warning: another package's command {name} is left out, since scopemap has one of that name", err=True
        )
    try:
        app(prog_name="scopemap")
    except ScopemapError as error:
        typer.echo("; ".join([f"scopemap: {error}", *getattr(error, "__notes__", [])]), err=True)
        sys.exit(1)
    except KeyboardInterrupt as error:
        typer.echo("; ".join(["scopemap: stopped", *getattr(error, "__notes__", [])]), err=True)
        sys.exit(130)
