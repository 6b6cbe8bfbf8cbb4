"""`scopemap run`: camera poses, depth and a surface from a video."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import asdict
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from scopemap.engine.flow.flows import flows_in_words
from scopemap.runner.depth_networks import networks_in_words
from scopemap.terminal import options
from scopemap.terminal.figures import print_json, print_warnings
from scopemap.terminal.interruption import Interruption
from scopemap.terminal.progress import ProgressDisplay, both, run_progress

if TYPE_CHECKING:
    from scopemap.engine.config import Config
    from scopemap.input.sequence import Sequence
    from scopemap.result.result import Result
    from scopemap.runner.forecast import RunCost


def run(
    source: options.Input,
    out: Annotated[Path, typer.Option(help="Folder for the result.")],
    preset: options.PresetName = None,
    config: options.ConfigFile = None,
    dataset: options.Dataset = None,
    camera: options.CameraFile = None,
    camera_fit: options.CameraFit = None,
    fov: options.FieldOfView = None,
    scope: options.Scope = None,
    stereo: Annotated[
        str | None,
        options.advanced(
            metavar="auto|none|left-right|top-bottom|use[:...]",
            help="Two views in one image; auto (default): detect, use one; use: measure depth from both "
            "(docs/own-video.md).",
        ),
    ] = None,
    deinterlace: Annotated[
        bool | None,
        options.advanced(
            "--deinterlace/--no-deinterlace",
            help="Use one field of each image and interpolate the missing rows; default: if the video is interlaced.",
        ),
    ] = None,
    redact: Annotated[
        list[str] | None,
        typer.Option(
            rich_help_panel="Privacy",
            metavar="X,Y,W,H",
            help="Blacken a box of every input image before processing, px; may be repeated.",
        ),
    ] = None,
    camera_at_rest: Annotated[
        bool,
        options.advanced(
            "--camera-at-rest", help="State that the camera does not move: write one surface per frame to surfaces/."
        ),
    ] = False,
    near_far: options.NearFar = None,
    depth: Annotated[
        str | None,
        typer.Option(help=f"Depth: {networks_in_words()}, stereo, or files:FOLDER."),
    ] = None,
    flow: Annotated[
        str | None,
        options.advanced(help=f"Optical flow: {flows_in_words()}."),
    ] = None,
    colours: Annotated[
        Literal["texture", "albedo", "raw"] | None,
        options.advanced(
            help="Colours: pieces of the frames in mesh.glb (texture, default), or one per vertex (albedo, raw)."
        ),
    ] = None,
    mesh_faces: Annotated[
        int | None, options.advanced(min=4, metavar="N", help="Simplify the mesh to about N triangles; default: off.")
    ] = None,
    mesh_smooth: Annotated[
        int | None,
        options.advanced(
            min=0, metavar="N", help="Smooth the mesh with N iterations of Taubin's filter; default: off."
        ),
    ] = None,
    mesh_watertight: Annotated[
        bool,
        options.advanced(
            "--mesh-watertight", help="Close the mesh also where no frame saw tissue; such parts are grey."
        ),
    ] = False,
    frames: options.Frames = None,
    fps: Annotated[
        float | None, options.advanced(help="Use at most this many frames per second; default: all.")
    ] = None,
    size: options.Size = None,
    memory: Annotated[
        str | None,
        options.advanced(
            metavar="SIZE", help="Limit memory, such as 2GB; voxels become coarser if needed; default: no limit."
        ),
    ] = None,
    device: Annotated[
        Literal["auto", "cpu", "cuda"] | None, options.advanced(help="Device that runs networks; default: auto.")
    ] = None,
    settings: options.SetPairs = None,
    overwrite: options.Overwrite = False,
    resume: Annotated[
        bool | None,
        typer.Option(
            "--resume/--no-resume",
            help="Resume a killed run; default: if input, settings and versions are the same.",
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        options.advanced("--dry-run", help="Run one second of the video and print the expected time and space of all."),
    ] = False,
    finish: Annotated[
        bool,
        options.advanced("--finish", help="Read no more frames: write the result of what a stopped run has tracked."),
    ] = False,
    in_app: Annotated[
        bool, typer.Option("--app", help="Show the run in a browser while it goes on, and its result (extra app).")
    ] = False,
    watched: Annotated[
        bool, typer.Option("--watched", hidden=True, help="Write what can be seen of the run for a window.")
    ] = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Reconstruct camera poses, depth and a surface from a video.

    Ctrl-C stops the run and writes what was tracked so far; a second Ctrl-C writes nothing.
    """
    from scopemap.engine.config import Config
    from scopemap.input.frame_choice import selection_text

    given = {
        "input.camera_fit": camera_fit,
        "input.stereo": stereo,
        "input.deinterlace": deinterlace,
        "input.redact": [options.parse_box(box) for box in redact] if redact else None,
        "input.frames": None if frames is None else selection_text(frames),
        "input.fps": fps,
        "input.scope": scope,
        "run.memory_mb": options.parse_memory(memory) if memory else None,
        "depth.backend": depth,
        "depth.near_far_mm": options.parse_near_far(near_far) if near_far else None,
        "tracking.camera_at_rest": camera_at_rest or None,
        "networks.flow": flow,
        "networks.device": device,
        "fusion.colours": colours,
        "fusion.mesh_faces": mesh_faces,
        "fusion.mesh_smooth": mesh_smooth,
        "fusion.holes": "watertight" if mesh_watertight else None,
    }
    chosen = {key: value for key, value in given.items() if value is not None} | options.parse_settings(settings or [])
    resolved = Config.load(preset, config, chosen)

    known = {"dataset": dataset, "camera": camera, "fov_deg": fov, "size": options.parse_size(size) if size else None}
    sequence = _opened(source, resolved, known)
    if dry_run:
        cost = _cost(sequence, partial(_opened, source, resolved, known), resolved, out)
        _print_cost(cost, as_json=as_json, quiet=quiet)
        return
    from scopemap.runner.estimators import missing_weights
    from scopemap.runner.network_cost import network_cost
    from scopemap.runner.observers import RunStopped
    from scopemap.runner.with_report import reconstruct_with_report

    _check_unfinished(out, sequence, resolved, finish=finish, resume=resume)
    if not (quiet or as_json or missing_weights(resolved)) and (words := network_cost(resolved, sequence)):
        typer.echo(words, err=True)
    looked: Literal["", "app", "window"] = "window" if watched else "app" if in_app else ""
    count, adjusts = sequence.used_count, resolved.mapping.global_adjustment
    with _window(out) if in_app else nullcontext():
        with _shown(out, count, adjusts, quiet or as_json, looked) as (shown, interruption):
            observers = (*shown.observers, lambda step: finish)
            try:
                result = reconstruct_with_report(
                    sequence, resolved, out, overwrite=overwrite, observers=observers, progress=shown.progress
                )
            except RunStopped:
                raise typer.Exit(interruption.exit_code) from None
        _report(result, resolved, out, as_json=as_json, quiet=quiet)
    # After the last frame there is nothing to cut short: the result is whole.
    if interruption.exit_code and result.provenance["interrupted_at_frame"] is not None:
        raise typer.Exit(interruption.exit_code)


