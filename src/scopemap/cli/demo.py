"""`scopemap demo`: render a phantom, reconstruct it, and measure the result against the truth."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from scopemap.cli.figures import print_json
from scopemap.cli.options import AsJson, Quiet, SetPairs, parse_settings
from scopemap.cli.progress import count_progress, run_progress


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for phantom, run and pictures.")] = Path(
        "scopemap-demo"
    ),
    settings: SetPairs = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier demo's run; its phantom is used again.")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Render a phantom colon, reconstruct it, and compare with the truth; nothing is downloaded."""
    silent = quiet or as_json
    _tell("preparing a phantom colon; the first time kernels are compiled, too", silent)
    # Imported here, so that --help does not wait for the kernels.
    from scopemap.actions import demo as demonstration
    from scopemap.config import Config

    started = time.perf_counter()
    config = Config.load("default", settings=parse_settings(settings or []))
    demonstration.prepare_out(out, overwrite=overwrite)
    with count_progress("rendering", "rendered", silent=silent) as progress:
        rendered = demonstration.render(out, demonstration.PHANTOM, progress)
    _tell(f"{'rendered' if rendered else 'using the earlier'} phantom in {out / 'phantom'}; reconstructing it", silent)
    with run_progress(demonstration.PHANTOM.frames, silent=silent) as shown:
        done = demonstration.run_on_phantom(out, config, shown.observers, shown.progress)
    _tell("measuring against the truth", silent)
    figures = demonstration.measure(done)
    pictures = demonstration.draw(done, out / "pictures")
    seconds = time.perf_counter() - started
    if as_json:
        paths = {"phantom": str(out / "phantom"), "run": str(out / "run"), "pictures": [str(file) for file in pictures]}
        print_json(figures | paths | {"seconds": round(seconds, 1)})
    elif not quiet:
        for line in _lines(figures, out, seconds):
            typer.echo(line)


def _tell(text: str, silent: bool) -> None:
    if not silent:
        typer.echo(text, err=True)


def _lines(figures: dict[str, float], out: Path, seconds: float) -> list[str]:
    run, pictures = out / "run", out / "pictures"
    lines = (
        f"{{tracked}} of {{frames}} frames tracked over a true path of {{path_mm:.1f}} mm, in {seconds:.0f} s",
        "position error (ATE RMSE): {ate_sim3_mm:.2f} mm after Sim(3) with scale {scale:.3f}, "
        "{ate_origin_mm:.2f} mm with only the first poses aligned",
        "rotation error since frame 1, unaligned: mean {rotation_mean_deg:.2f} deg, largest {rotation_max_deg:.2f} deg",
        "mesh to true surface, after Sim(3): mean {mesh_accuracy_mm:.2f} mm, half within {mesh_median_mm:.2f} mm; "
        "true surface to mesh: mean {mesh_completeness_mm:.2f} mm",
        "depth, each frame scaled by its median: AbsRel {depth_abs_rel:.3f}, before MAPIS {raw_depth_abs_rel:.3f}",
    )
    return [line.format(**figures) for line in lines] + [
        f"mesh: {run / 'mesh.ply'} and mesh.glb; truth: {out / 'phantom' / 'mesh_truth.ply'}",
        f"trajectory: {run / 'trajectory.tum'}; truth: {out / 'phantom' / 'pose.txt'}",
        f"report: {run / 'report.html'}, to be looked at in a browser",
        f"pictures: {pictures / 'trajectory.png'} (estimate green, truth red), mesh.png, depth.png",
    ]
