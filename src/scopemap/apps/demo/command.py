"""`scopemap demo`: reconstruct the packaged clip, and compare the result with the truth."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from scopemap.terminal.figures import print_json
from scopemap.terminal.options import AsJson, Overwrite, Quiet, SetPairs, parse_settings
from scopemap.terminal.progress import run_progress


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for clip, run and pictures.")] = Path(
        "scopemap-demo"
    ),
    settings: SetPairs = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct a packaged clip and compare it with its truth.

    The clip shows a phantom colon. Nothing is downloaded.
    """
    silent = quiet or as_json
    if not silent:
        typer.echo("reconstructing a packaged clip; the first time kernels are compiled, too", err=True)
    # Imported here, so that --help does not wait for the kernels.
    from scopemap.apps.demo import demo as demonstration
    from scopemap.engine.config import Config

    started = time.perf_counter()
    config = Config.load("default", settings=parse_settings(settings or []))
    demonstration.prepare_out(out, overwrite=overwrite)
    with run_progress(demonstration.FRAMES, silent=silent) as shown:
        done = demonstration.run_clip(out, config, shown.observers, shown.progress)
    figures = demonstration.measure(done)
    pictures = demonstration.draw(done, out / "pictures")
    seconds = time.perf_counter() - started
    if as_json:
        paths = {"clip": str(done.clip), "run": str(out / "run"), "pictures": [str(file) for file in pictures]}
        print_json(figures | paths | {"seconds": round(seconds, 1)})
    elif not quiet:
        for line in _lines(figures, out, seconds):
            typer.echo(line)


def _lines(figures: dict[str, float], out: Path, seconds: float) -> list[str]:
    run, clip, pictures = out / "run", out / "clip", out / "pictures"
    lines = (
        f"{{tracked}} of {{frames}} frames tracked over a true path of {{path_mm:.1f}} mm, in {seconds:.0f} s",
        "position error (ATE RMSE): {ate_sim3_mm:.2f} mm after Sim(3) with scale {scale:.3f}, "
        "{ate_origin_mm:.2f} mm with only the first poses aligned",
        "rotation error since frame 1, unaligned: mean {rotation_mean_deg:.2f} deg, largest {rotation_max_deg:.2f} deg",
    )
    return [line.format(**figures) for line in lines] + [
        f"video: {clip / 'colon.mp4'}; its camera: {clip / 'camera.yaml'}; its true poses: {clip / 'pose.txt'}",
        f"mesh: {run / 'mesh.ply'} and mesh.glb; trajectory: {run / 'trajectory.tum'}",
        f"report: {run / 'report.html'}, to be looked at in a browser; summary.png beside it shows the surface",
        f"pictures: {pictures / 'trajectory.png'} (estimate green, truth red), depth.png",
    ]
