"""`scopemap compare`: finished runs, and other people's trajectories, side by side."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from scopemap.engine.errors import InputError
from scopemap.terminal.figures import print_json
from scopemap.terminal.options import Align, AsJson, Quiet, Unit


def compare(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR...", help="Folders of runs, folder of a benchmark, or trajectory files of any system."
        ),
    ],
    truth: Annotated[
        Path | None,
        typer.Option(help="True poses: data set's folder or trajectory file; a benchmark has its own."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for tables and figures.")] = None,
    names: Annotated[
        str | None, typer.Option(metavar="A,B,...", help="Names of the rows; default: those of the folders.")
    ] = None,
    align: Annotated[
        Align, typer.Option(help="Align before measuring; runs of a benchmark keep their figures.")
    ] = "sim3",
    unit: Annotated[
        Unit | None, typer.Option(help="Unit of trajectory files that state none; default: their format's.")
    ] = None,
    consistency: Annotated[
        bool, typer.Option("--consistency", help="Also measure the consistency of depth over time.")
    ] = False,
    paper_units: Annotated[
        bool, typer.Option("--paper-units", help="Print rotations of tables 1 to 3 in radians; default: degrees.")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Compare runs with one truth, or two runs with each other.

    Without a truth, the first of two runs is aligned to the second by a Sim(3) fitted to their common frames.
    """
    from scopemap.report.page import PAGE, write_comparison
    from scopemap.result.result import Result
    from scopemap_bench.comparison import compare as compare_runs
    from scopemap_bench.comparison import write_results
    from scopemap_bench.plan import ProtocolPlan
    from scopemap_bench.tables import benchmark_tables
    from scopemap_bench.two_runs import refuse_run_as_truth

    for path in paths:
        if not os.path.exists(path):
            raise InputError(f"comparing {path}: no such file or folder")
    given = [name.strip() for name in names.split(",")] if names else []
    if truth is not None:
        refuse_run_as_truth(truth)
    elif len(paths) == 2 and all(Result(path).is_finished for path in paths):
        if (align, unit, consistency, paper_units) != ("sim3", None, False, False):
            raise InputError("--align, --unit, --consistency and --paper-units need --truth: two runs alone have none")
        _compare_two(paths, given, out, as_json=as_json, quiet=quiet)
        return
    protocol = ProtocolPlan(align=align, consistency=consistency)
    runs = compare_runs(paths, truth, protocol, names=given, unit=unit)
    results = [run.result for run in runs]
    files = [] if out is None else write_results(runs, out, title="Comparison", paper_units=paper_units)
    finished = [run for run in runs if Result(run.folder).is_finished]
    if out is not None and finished:
        names_shown = [f"{run.result.method}, {run.result.sequence}" for run in finished]
        files.append(write_comparison([run.folder for run in finished], names_shown, out / PAGE))
    for result in () if quiet else results:
        for sentence in result.facts.get("doubts", ()):
            typer.echo(f"warning: {result.method}: {sentence}", err=True)
    if as_json:
        print_json([asdict(result) for result in results])
    elif not quiet:
        overview = benchmark_tables(results)[0].without_empty()
        typer.echo(overview.markdown())
        typer.echo(overview.caption)
        if files:
            seen = f", {PAGE} shows the runs" if finished else ""
            typer.echo(f"\n{len(files)} tables and figures in {out}; results.md holds the tables{seen}")


def _compare_two(paths: list[Path], names: list[str], out: Path | None, *, as_json: bool, quiet: bool) -> None:
    from scopemap_bench.two_runs import compare_two

    if names and len(names) != len(paths):
        raise InputError(f"comparing {len(paths)} runs: {len(names)} names were given")
    if paths[0].resolve() == paths[1].resolve():
        raise InputError(f"comparing {paths[0]} with itself: give two runs")
    first, second = names or [path.resolve().name for path in paths]
    if first == second:
        first, second = map(str, paths)
    found, files = compare_two(paths[0], paths[1], (first, second), out)
    if found.figures["same_input"] is False and not quiet:
        typer.echo("warning: the runs read different inputs; their frames are matched by their numbers", err=True)
    if as_json:
        print_json(found.figures | {"files": [str(file) for file in files]})
    elif not quiet:
        typer.echo("\n".join(found.lines()))
        if files:
            typer.echo(f"pictures in {out}: {', '.join(file.name for file in files)}")
