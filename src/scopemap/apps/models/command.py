"""`scopemap models`: what weights there are, fetch them, check them."""

from __future__ import annotations

from typing import Annotated

import typer

from scopemap.engine.errors import WeightsError
from scopemap.terminal.figures import print_json, print_table
from scopemap.terminal.options import AsJson, Quiet

app = typer.Typer(help="List, download and verify weights of networks.", no_args_is_help=True)


@app.command("list")
def list_(as_json: AsJson = False, quiet: Quiet = False) -> None:
    """List the known weights and whether they are present."""
    from scopemap.engine.models import weights

    rows = weights.overview()
    if as_json:
        fields, folder = ("name", "purpose", "licence", "size_mb"), weights.weights_folder()
        facts = [{"state": state, "path": str(folder / one.place)} for one, state in rows]
        print_json([{key: getattr(one, key) for key in fields} | of for (one, _), of in zip(rows, facts, strict=True)])
    elif not quiet:
        shown = ((one.name, state, f"{one.size_mb:.1f}", one.licence, one.purpose) for one, state in rows)
        heads = ("name", "state", "MB", "licence", "what it is")
        print_table(heads, shown, title=f"weights in {weights.weights_folder()}")


@app.command()
def pull(
    name: Annotated[str, typer.Argument(help="Name from `scopemap models list`, or any hub id (owner/model).")],
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Download weights to SCOPEMAP_WEIGHTS_DIR, or to the user's cache."""
    from scopemap.engine.models import weights

    path = weights.pull(name, progress=not (quiet or as_json))
    if as_json:
        print_json({"name": name, "path": str(path)})
    elif not quiet:
        typer.echo(f"{name}: {path}")


@app.command()
def verify(
    name: Annotated[str | None, typer.Argument(help="Weights to check; default: all that are present.")] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Check the hashes of downloaded weights."""
    from scopemap.engine.models import weights

    states = {one.name: state for one, state in weights.overview() if state != "missing"}
    names, faults = [name] if name else list(states), dict[str, str]()
    for each in names:
        try:
            weights.verify(each)
        except WeightsError as error:
            faults[each] = str(error)
    sound = {each: "by hand, no hash to check" if states.get(each) == "by hand" else "ok" for each in names}
    if as_json:
        print_json(sound | faults)
    elif not quiet:
        lines = [f"{each}: {sound[each]}" for each in names if each not in faults]
        for line in lines if names else ["no weights are there"]:
            typer.echo(line)
    if faults:
        raise WeightsError("; ".join(faults.values()))
