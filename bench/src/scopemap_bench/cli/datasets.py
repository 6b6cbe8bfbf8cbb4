"""`scopemap datasets`: list the data sets that are read, and check one."""

from __future__ import annotations

import inspect
import re
import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scopemap.engine.errors import InputError, ScopemapError
from scopemap.terminal.figures import print_findings, print_json, print_table, print_values
from scopemap.terminal.options import AsJson, CameraFile, Dataset, Quiet, SetPairs, parse_settings
from scopemap.terminal.progress import count_progress

if TYPE_CHECKING:
    from scopemap.apps.inspect.clip import Finding
    from scopemap.input.source import Source

app = typer.Typer(help="List the supported data sets, or check one.", no_args_is_help=True)


@app.command("list")
def list_(as_json: AsJson = False, quiet: Quiet = False) -> None:
    """List the supported data sets in the order of recognition."""
    from scopemap.input.opening import readers

    # A reader's docstrings and its layout's table are the only description of a data set.
    rows = []
    for name, kind in readers().items():
        rows.append({"name": name, "what": _first_line(sys.modules[kind.__module__]), "recognised": _recognised(kind)})
    if as_json:
        print_json(rows)
    elif not quiet:
        print_table(("name", "what it is", "how it is recognised"), (row.values() for row in rows))


@app.command()
def check(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="Video, folder of images, or folder of a data set.")],
    dataset: Dataset = None,
    camera: CameraFile = None,
    settings: SetPairs = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Check the frames, camera, poses and depth of a data set.

    The exit code is 1 if there are errors.
    """
    from scopemap.engine.config import Config
    from scopemap.input.opening import open_sequence
    from scopemap_bench.datasets.checking import check as findings_of
    from scopemap_bench.datasets.checking import refusal
    from scopemap_bench.datasets.survey import survey

    figures: dict[str, Any] = {}
    # Pictures that repeat are to be found here, not left out.
    reading = Config.load(settings={"input.skip_duplicates": False} | parse_settings(settings or [])).input
    try:
        sequence = open_sequence(path, dataset=dataset, camera=camera, settings=reading)
    except ScopemapError as error:
        findings = [refusal(error)]
    else:
        with count_progress("checking", "checked", silent=quiet or as_json) as listener:
            found = survey(sequence, listener)
        figures, findings = found.figures, findings_of(found)
    if as_json:
        print_json({"path": str(path), "figures": figures, "findings": [asdict(finding) for finding in findings]})
    elif not quiet:
        _print(path, figures, findings)
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        more = f" (and {len(errors) - 1} more error(s))" if len(errors) > 1 else ""
        raise InputError(f"checking {path}: {errors[0].code}: {errors[0].message}{more}")


def _first_line(documented: object) -> str:
    return (inspect.getdoc(documented) or "").split("\n")[0]


def _recognised(kind: type[Source]) -> str:
    """Return in a sentence for users where a reader is chosen."""
    from scopemap_bench.datasets.layouts import LayoutFolder

    if issubclass(kind, LayoutFolder):
        return f"It holds {kind.recognised()}."
    condition = re.sub(r"^(Return w|W)hether ", "", _first_line(kind.recognises)).replace("`path`", "it")
    return f"{condition[0].upper()}{condition[1:]}"


def _print(path: Path, figures: dict[str, Any], findings: list[Finding]) -> None:
    typer.echo(str(path))
    if figures:
        print_values(figures)
    print_findings([(finding.severity, finding.code, finding.message) for finding in findings])
    counts = Counter(finding.severity for finding in findings)
    typer.echo(f"errors: {counts['error']}, warnings: {counts['warning']}")
