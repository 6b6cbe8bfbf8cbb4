"""`scopemap bench speed`: the time of each stage of a run, and what is slower than in a file of measurements."""

from __future__ import annotations

from pathlib import Path

import typer

from scopemap.engine.config import Config, Preset
from scopemap.engine.errors import InputError
from scopemap.terminal.figures import print_json
from scopemap_bench import speed_records
from scopemap_bench.speed import Speed, timed_runs


def print_speed(video: str | None, frames: slice, preset: Preset, data: Path | None, as_json: bool) -> None:
    """Measure and print the stages of a run of a video below `data`, None: of the phantom."""
    with timed_runs(video, frames, Config.load(preset), data) as run:
        speed = run()
    if as_json:
        print_json(speed_records.as_json([speed]))
    else:
        _print_stages(speed)


def compare_speed(file: Path, data: Path | None, whole: bool, as_json: bool) -> None:
    """Measure again and print what a file holds; ends with code 1 where anything is slower than there.

    Raises `InputError` where no video of the file is in `data`.
    """
    kept = speed_records.read_speeds(file)
    here = [record for record in kept if speed_records.is_here(record, data)]
    for record in kept:
        if record not in here:
            place = "this folder (--data names another)" if data is None else str(data)
            typer.echo(f"not compared: {record.video} is not in {place}", err=True)
    if not here:
        raise InputError(f"comparing with {file}: none of its videos is here")
    measured, any_slower = [], False
    for record in here:
        now, slower = speed_records.measured_again(record, data, whole=whole)
        measured.append(now)
        any_slower |= bool(slower)
        if not as_json:
            _print_stages(now)
            typer.echo(f"before: {record.whole_ratio:.1f} DIS flows\n")
        for line in slower:
            typer.echo(f"slower: {now.clip}: {line}", err=True)
    if as_json:
        print_json(speed_records.as_json(measured))
    if any_slower:
        raise typer.Exit(1)
    if not as_json:
        names, what = ", ".join(speed.clip for speed in measured), "no whole process is" if whole else "no stage is"
        tolerance = speed_records.WHOLE_TOLERANCE if whole else speed_records.TOLERANCE
        typer.echo(f"{names}: {what} more than {tolerance:.0%} slower than in {file}")


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
