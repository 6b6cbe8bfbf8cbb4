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
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="new or empty folder, or one of an earlier phantom")],
    scene: Annotated[str, typer.Option(help="colon | laparoscopy | abdominal_wall | tube")] = "colon",
    frames: Annotated[int | None, typer.Option(help="number of frames; default 200, or all of --path")] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="image size, px")] = "320x256",
    seed: Annotated[int, typer.Option(help="of everything random")] = 0,
    path: Annotated[
        Path | None, typer.Option(metavar="FILE", help="camera path to follow, 16 numbers per line")
    ] = None,
    deform: Annotated[bool, typer.Option("--deform", help="let the tissue breathe")] = False,
    loop: Annotated[bool, typer.Option("--loop", help="end in exactly the first pose")] = False,
    events: Annotated[
        str,
        typer.Option(
            help="KIND:A-B,... (frames, inclusive): black, blur, smoke, veil, fluid, instrument, turn, contact, "
            "push, rebound, poke, peristalsis, grasp, cut"
        ),
    ] = "",
    polyps: Annotated[
        str, typer.Option(help="KIND:MM@FRAME,... where that frame sees the wall: sessile, pedunculated, flat")
    ] = "",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="route, fov_deg, noise, texture, shutter, ..."),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Render synthetic endoscopy with true poses, depth and mesh, in the C3VD layout."""
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
    ).with_settings(parse_settings(settings or []))
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
