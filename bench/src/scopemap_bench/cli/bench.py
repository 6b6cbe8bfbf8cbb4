"""`scopemap bench`: methods side by side on the sequences of a plan; `scopemap bench speed`: the time of each stage."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scopemap.engine.errors import InputError
from scopemap.terminal.figures import print_json
from scopemap.terminal.options import AsJson, Quiet

if TYPE_CHECKING:
    from scopemap_bench.entry import Entry
    from scopemap_bench.result import RunResult
    from scopemap_bench.speed import Speed

_Preset = Literal["default", "paper", "paper-strict", "realtime"]
_TOLERANCE = 0.1  # share by which a stage may be slower
_WHOLE_TOLERANCE = 0.15  # by which the whole process may be; on a busy machine it varies by a tenth
_WHOLE_RUNS = 3  # the median counts


def bench(
    plan: Annotated[
        str | None,
        typer.Argument(
            metavar="PLAN|speed",
            help="Name of a plan or a TOML file; default: list the plans. speed: time each stage.",
        ),
    ] = None,
    video: Annotated[
        Path | None, typer.Argument(metavar="[VIDEO]", help="Video that speed measures; default: a phantom.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for runs, tables and figures; an earlier call there is resumed.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder that the plan's paths refer to.")] = None,
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
    frames: Annotated[int | None, typer.Option(min=2, help="For speed: use the first N frames; default: all.")] = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="For speed: name the stages that are slower than in FILE, which --json wrote."
        ),
    ] = None,
    whole: Annotated[
        bool,
        typer.Option("--whole", help="With --compare: look at the whole process alone, by the median of three runs."),
    ] = False,
    preset: Annotated[_Preset | None, typer.Option(help="For speed: preset of the run; default: default.")] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run or resume a benchmark plan, or time the stages of a run.

    The exit code is 1 if no row of the plan is done.
    """
    of_plans = {"--out": out, "--data": data, "--timeout": timeout_s}
    of_plans |= {"--dry-run": dry_run or None, "--retry": retry or None, "--paper-units": paper_units or None}
    of_speed = {"VIDEO": video, "--frames": frames, "--compare": compare, "--preset": preset, "--whole": whole or None}
    unused = of_plans if plan == "speed" else of_speed
    if given := [name for name, value in unused.items() if value is not None]:
        raise typer.BadParameter(f"only {'plans take' if plan == 'speed' else 'speed takes'} it", param_hint=given[0])
    if plan == "speed":
        if whole and compare is None:
            raise typer.BadParameter("it needs --compare", param_hint="--whole")
        _print_speed(video, frames, preset or "default", compare, whole, as_json)
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


def _print_speed(
    video: Path | None, frames: int | None, preset: _Preset, compare: Path | None, whole: bool, as_json: bool
) -> None:
    """Measure and print; ends with code 1 where a stage, or the whole, is slower than in the file to compare with."""
    from scopemap.engine.config import Config
    from scopemap_bench.speed import measure_speed, read_speed

    before, tolerance = None if compare is None else read_speed(compare), _WHOLE_TOLERANCE if whole else _TOLERANCE
    speed = measure_speed(video, Config.load(preset), frames, _WHOLE_RUNS if whole else 1)
    slower = [] if before is None else speed.slower_than(before, tolerance, whole=whole)
    if as_json:
        print_json(speed.json())
    else:
        _print_stages(speed)
    for line in slower:
        typer.echo(f"slower: {line}", err=True)
    if slower:
        raise typer.Exit(1)
    if before is not None and not as_json:
        what = "the whole process is not" if whole else "no stage is"
        typer.echo(f"{what} more than {tolerance:.0%} slower than in {compare}")


def _print_stages(speed: Speed) -> None:
    width, height = speed.size
    typer.echo(f"{speed.clip}: {speed.frames} frames of {width}x{height} px, processor time per frame")
    typer.echo(f"calibration (one DIS flow at 320x256 px): {speed.calibration_ms:.1f} ms\n")
    typer.echo(f"{'stage':28s}{'ms':>8s}{'ratio':>8s}{'share':>8s}  thread")
    for name, stage in speed.stages.items():
        typer.echo(f"{name:28s}{stage.ms:8.2f}{stage.ratio:8.2f}{stage.share:8.1%}  {stage.thread}")
    passed = f"{speed.passed_ms:.1f} ms passed, {1e3 / speed.passed_ms:.1f} frames/s"
    flows = f"{speed.cpu_ms:.1f} ms of processor time, {speed.whole_ratio:.1f} DIS flows"
    typer.echo(f"\nwhole process, start and compilers too: {flows}, {passed}")


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
