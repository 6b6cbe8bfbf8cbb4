"""`scopemap bench`: methods side by side on the sequences of a plan; `scopemap bench speed`: the time of each stage."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scopemap.engine.errors import InputError
from scopemap.terminal.figures import print_json
from scopemap.terminal.options import AsJson, Quiet, parse_slice

if TYPE_CHECKING:
    from scopemap_bench.entry import Entry
    from scopemap_bench.result import RunResult

_Preset = Literal["default", "paper", "paper-strict", "realtime"]


def bench(
    plan: Annotated[
        str | None,
        typer.Argument(
            metavar="PLAN|speed",
            help="Name of a plan or a TOML file; default: list the plans. speed: time each stage.",
        ),
    ] = None,
    video: Annotated[
        str | None, typer.Argument(metavar="[VIDEO]", help="Video that speed measures; default: a phantom.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for runs, tables and figures; an earlier call there is resumed.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option(help="Folder that the paths of a plan, and those of speed's videos, refer to.")
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Only print sequences, rows, missing packages and weights, and expected hours."),
    ] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Run failed rows again.")] = False,
    timeout_s: Annotated[
        float | None, typer.Option("--timeout", min=1, help="Stop a run after this many seconds; default: no limit.")
    ] = None,
    paper_units: Annotated[
        bool, typer.Option("--paper-units", help="Print rotations of tables 1 to 3 in radians; default: degrees.")
    ] = False,
    frames: Annotated[
        slice | None,
        typer.Option(parser=parse_slice, metavar="A:B:S", help="For speed: frames to use, such as 0:60; default: all."),
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="For speed: measure what FILE holds, which --json wrote, and name the stages that are slower now.",
        ),
    ] = None,
    whole: Annotated[
        bool,
        typer.Option(
            "--whole",
            help="With --compare: look at the whole process alone; if it is slower, the median of three runs counts.",
        ),
    ] = False,
    preset: Annotated[_Preset | None, typer.Option(help="For speed: preset of the run; default: default.")] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run or resume a benchmark plan, or time the stages of a run.

    The exit code is 1 if no row of the plan is done.
    """
    of_plans = {"--out": out, "--timeout": timeout_s}
    of_plans |= {"--dry-run": dry_run or None, "--retry": retry or None, "--paper-units": paper_units or None}
    of_clip = {"VIDEO": video, "--frames": frames, "--preset": preset}
    unused = of_plans if plan == "speed" else of_clip | {"--compare": compare, "--whole": whole or None}
    if given := [name for name, value in unused.items() if value is not None]:
        raise typer.BadParameter(f"only {'plans take' if plan == 'speed' else 'speed takes'} it", param_hint=given[0])
    if plan == "speed":
        from scopemap_bench.cli.speed import compare_speed, print_speed

        if compare is None and whole:
            raise typer.BadParameter("it needs --compare", param_hint="--whole")
        if compare is None:
            print_speed(video, frames or slice(None), preset or "default", data, as_json)
        elif given := [name for name, value in of_clip.items() if value is not None]:
            raise typer.BadParameter("--compare measures what its file holds", param_hint=given[0])
        else:
            compare_speed(compare, data, whole, as_json)
        return
    from scopemap_bench.plan import read_plan

    if plan is None:
        _list_plans()
        return
    if dry_run:
        from scopemap_bench.runner import describe

        for line in describe(read_plan(plan), out or Path("."), data):
            typer.echo(line)
        return
    if out is None:
        raise typer.BadParameter("needed with a plan: the folder for runs, tables and figures", param_hint="--out")
    from scopemap_bench.comparison import FinishedRun, write_results
    from scopemap_bench.runner import run_plan

    def tell(entry: Entry, result: RunResult, known: bool) -> None:
        if not (quiet or as_json):
            typer.echo(_line(result, known))

    benchmark = run_plan(read_plan(plan), out, data=data, retry=retry, timeout_s=timeout_s, listener=tell)
    pairs = zip(benchmark.entries, benchmark.results, strict=True)
    runs = [FinishedRun(result, entry.run_folder, entry.open, entry.sequence.figure) for entry, result in pairs]
    title = benchmark.plan.title
    files = write_results(runs, out, title=title, notes=benchmark.notes, paper_units=paper_units)
    for note in [] if quiet else benchmark.notes:
        typer.echo(f"note: {note}", err=True)
    if as_json:
        print_json([asdict(result) for result in benchmark.results])
    elif not quiet:
        typer.echo(f"{len(files)} tables and figures in {out}; results.md holds the tables")
    _need_a_row(benchmark.results)


def _need_a_row(results: list[RunResult]) -> None:
    """Raise `InputError`, with the reason of the first row, where no row is done: the tables hold no figure."""
    if any(result.status == "done" for result in results):
        return
    counts = Counter(result.status for result in results)
    found = " and ".join(f"{count} {status}" for status, count in counts.items())
    first = results[0]
    raise InputError(f"no row is done ({found}); the first, {first.sequence} by {first.method}: {first.error}")


def _list_plans() -> None:
    from scopemap_bench.plan import read_plan, shipped_plans

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
