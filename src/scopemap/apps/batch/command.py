"""`scopemap batch`: many videos, each in a folder of its own."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from scopemap.engine.errors import SettingsError
from scopemap.terminal import options
from scopemap.terminal.figures import print_json

if TYPE_CHECKING:
    from scopemap.apps.batch.batch import Video
    from scopemap.apps.batch.engines import Engine
    from scopemap.apps.batch.forecast import Forecast
    from scopemap.engine.config import Preset
    from scopemap.input.inputs import NamedInput
    from scopemap.report.batch_page import BatchRow

_SECONDS_BETWEEN_LINES = 60.0
_MOST_NAMED = 8
_COLUMNS = ("name", "preset", "config", "dataset", "camera", "fov", "frames", "size")


def batch(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT...",
            help="Videos, folders, quoted patterns, addresses (s3://...), .txt lists or .csv tables (docs/batch.md).",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results, one folder per video.")],
    preset: options.PresetName = None,
    config: options.ConfigFile = None,
    dataset: options.Dataset = None,
    camera: options.CameraFile = None,
    fov: options.FieldOfView = None,
    scope: options.Scope = None,
    frames: Annotated[
        str | None,
        typer.Option(metavar="A:B:S", help="Frames of each video, as a Python slice such as ::10; default: all."),
    ] = None,
    size: options.Size = None,
    settings: options.SetPairs = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Process N videos at once; default: half the number of cores."),
    ] = None,
    time_limit: Annotated[
        float | None,
        options.advanced(
            min=0.1, metavar="SECONDS", help="Stop a video after this time and mark it as failed; default: no limit."
        ),
    ] = None,
    retries: Annotated[
        int, options.advanced(min=0, metavar="N", help="Try a video N more times if its process dies.")
    ] = 1,
    engine: Annotated[
        Literal["processes", "ray"],
        options.advanced(help="Run videos in processes of this machine, or on a Ray that runs already."),
    ] = "processes",
    address: Annotated[
        str | None, options.advanced(help="Address of the Ray; default: auto, the one that this machine is a node of.")
    ] = None,
    worker_cores: Annotated[
        int | None, options.advanced(min=1, metavar="N", help="Cores of each Ray worker; default: 2.")
    ] = None,
    worker_memory: Annotated[
        str | None, options.advanced(metavar="SIZE", help="Memory of each Ray worker; default: 4GB.")
    ] = None,
    worker_gpus: Annotated[
        float | None,
        options.advanced(
            min=0, help="GPUs of each Ray worker, such as 0.25; default: 1 with networks.device=cuda, else 0."
        ),
    ] = None,
    part: Annotated[
        str | None, options.advanced(metavar="K/N", help="Process only the K-th of N parts, for job arrays.")
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Run one second of each video and print the expected time and space of all."),
    ] = False,
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite", help="Replace results of other settings or inputs; matching finished results are kept."
        ),
    ] = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Reconstruct many videos, each into a folder of its own.

    Look at index.html or batch.csv in the folder of the results. The same command resumes: it skips what is finished
    and repeats what failed. The exit code is 1 if a video failed.
    """
    chosen = {"preset": preset, "config": config, "dataset": dataset, "camera": camera, "fov": fov}
    chosen |= {"frames": frames, "size": size}
    shared = {key: str(value) for key, value in chosen.items() if value is not None}
    of_scope = {"input.scope": scope} if scope else {}
    of_part = options.parse_part(part) if part else (1, 1)
    from scopemap.input.inputs import named_inputs
    from scopemap.runner.processes import ProcessLimits, usable_cores

    videos = videos_of(named_inputs(inputs), shared, of_scope | options.parse_settings(settings or []))
    if workers is None and engine == "ray":
        raise SettingsError("how many videos run at once on Ray? Give --workers")
    limits = ProcessLimits(workers or max(1, usable_cores() // 2), time_limit, retries)
    given: dict[str, Any] = {"address": address, "worker-cores": worker_cores}
    given |= {"worker-memory": worker_memory, "worker-gpus": worker_gpus}
    run = engine_of(engine, given, videos)
    with _ending_by_sigterm():
        if dry_run:
            _forecast(videos[of_part[0] - 1 :: of_part[1]], out, limits, run, as_json=as_json, quiet=quiet)
            return
        from scopemap.apps.batch.batch import INDEX, TABLE, run_batch
        from scopemap.report.batch_page import counts_of
        from scopemap.runner.preparation import compile_once

        if engine == "processes":
            compile_once(
                lambda _, call: call(), lambda doing, *_: None if quiet or as_json else typer.echo(doing, err=True)
            )
        with _lines(silent=quiet or as_json) as show:

            def shown(row: BatchRow, left: int) -> None:
                show(row.folder, _row_line(row), left, row.status == "started")

            rows = run_batch(videos, out, limits, engine=run, overwrite=overwrite, part=of_part, on_change=shown)
    if as_json:
        print_json([asdict(row) for row in rows])
    elif not quiet:
        typer.echo(counts_of(rows))
        typer.echo(f"look at {out / INDEX} in a browser; {out / TABLE} has the same as a table")
    if any(row.status != "done" for row in rows):
        raise typer.Exit(1)


def videos_of(inputs: list[NamedInput], shared: dict[str, str], settings: dict[str, Any]) -> list[Video]:
    """Return the videos of a batch, their settings checked.

    shared : texts of options by the names of a table's columns, which come before them. settings : of `--set`. Raises
    `SettingsError`, with the input that it is about.
    """
    from scopemap.apps.batch.batch import folder_names

    configs: dict[str, Any] = {}
    return [
        _video(one, name, shared | one.columns, settings, configs)
        for one, name in zip(inputs, folder_names(inputs), strict=True)
    ]


def _video(
    one: NamedInput, name: str, columns: dict[str, str], settings: dict[str, Any], configs: dict[str, Any]
) -> Video:
    """Return a video with the settings of its columns; those that equal another's share its `Config`."""
    from scopemap.apps.batch.batch import Video
    from scopemap.engine.config import Config

    try:
        own = {key: value for key, value in columns.items() if key not in _COLUMNS}
        if unknown := [key for key in own if "." not in key]:
            raise SettingsError(
                f"unknown column '{unknown[0]}': {', '.join(_COLUMNS)} or a setting such as depth.backend"
            )
        sources = (columns.get("preset"), columns.get("config"), tuple(sorted(own.items())))
        if (text := repr(sources)) not in configs:
            file = Path(columns["config"]) if "config" in columns else None
            given = settings | options.parse_settings([f"{key}={value}" for key, value in own.items()])
            configs[text] = Config.load(cast("Preset | None", columns.get("preset")), file, given)
        return Video(
            one.path,
            name,
            configs[text],
            dataset=columns.get("dataset"),
            camera=columns.get("camera"),
            fov_deg=_number(columns["fov"]) if "fov" in columns else None,
            size=options.parse_size(columns["size"]) if "size" in columns else None,
            frames=options.parse_slice(columns["frames"]) if "frames" in columns else None,
        )
    except SettingsError as error:
        raise SettingsError(f"{error}; for the input {one.path}") from None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise SettingsError(f"cannot read the field of view '{text[:80]}': expected degrees such as 90") from None


def engine_of(name: str, given: dict[str, Any], videos: list[Video]) -> Engine:
    """Return the engine of a name.

    given : the values of its options, None where one is not given. Raises `SettingsError` for those of another engine.
    """
    from scopemap.apps.batch.engines import WorkerNeeds
    from scopemap.runner.processes import run_in_processes

    if name == "processes":
        for option in (option for option, value in given.items() if value is not None):
            raise SettingsError(f"--{option} is an option of --engine ray")
        return run_in_processes
    from scopemap.apps.batch.ray_engine import RayEngine

    by_default, gpus, memory = WorkerNeeds(), given["worker-gpus"], given["worker-memory"]
    if gpus is None:
        gpus = float(any(video.config.networks.device.startswith("cuda") for video in videos))
    memory_gb = options.parse_memory(memory) / 1000 if memory else by_default.memory_gb
    needs = WorkerNeeds(given["worker-cores"] or by_default.cores, memory_gb, gpus)
    return RayEngine(needs, given["address"] or "auto")


def _forecast(videos: list[Video], out: Path, limits: Any, engine: Engine, *, as_json: bool, quiet: bool) -> None:
    from scopemap.apps.batch.forecast import forecast

    with _lines(silent=quiet or as_json) as show:

        def shown(one: Forecast, left: int) -> None:
            show(one.name, _forecast_line(one), left, False)

        found = forecast(videos, out, limits, shown, engine)
    if as_json:
        print_json([_facts(one) for one in found])
    elif not quiet:
        for line in forecast_lines(found, limits.processes):
            typer.echo(line)


def _facts(one: Forecast) -> dict[str, Any]:
    """Return a forecast as JSON has it, its cost with the names of `scopemap run --dry-run`."""
    cost = {} if one.cost is None else asdict(one.cost) | {"seconds": one.cost.seconds}
    return {"name": one.name, "fault": one.fault, "input_bytes": one.input_bytes} | cost


def forecast_lines(found: list[Forecast], processes: int) -> list[str]:
    """Return the sum of forecasts, one fact per line."""
    known = [one.cost for one in found if one.cost is not None]
    failed = [one for one in found if one.fault]
    unknown = len(found) - len(known) - len(failed)
    work_s = [cost.seconds for cost in known]
    # Videos are not divided: the longest one bounds the time.
    least_s = max([sum(work_s) / processes, *work_s])
    read, written = sum(one.input_bytes for one in found), sum(cost.result_bytes for cost in known)
    lines = [
        f"{len(found)} video{'s' * (len(found) != 1)}, {_span(sum(cost.video_s for cost in known))}, "
        f"{read / 1e9:.2f} GB",
        f"results: about {written / 1e9:.2f} GB",
        f"time: about {_span(least_s)} with {processes} at once ({_span(sum(work_s))} one after the other)",
    ]
    lines += [f"not in these figures: {unknown} of unknown length"] if unknown else []
    return lines + [f"fails: {one.name}: {one.fault}" for one in failed]


def _span(seconds: float) -> str:
    """Return a time in a unit in which it is a number of two digits or more."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} minutes" if seconds < 7200 else f"{seconds / 3600:.1f} hours"


def _forecast_line(one: Forecast) -> str:
    if one.cost is None:
        return f"{one.name}: {one.fault or 'of unknown length'}"
    return f"{one.name}: {one.cost.frames} frames, about {one.cost.seconds:.0f} s"


def _row_line(row: BatchRow) -> str:
    if row.status == "done":
        return f"{row.folder}: {row.verdict}, {row.tracked} of {row.frames} frames, {row.seconds:.0f} s"
    return f"{row.folder}: {row.status}{': ' * bool(row.reason)}{row.reason}"


@contextmanager
def _lines(*, silent: bool) -> Iterator[Callable[[str, str, int, bool], None]]:
    """Yield what shows a video on stderr: its name, line, how many are left, and whether it begins.

    A line where a video begins or ends, and every minute those that are running; at a terminal a line where one ends,
    and below these the others, and a bar.
    """
    if silent:
        yield lambda name, line, left, begins: None
    elif not sys.stderr.isatty():
        with _plain_lines() as show:
            yield show
    else:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}", markup=False),
        )
        with Progress(*columns, console=Console(stderr=True, markup=False)) as bar:
            task, running, done = bar.add_task("", total=None), list[str](), 0

            def show(name: str, line: str, left: int, begins: bool) -> None:
                nonlocal done
                running[:] = [other for other in running if other != name] + [name] * begins
                if not begins:
                    done += 1
                    bar.console.print(line)
                bar.update(task, description=", ".join(running), completed=done, total=done + left)

            yield show


@contextmanager
def _plain_lines() -> Iterator[Callable[[str, str, int, bool], None]]:
    """Yield what `_lines` does where there is no terminal: a log, a pipe."""
    began_s, ended = dict[str, float](), threading.Event()

    def show_plain(name: str, line: str, left: int, begins: bool) -> None:
        began_s.pop(name, None)
        if begins:
            began_s[name] = time.monotonic()
        typer.echo(f"{line} ({left} left)", err=True)

    def tell() -> None:
        while not ended.wait(_SECONDS_BETWEEN_LINES):
            since = [f"{name} for {_span(time.monotonic() - began)}" for name, began in list(began_s.items())]
            if since:
                more = f" and {len(since) - _MOST_NAMED} more" * (len(since) > _MOST_NAMED)
                typer.echo(f"running: {', '.join(since[:_MOST_NAMED])}{more}", err=True)

    teller = threading.Thread(target=tell, name="tell", daemon=True)
    teller.start()
    try:
        yield show_plain
    finally:
        ended.set()
        teller.join()


@contextmanager
def _ending_by_sigterm() -> Iterator[None]:
    """Let SIGTERM, by which clusters end a job, end the processes and write the table, as Ctrl-C does."""
    before = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
