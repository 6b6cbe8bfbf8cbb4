"""`scopemap bench`: methods side by side on the sequences of a plan."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scopemap.cli.figures import print_json
from scopemap.cli.options import AsJson, Quiet

if TYPE_CHECKING:
    from scopemap.benchmark.entry import Entry
    from scopemap.benchmark.result import RunResult


def bench(
    plan: Annotated[
        str | None,
        typer.Argument(
            metavar="PLAN", help="A TOML file, or one of the plans of the package; without it these are listed."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for runs, tables and figures; continues an earlier call.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of the plan's paths.")] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Only print sequences, rows, weights that are missing, and the hours expected."),
    ] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Run failed rows again.")] = False,
    timeout_s: Annotated[
        float | None, typer.Option("--timeout", min=1, help="Seconds after which a run is ended.")
    ] = None,
    paper_units: Annotated[bool, typer.Option("--paper-units", help="Rotations of tables 1 to 3 in radians.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run a benchmark's plan, or the rest of it, and write its tables and figures."""
    from scopemap.benchmark.plan import read_plan

    if plan is None:
        _list_plans()
        return
    if dry_run:
        from scopemap.benchmark.preview import describe

        for line in describe(read_plan(plan), out or Path("."), data):
            typer.echo(line)
        return
    if out is None:
        raise typer.BadParameter("needed with a plan: the folder for runs, tables and figures", param_hint="--out")
    from scopemap.benchmark.figures import FinishedRun, write_results
    from scopemap.benchmark.runner import run_plan

    def tell(entry: Entry, result: RunResult, known: bool) -> None:
        if not (quiet or as_json):
            typer.echo(_line(result, known))

    benchmark = run_plan(read_plan(plan), out, data=data, retry=retry, timeout_s=timeout_s, listener=tell)
    runs = [
        FinishedRun(result, entry.run_folder, entry.open)
        for entry, result in zip(benchmark.entries, benchmark.results, strict=True)
    ]
    title = benchmark.plan.title
    files = write_results(runs, out, title=title, notes=benchmark.notes, paper_units=paper_units)
    for note in [] if quiet else benchmark.notes:
        typer.echo(f"note: {note}", err=True)
    if as_json:
        print_json([asdict(result) for result in benchmark.results])
    elif not quiet:
        typer.echo(f"{len(files)} tables and figures in {out}; results.md holds the tables")


def _list_plans() -> None:
    from scopemap.benchmark.plan import read_plan, shipped_plans

    for name in shipped_plans():
        plan = read_plan(name)
        typer.echo(f"{name}: {plan.title}, {len(plan.method)} methods\n    {plan.description}")


def _line(result: RunResult, known: bool) -> str:
    start = f"{result.sequence}: {result.method}: "
    again = " (kept)" if known else ""
    if result.status != "done":
        return f"{start}{'failed, ' if result.status == 'failed' else ''}{result.error}{again}"
    poses, timing = result.figures.get("poses", {}), result.timing
    scored = f"ATE {poses['ate_rmse_mm']:.3f} mm, " if poses.get("ate_rmse_mm") is not None else ""
    pace = timing.get("ms_per_frame")
    return f"{start}{scored}{f'{pace:.0f} ms a frame' if pace else 'done'}{again}"
