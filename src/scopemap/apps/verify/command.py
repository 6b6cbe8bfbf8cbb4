"""`scopemap verify`: whether the files of a result are as they were written."""

from __future__ import annotations

from dataclasses import asdict

import typer

from scopemap.terminal.figures import print_json
from scopemap.terminal.options import AsJson, Quiet, ResultFolder

_MOST_NAMED = 20


def verify(
    run: ResultFolder,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Check the files of a result against its SHA256SUMS.

    The exit code is 1 if a file is damaged or missing. `sha256sum -c SHA256SUMS` in the folder checks the same.
    """
    from scopemap.apps.verify.verifying import verify_result

    found = verify_result(run)
    if as_json:
        print_json(asdict(found) | {"is_whole": found.is_whole})
    elif not quiet:
        changed = {"damaged": found.damaged, "missing": found.missing, "not of the run": found.added}
        for what, names in (changed | {"added by scopemap after the run": found.later}).items():
            for name in names[:_MOST_NAMED]:
                typer.echo(f"{what}: {name}")
            if len(names) > _MOST_NAMED:
                typer.echo(f"{what}: {len(names) - _MOST_NAMED} more, see --json")
        for note in found.notes:
            typer.echo(f"note: {note}")
        counts = f"{len(found.damaged)} damaged, {len(found.missing)} missing"
        typer.echo(f"{run}: {found.whole} files as they were, {counts}, {found.bytes / 1e6:.1f} MB read")
    if not found.is_whole:
        raise typer.Exit(1)
