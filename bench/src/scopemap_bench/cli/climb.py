"""`scopemap climb`: runs as a submission to the CLiMB challenge."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from scopemap.engine.errors import InputError
from scopemap.terminal.options import AsJson, Quiet


def climb(
    out: Annotated[Path, typer.Option(help="Folder of the submission; clips are added to it.")],
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RUN]...", help="Folders of runs; without any, only --out is checked."),
    ] = None,
    clip: Annotated[str, typer.Option(help="Name of the clip; default: that of the run's input.")] = "",
    videos: Annotated[
        Path | None, typer.Option(help="Folder of the challenge's videos; every video must have a clip.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Convert runs into a CLiMB submission and check it.

    Each run becomes the five runs of a clip. The exit code is 1 if the submission breaks a rule of the challenge.
    """
    from scopemap_bench.climb.submission import submission_problems, write_submission

    written = [write_submission(run, out, clip) for run in runs or []]
    problems = submission_problems(out, videos)
    if as_json:
        facts = {"out": str(out), "format": "climb", "written": written, "problems": problems}
        typer.echo(json.dumps(facts, indent=2))
    elif not quiet:
        typer.echo("\n".join(problems) or f"{out}: valid")
    if problems:
        raise InputError(f"{out}: {len(problems)} problems, the first: {problems[0]}")
