"""`scopemap run`: camera poses, depth and a surface from a video."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from scopemap.cli.figures import print_json, print_warnings
from scopemap.cli.interruption import Interruption
from scopemap.cli.options import (
    AsJson,
    CameraFile,
    Dataset,
    Frames,
    Quiet,
    SetPairs,
    parse_box,
    parse_memory,
    parse_near_far,
    parse_settings,
    parse_size,
)
from scopemap.cli.progress import run_progress
from scopemap.notices import notices_of

if TYPE_CHECKING:
    from scopemap.config import Config
    from scopemap.reconstruction import Reconstruction
    from scopemap.report.submap_summaries import SubmapSummary


_SKIPPED = {"repeated": "which repeat the one before (--set input.skip_duplicates=false)", "thinned": "by input.fps"}
_MOST_LOSSES = 5


def run(
    source: Annotated[
        Path,
        typer.Argument(metavar="INPUT", help="A video file, a folder of images, the folder of a data set's sequence."),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the result.")],
    preset: Annotated[
        Literal["default", "paper", "paper-strict", "realtime"] | None,
        typer.Option(
            help="default: best of what needs no download; paper: the method as published, made robust; paper-strict: "
            "without what it does beyond the text; realtime: fast."
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings as TOML; a run's config.toml repeats it.")
    ] = None,
    dataset: Dataset = None,
    camera: CameraFile = None,
    camera_fit: Annotated[
        str | None,
        typer.Option(
            metavar="FIT",
            help="What a calibration of another size means: exact (refused), scale (images were resized), crop:X,Y.",
        ),
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(
            min=5.0,
            max=170.0,
            help="Horizontal field of view, degrees, of an unknown camera; default: estimated from the motion, or 70.",
        ),
    ] = None,
    stereo: Annotated[
        Literal["auto", "none", "left-right", "top-bottom"] | None,
        typer.Option(help="Two views in one image, of which the left or upper is used; auto: recognised."),
    ] = None,
    deinterlace: Annotated[
        bool,
        typer.Option("--deinterlace", help="Use one field of interlaced images, its missing rows interpolated."),
    ] = False,
    redact: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,W,H", help="Blacken a box of the input's pictures, px, before anything sees it; repeatable."
        ),
    ] = None,
    camera_at_rest: Annotated[
        bool,
        typer.Option(
            "--camera-at-rest", help="The camera does not move (robotic surgery): one surface per frame, surfaces/."
        ),
    ] = False,
    surface_at: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="The surface as seen at that second, where tissue moves on its own."),
    ] = None,
    near_far: Annotated[
        str | None,
        typer.Option(
            metavar="NEAR:FAR", help="Nearest and farthest tissue in the first frame, mm; replaces a preset's anchor."
        ),
    ] = None,
    depth: Annotated[
        str | None,
        typer.Option(help="scopenet, shading, depth-anything, depth-pro or files:FOLDER (disparity or depth files)."),
    ] = None,
    flow: Annotated[
        str | None,
        typer.Option(help="dis, raft-small, raft-large or none; RAFT needs the extra networks and its weights."),
    ] = None,
    colours: Annotated[
        Literal["albedo", "raw"] | None,
        typer.Option(help="Of the mesh: the tissue's, without the lamp's fall-off, or the video's own."),
    ] = None,
    mesh_faces: Annotated[
        int | None, typer.Option(min=4, metavar="N", help="Simplify the mesh to about so many faces.")
    ] = None,
    mesh_smooth: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Smooth the mesh, so many iterations of Taubin's filter.")
    ] = None,
    mesh_watertight: Annotated[
        bool, typer.Option("--mesh-watertight", help="Close the mesh where no frame saw anything, too; grey there.")
    ] = False,
    frames: Frames = None,
    fps: Annotated[float | None, typer.Option(help="Most frames per second that are used, by the time stamps.")] = None,
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Working size, px; default: the input's over a whole number, at most 400 px."),
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE", help="Limit of memory, such as 2GB; coarser voxels, where the surface needs more."
        ),
    ] = None,
    device: Annotated[Literal["auto", "cpu", "cuda"] | None, typer.Option(help="Device of the networks.")] = None,
    settings: SetPairs = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier run in the folder.")] = False,
    resume: Annotated[
        bool | None,
        typer.Option(
            "--resume/--no-resume",
            help="Resume a killed run from its checkpoint; default: where input, settings and versions agree.",
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct camera poses, depth and a tissue surface from a video.

    Ctrl-C ends it early and writes what was tracked until then; a second Ctrl-C writes nothing.
    """
    from scopemap.config import Config

    given = {
        "input.camera_fit": camera_fit,
        "input.stereo": stereo,
        "input.deinterlace": deinterlace or None,
        "input.redact": [parse_box(box) for box in redact] if redact else None,
        "input.fps": fps,
        "run.memory_mb": parse_memory(memory) if memory else None,
        "depth.backend": depth,
        "depth.near_far_mm": parse_near_far(near_far) if near_far else None,
        "tracking.camera_at_rest": camera_at_rest or None,
        "networks.flow": flow,
        "networks.device": device,
        "fusion.surface_at_s": surface_at,
        "fusion.colours": colours,
        "fusion.mesh_faces": mesh_faces,
        "fusion.mesh_smooth": mesh_smooth,
        "fusion.holes": "watertight" if mesh_watertight else None,
    }
    chosen = {key: value for key, value in given.items() if value is not None} | parse_settings(settings or [])
    resolved = Config.load(preset, config, chosen)

    from scopemap.io.opening import open_sequence
    from scopemap.runner.checkpoints import check_resumable, discard_unfinished
    from scopemap.runner.with_report import reconstruct_with_report

    sequence = open_sequence(
        source,
        dataset=dataset,
        camera=camera,
        fov_deg=fov,
        size=parse_size(size) if size else None,
        frames=frames,
        settings=resolved.input,
    )
    if resume:
        check_resumable(out, sequence, resolved)
    elif resume is not None:
        discard_unfinished(out)
    with run_progress(sequence.count, silent=quiet or as_json) as shown, Interruption() as interruption:
        seen = (*shown.observers, interruption.observe)
        result = reconstruct_with_report(
            sequence, resolved, out, overwrite=overwrite, observers=seen, progress=shown.progress
        )
    _report(result, resolved, out, as_json=as_json, quiet=quiet)
    # After the last frame there is nothing to cut short: the result is whole.
    if interruption.exit_code and result.provenance["interrupted_at_frame"] is not None:
        raise typer.Exit(interruption.exit_code)


