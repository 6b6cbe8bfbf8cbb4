"""`scopemap run`: camera poses, depth and a surface from a video."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scopemap.engine.notices import notices_of
from scopemap.terminal import options
from scopemap.terminal.figures import print_json, print_warnings
from scopemap.terminal.interruption import Interruption
from scopemap.terminal.progress import run_progress

if TYPE_CHECKING:
    from scopemap.engine.config import Config
    from scopemap.result.frame_table import FrameTable
    from scopemap.result.result import Result

_SKIPPED = {
    "repeated": "which repeat the one before (--set input.skip_duplicates=false)",
    "thinned": "by input.fps",
    "size": "of another size",
}
_MOST_LOSSES = 5


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
            help="Two views in one image, of which the left or upper is used; auto: recognised. use: measure depth "
            "from both, with --camera of the pair; use:left-right, use:top-bottom, use:FILE (of the right camera).",
        ),
    ] = None,
    deinterlace: Annotated[
        bool,
        options.advanced("--deinterlace", help="Use one field of interlaced images, its missing rows interpolated."),
    ] = False,
    redact: Annotated[
        list[str] | None,
        options.advanced(
            metavar="X,Y,W,H", help="Blacken a box of the input's pictures, px, before anything sees it; repeatable."
        ),
    ] = None,
    camera_at_rest: Annotated[
        bool,
        options.advanced(
            "--camera-at-rest", help="The camera does not move (robotic surgery): one surface per frame, surfaces/."
        ),
    ] = False,
    surface_at: Annotated[
        float | None,
        options.advanced(metavar="SECONDS", help="The surface as seen at that second, where tissue moves on its own."),
    ] = None,
    near_far: options.NearFar = None,
    depth: Annotated[
        str | None,
        typer.Option(
            help="scopenet, shading, depth-anything, depth-pro, files:FOLDER (disparity or depth files), stereo."
        ),
    ] = None,
    flow: Annotated[
        str | None,
        options.advanced(help="dis, raft-small, raft-large or none; RAFT needs the extra networks and its weights."),
    ] = None,
    colours: Annotated[
        Literal["albedo", "raw"] | None,
        options.advanced(help="Of the mesh: the tissue's, without the lamp's fall-off, or the video's own."),
    ] = None,
    mesh_faces: Annotated[
        int | None, options.advanced(min=4, metavar="N", help="Simplify the mesh to about so many faces.")
    ] = None,
    mesh_smooth: Annotated[
        int | None, options.advanced(min=0, metavar="N", help="Smooth the mesh, so many iterations of Taubin's filter.")
    ] = None,
    mesh_watertight: Annotated[
        bool, options.advanced("--mesh-watertight", help="Close the mesh where no frame saw anything, too; grey there.")
    ] = False,
    frames: options.Frames = None,
    fps: Annotated[
        float | None, options.advanced(help="Most frames per second that are used, by the time stamps.")
    ] = None,
    size: options.Size = None,
    memory: Annotated[
        str | None,
        options.advanced(
            metavar="SIZE", help="Limit of memory, such as 2GB; coarser voxels, where the surface needs more."
        ),
    ] = None,
    device: Annotated[Literal["auto", "cpu", "cuda"] | None, options.advanced(help="Device of the networks.")] = None,
    settings: options.SetPairs = None,
    overwrite: options.Overwrite = False,
    resume: Annotated[
        bool | None,
        typer.Option(
            "--resume/--no-resume",
            help="Resume a killed run from its checkpoint; default: where input, settings and versions agree.",
        ),
    ] = None,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Reconstruct camera poses, depth and a tissue surface from a video.

    Ctrl-C ends it early and writes what was tracked until then; a second Ctrl-C writes nothing.
    """
    from scopemap.engine.config import Config
    from scopemap.input.frame_choice import selection_text

    given = {
        "input.camera_fit": camera_fit,
        "input.stereo": stereo,
        "input.deinterlace": deinterlace or None,
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
        "fusion.surface_at_s": surface_at,
        "fusion.colours": colours,
        "fusion.mesh_faces": mesh_faces,
        "fusion.mesh_smooth": mesh_smooth,
        "fusion.holes": "watertight" if mesh_watertight else None,
    }
    chosen = {key: value for key, value in given.items() if value is not None} | options.parse_settings(settings or [])
    resolved = Config.load(preset, config, chosen)

    from scopemap.input.opening import open_sequence

    # The rest is loaded while the input is looked at, which loads nothing of it: imports in two threads can lock up.
    with ThreadPoolExecutor(1) as pool:
        pool.submit(import_module, "scopemap.runner.with_report")
        sequence = open_sequence(
            source,
            dataset=dataset,
            camera=camera,
            fov_deg=fov,
            size=options.parse_size(size) if size else None,
            settings=resolved.input,
        )
    from scopemap.runner.checkpoints import check_resumable, discard_unfinished
    from scopemap.runner.estimators import missing_weights
    from scopemap.runner.network_cost import network_cost
    from scopemap.runner.with_report import reconstruct_with_report

    if resume:
        check_resumable(out, sequence, resolved)
    elif resume is not None:
        discard_unfinished(out)
    if not (quiet or as_json or missing_weights(resolved)) and (cost := network_cost(resolved, sequence)):
        typer.echo(cost, err=True)
    shows = run_progress(sequence.used_count, silent=quiet or as_json, adjusts=resolved.mapping.at_end)
    with shows as shown, Interruption() as interruption:
        seen = (*shown.observers, interruption.observe)
        result = reconstruct_with_report(
            sequence, resolved, out, overwrite=overwrite, observers=seen, progress=shown.progress
        )
    _report(result, resolved, out, as_json=as_json, quiet=quiet)
    # After the last frame there is nothing to cut short: the result is whole.
    if interruption.exit_code and result.provenance["interrupted_at_frame"] is not None:
        raise typer.Exit(interruption.exit_code)


