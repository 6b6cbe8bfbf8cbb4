"""`scopemap phantom`: render synthetic endoscopy with exact truth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from scopemap.terminal.figures import print_json
from scopemap.terminal.options import AsJson, Quiet, parse_settings, parse_size
from scopemap.terminal.progress import count_progress


def phantom(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="New or empty folder, or folder of an earlier phantom.")
    ],
    scene: Annotated[str, typer.Option(help="Scene: colon, laparoscopy, abdominal_wall, or tube.")] = "colon",
    frames: Annotated[int | None, typer.Option(help="Number of frames; default: 200, or all of --path.")] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="Image size, px.")] = "320x256",
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    path: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Camera path to follow: one 4x4 pose per line, as 16 numbers.")
    ] = None,
    deform: Annotated[bool, typer.Option("--deform", help="Let the tissue breathe.")] = False,
    loop: Annotated[bool, typer.Option("--loop", help="End in exactly the first pose.")] = False,
    events: Annotated[
        str,
        typer.Option(
            metavar="KIND:A-B,...",
            help="Events: black, blur, smoke, veil, fluid, instrument, turn, contact, push, rebound, poke, "
            "peristalsis, grasp, cut.",
        ),
    ] = "",
    polyps: Annotated[
        str,
        typer.Option(
            metavar="KIND:MM@FRAME,...",
            help="Polyps on the wall that this frame sees: sessile, pedunculated, flat; size in mm.",
        ),
    ] = "",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Set a property of the phantom, such as noise=2 or fov_deg=90; may be repeated.",
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Render synthetic endoscopy with exact truth (C3VD layout)."""
    # Imported here, so that --help does not wait for the kernels.
    from scopemap_bench.phantom.spec import PhantomSpec, parse_events, parse_polyps
    from scopemap_bench.phantom.writer import write_phantom

    width, height = parse_size(size)
    spec = PhantomSpec(
        scene=scene,  # type: ignore[arg-type]
        frames=frames,
        width=width,
        height=height,
        seed=seed,
        path_file=path,
        deform=deform,
        loop=loop,
        events=parse_events(events),
        polyps=parse_polyps(polyps),
    ).with_settings(parse_settings(settings or [], of_runs=False))
    with count_progress("rendering", "rendered", silent=quiet or as_json) as progress:
        write_phantom(spec, folder, progress)
    description = json.loads((folder / "phantom.json").read_text(encoding="utf-8"))
    if as_json:
        print_json({"folder": str(folder)} | description)
    elif not quiet:
        spec = description["spec"]
        typer.echo(
            f"{description['frames']} frames of {spec['scene']} ({spec['width']}x{spec['height']}) in {folder}: "
            "colour, depth, pose.txt, camera.yaml, mesh_truth.ply"
        )