def _report(result: Reconstruction, config: Config, out: Path, *, as_json: bool, quiet: bool) -> None:
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


def summary_lines(result: Reconstruction) -> list[str]:
    """Return the summary of a run, one fact per line."""
    from scopemap.notices import scale_words
    from scopemap.report.losses import losses
    from scopemap.report.submap_summaries import doubt_words, submaps_in_time

    facts, known = result.provenance, result.provenance["scale"]["known"]
    unit = " mm" if known else " (scale unknown)"
    lines = [
        f"{_counted(facts)}, path {result.trajectory.path_length_mm:.1f}{unit}",
        scale_words(facts["scale"]) + ("" if known else "; every mm below is in this scale"),
        f"camera: {facts['camera']['source']}",
        f"size: {facts['camera']['size']}",
        f"depth: {facts['estimators']['depth']}",
        f"flow: {facts['estimators']['flow']}; perceptual distance: {facts['estimators']['perceptual']}",
        f"mesh: {len(result.mesh.vertices)} vertices, {len(result.mesh.faces)} faces{_surface(facts['surface'])}",
        _time_words(result) + compiling_words(facts["seconds"].get("compile kernels", 0.0)),
    ]
    lines += [f"skipped: {count} frames, {_SKIPPED[kind]}; see frames.csv" for kind, count in facts["skipped"].items()]
    if result.others:
        submaps = submaps_in_time(result.frames)
        lines.append(f"maps in order of time: {', '.join(_map_words(submap) for submap in submaps)}")
        lines += [f"most doubtful map: {doubt}" for doubt in [doubt_words(submaps)] if doubt]
    lost = losses(result.frames)
    longest = sorted(sorted(lost, key=lambda loss: -loss.frames)[:_MOST_LOSSES], key=lambda loss: loss.first)
    lines += [f"lost: {loss.when} ({loss.size}), {loss.cause}: {loss.advice}" for loss in longest]
    if len(lost) > _MOST_LOSSES:
        lines.append(f"lost: {len(lost) - _MOST_LOSSES} shorter segments, see frames.csv")
    return lines + [f"note: {notice}" for notice in notices_of(facts) if notice.level == "info"]


def _time_words(result: Reconstruction) -> str:
    """Return how long the run took and its frames per second; of a resumed one since then."""
    seconds, after = result.provenance["seconds"]["total"], result.provenance["resumed_after_frame"]
    done = len(result.frames) if after is None else int((result.frames["index"] > after).sum())
    since = "" if after is None else f" since it was resumed after frame {after}"
    return f"time: {seconds:.1f} s{since}, {done / seconds:.1f} frames/s"


def compiling_words(seconds: float) -> str:
    """Return what compiling the kernels took, and that it was for this process alone where they cannot be cached."""
    if seconds < 0.1:
        return ""
    kept = (
        "once"
        if os.environ.get("NUMBA_CACHE_DIR") != ""
        else "every time: set NUMBA_CACHE_DIR to a folder to keep them"
    )
    return f"; {seconds:.1f} s of it to compile kernels, {kept}"


def _counted(facts: dict[str, Any]) -> str:
    """Return how many frames are tracked in the result, lost, and in other maps."""
    others = (("lost", "lost"), ("in_other_maps", "in other maps"))
    parts = [f"{facts['tracked']} of {facts['frames']} frames tracked"]
    return ", ".join(parts + [f"{facts[key]} {words}" for key, words in others if facts[key]])


def _map_words(submap: SubmapSummary) -> str:
    facts = ", ".join(filter(None, (f"{submap.first} to {submap.last}", submap.inliers)))
    return f"{submap.name} with {submap.frames} frames ({facts})"


def _surface(figures: dict[str, float]) -> str:
    """Return how well the surface agrees with the frames that it was made of, "" where that is not known."""
    if "depth_error" not in figures:
        return ""
    return (
        f"; covers {int(100 * figures['coverage_mean'])}% of what the frames see "
        f"(least {int(100 * figures['coverage_least'])}%), "
        f"depth {figures['depth_error']:.1%} off theirs"
    )