def _window(out: Path) -> AbstractContextManager[None]:
    """Return the context of a window that shows the run, whose button to stop is Ctrl-C."""
    from scopemap.result.run_view import view_folder
    from scopemap.terminal.window_beside import window_beside

    stop = {"stop": partial(os.kill, os.getpid(), signal.SIGINT)}
    return window_beside(out, view_folder(out), stop, say=partial(typer.echo, err=True))


@contextmanager
def _shown(
    out: Path, frames: int | None, adjusts: bool, silent: bool, looked: Literal["", "app", "window"]
) -> Iterator[tuple[ProgressDisplay, Interruption]]:
    """Yield what a run tells how far it is, in the terminal and for what `looked` names; and what ends it early.

    looked : "app": a window beside this command. "window": one that has started it, and goes on with what it keeps.
    """
    with ExitStack() as stack:
        shown = stack.enter_context(run_progress(frames, silent=silent, adjusts=adjusts))
        interruption = stack.enter_context(Interruption(keeps=looked == "window"))
        observers, progress = (*shown.observers, interruption.observe), shown.progress
        if looked:
            from scopemap.runner.watched import RunWatch

            watch = stack.enter_context(RunWatch(out, frames, adjusts=adjusts))
            observers, progress = (watch, *observers), both(progress, watch.progress)
        yield ProgressDisplay(observers, progress), interruption


def _check_unfinished(out: Path, sequence: Sequence, resolved: Config, *, finish: bool, resume: bool | None) -> None:
    """Refuse what a run left in `out`, or take it away, as --finish and --resume ask for it."""
    from scopemap.runner.checkpoints import check_finishable, check_resumable, discard_unfinished

    if finish:
        check_finishable(out, sequence, resolved)
    elif resume:
        check_resumable(out, sequence, resolved)
    elif resume is not None:
        discard_unfinished(out)


def _cost(whole: Sequence, part: Callable[[slice], Sequence], resolved: Config, out: Path) -> RunCost | None:
    """Return what a run costs, by its first second; what that writes beside `out` is removed."""
    from scopemap.runner.forecast import run_cost

    place = next(folder for folder in out.absolute().parents if folder.exists())
    with TemporaryDirectory(prefix=".dry-run-", dir=place) as folder:
        return run_cost(whole, part, resolved, Path(folder) / "result")


def _print_cost(cost: RunCost | None, *, as_json: bool, quiet: bool) -> None:
    """Print what a run costs; None: its number of frames is not known."""
    if as_json:
        print_json({} if cost is None else asdict(cost) | {"seconds": cost.seconds})
    elif cost is None:
        typer.echo("not known: the number of frames is not")
    elif not quiet:
        typer.echo(f"{cost.frames} frames, about {cost.seconds:.0f} s, {cost.result_bytes / 1e9:.2f} GB")


def _opened(source: Path, resolved: Config, known: dict[str, Any], frames: slice | None = None) -> Sequence:
    """Return the frames of an input by what is `known` of it; what a run needs is loaded meanwhile.

    frames : instead of those that the settings choose.
    """
    with _loading(), ThreadPoolExecutor(1) as pool:
        from scopemap.input.opening import open_sequence

        # To open an input loads nothing of it: imports in two threads can lock up.
        pool.submit(import_module, "scopemap.runner.with_report")
        return open_sequence(source, settings=resolved.input, frames=frames, **known)


def _report(result: Result, resolved: Config, out: Path, *, as_json: bool, quiet: bool) -> None:
    from scopemap.result.summary import summary_lines

    provenance = result.provenance
    if as_json:
        if not quiet:
            print_warnings(provenance)
        print_json(provenance | {"out": str(out), "preset": resolved.preset, "mesh_faces": len(result.mesh.faces)})
    elif not quiet:
        for line in summary_lines(result):
            typer.echo(line)
        typer.echo(f"Open {out / 'report.html'} in a browser. All files of the result are in {out}.")


@contextmanager
def _loading() -> Iterator[None]:
    """Load libraries without the garbage collector, which also later does not look through what was loaded.

    Python would look through all modules again and again: a fifth of the time of their import, and 0.1 s each time
    that a run trims its memory.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