def _report(result: Result, config: Config, out: Path, *, as_json: bool, quiet: bool) -> None:
    provenance = result.provenance
    if not quiet:
        print_warnings(provenance)
    if as_json:
        print_json(provenance | {"out": str(out), "preset": config.preset, "mesh_faces": len(result.mesh.faces)})
    elif not quiet:
        for line in summary_lines(result):
            typer.echo(line)
        submaps = ", maps/" if result.others else ""
        typer.echo(f"look at {out / 'report.html'} in a browser, or at summary.png beside it")
        typer.echo(f"result in {out}: trajectory.tum, mesh.ply, mesh.glb, depth/, depth_preview/, frames.csv{submaps}")


def summary_lines(result: Result) -> list[str]:
    """Return the summary of a run, one fact per line."""
    from scopemap.engine.notices import scale_words
    from scopemap.result.input_part import part_of_input
    from scopemap.result.losses import losses

    facts, known = result.provenance, result.provenance["scale"]["known"]
    counts = [f"{facts['tracked']} of {facts['frames']} frames tracked"]
    counts += [f"{facts[key]} {key.replace('_', ' ')}" for key in ("lost", "in_other_maps") if facts[key]]
    unit = " mm" if known else " (scale unknown)"
    lines = [
        f"{', '.join(counts)}, path {result.trajectory.path_length_mm:.1f}{unit}",
        scale_words(facts["scale"]) + ("" if known else "; every mm below is in this scale"),
        f"camera: {facts['camera']['source']}",
        f"size: {facts['camera']['size']}",
        f"depth: {facts['estimators']['depth']}",
        f"flow: {facts['estimators']['flow']}; perceptual distance: {facts['estimators']['perceptual']}",
        f"mesh: {len(result.mesh.vertices)} vertices, {len(result.mesh.faces)} faces{_surface(facts['surface'])}",
        time_words(result) + compiling_words(facts["seconds"].get("compile kernels", 0.0)),
    ]
    lines += [f"input: {part}; shares are of these" for part in [part_of_input(facts)] if part]
    lines += [f"skipped: {count} frames, {_SKIPPED[kind]}; see frames.csv" for kind, count in facts["skipped"].items()]
    if result.others:
        lines += _map_lines(result.frames)
    lost = losses(result.frames)
    longest = sorted(sorted(lost, key=lambda loss: -loss.frames)[:_MOST_LOSSES], key=lambda loss: loss.first)
    lines += [f"lost: {loss.when} ({loss.size}), {loss.cause}: {loss.advice}" for loss in longest]
    if len(lost) > _MOST_LOSSES:
        lines.append(f"lost: {len(lost) - _MOST_LOSSES} shorter segments, see frames.csv")
    return lines + [f"note: {notice}" for notice in notices_of(facts) if notice.level == "info"]


def _map_lines(frames: FrameTable) -> list[str]:
    from scopemap.result.submap_summaries import doubt_words, submaps_in_time

    submaps, maps = submaps_in_time(frames), []
    for submap in submaps:
        facts = ", ".join(filter(None, (f"{submap.first} to {submap.last}", submap.inliers)))
        maps.append(f"{submap.name} with {submap.frames} frames ({facts})")
    doubt = doubt_words(submaps)
    return [f"maps in order of time: {', '.join(maps)}"] + [f"most doubtful map: {doubt}"] * bool(doubt)


def time_words(result: Result) -> str:
    """Return how long the run took and its frames per second; of a resumed one since then."""
    from scopemap.result.verdict import frames_per_s

    seconds, after = result.provenance["seconds"]["total"], result.provenance["resumed_after_frame"]
    since = "" if after is None else f" since it was resumed after frame {after}"
    return f"time: {seconds:.1f} s{since}, {frames_per_s(result) or 0.0:.1f} frames/s"


def compiling_words(seconds: float) -> str:
    """Return what compiling the kernels took, and that it was for this process alone where they cannot be cached."""
    if seconds < 0.1:
        return ""
    is_cached = os.environ.get("NUMBA_CACHE_DIR") != ""
    kept = "once" if is_cached else "every time: set NUMBA_CACHE_DIR to a folder to keep them"
    return f"; {seconds:.1f} s of it, which the frames/s leave out, to compile kernels, {kept}"


def _surface(figures: dict[str, float]) -> str:
    """Return how well the surface agrees with the frames that it was made of, "" where that is not known."""
    if "depth_error" not in figures:
        return ""
    mean, least = int(100 * figures["coverage_mean"]), int(100 * figures["coverage_least"])
    seen = f"; covers {mean}% of what the frames see (least {least}%)"
    return f"{seen}, depth {figures['depth_error']:.1%} off theirs"
