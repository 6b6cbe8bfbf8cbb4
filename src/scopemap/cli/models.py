"""`scopemap models`: what weights there are, fetch them, check them."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from scopemap.cli.options import AsJson, Quiet
from scopemap.errors import WeightsError
from scopemap.io import weights

app = typer.Typer(help="Weights of the networks: list, pull, verify.", no_args_is_help=True)


@app.command("list")
def list_(as_json: AsJson = False, quiet: Quiet = False) -> None:
    """List the known weights and whether they are there."""
    _show(weights.overview(), as_json, quiet)


@app.command()
def pull(
    name: Annotated[str, typer.Argument(help="A name from `scopemap models list`, or any hub id (owner/model).")],
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Download weights into the weights folder (SCOPEMAP_WEIGHTS_DIR, or the user's cache)."""
    path = weights.pull(name, progress=not (quiet or as_json))
    _say({"name": name, "path": str(path)}, f"{name}: {path}", as_json, quiet)


@app.command()
def verify(
    name: Annotated[str | None, typer.Argument(help="Weights to check; all that are there, if left out.")] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Hash weights anew and compare them with the pinned or recorded hashes."""
    states = {row.name: row.state for row in weights.overview() if row.state != "missing"}
    names = [name] if name else list(states)
    faults = {each: fault for each in names if (fault := _fault(each))}
    sounds = {each: "by hand, no hash to check" if states.get(each) == "by hand" else "ok" for each in names}
    verdict = sounds | faults
    sound = [f"{each}: {sounds[each]}" for each in names if each not in faults]
    if as_json or sound or not faults:
        _say(verdict, "\n".join(sound) or "no weights are there", as_json, quiet)
    if faults:
        raise WeightsError("; ".join(faults.values()))


def _fault(name: str) -> str:
    try:
        weights.verify(name)
    except WeightsError as error:
        return str(error)
    return ""


def _show(rows: list[weights.Row], as_json: bool, quiet: bool) -> None:
    if as_json:
        fields = ("name", "purpose", "licence", "size_mb", "state")
        listed = [{key: getattr(row, key) for key in fields} | {"path": str(row.path)} for row in rows]
        _say(listed, "", as_json, quiet)
    elif not quiet:
        table = Table("name", "state", "MB", "licence", "what it is", title=f"weights in {weights.weights_folder()}")
        for row in rows:
            table.add_row(row.name, row.state, f"{row.size_mb:.1f}", row.licence, row.purpose)
        Console().print(table)


def _say(content: Any, text: str, as_json: bool, quiet: bool) -> None:
    if as_json:
        typer.echo(json.dumps(content, indent=2))
    elif not quiet:
        typer.echo(text)
