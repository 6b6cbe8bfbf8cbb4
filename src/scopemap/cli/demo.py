"""`scopemap demo`: render a phantom, reconstruct it, and measure the result against the truth."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scopemap.cli.options import AsJson, Quiet, SetPairs, parse_settings
from scopemap.cli.progress import count_progress, run_progress

if TYPE_CHECKING:
    from scopemap.benchmark.demonstration import DemoFigures


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
    from scopemap.benchmark import demonstration

    started = time.perf_counter()
    config = demonstration.demo_config(parse_settings(settings or []))
    demonstration.prepare_out(out, overwrite=overwrite)
    with count_progress("rendering", "rendered", silent=silent) as progress:
        rendered = demonstration.render(out, demonstration.PHANTOM, progress)
    _tell(f"{'rendered' if rendered else 'using the earlier'} phantom in {out / 'phantom'}; reconstructing it", silent)
    with run_progress(demonstration.PHANTOM.frames, silent=silent) as observers:
        done = demonstration.run_on_phantom(out, config, observers)
    _tell("measuring against the truth", silent)
    figures = demonstration.measure(done)
    pictures = demonstration.draw(done, out / "pictures")
    seconds = time.perf_counter() - started
    if as_json:
        typer.echo(json.dumps(_summary(figures, out, pictures, seconds), indent=2))
    elif not quiet:
        for line in _lines(figures, out, seconds):
            typer.echo(line)


def _tell(text: str, silent: bool) -> None:
    if not silent:
        typer.echo(text, err=True)


def _summary(figures: DemoFigures, out: Path, pictures: list[Path], seconds: float) -> dict[str, object]:
    known = {key: None if math.isnan(value) else value for key, value in asdict(figures).items()}
    places = {"phantom": str(out / "phantom"), "run": str(out / "run"), "pictures": [str(file) for file in pictures]}
    return known | places | {"seconds": round(seconds, 1)}


def _lines(figures: DemoFigures, out: Path, seconds: float) -> list[str]:
    f, run, pictures = figures, out / "run", out / "pictures"
    return [
        f"{f.tracked} of {f.frames} frames tracked over a true path of {f.path_mm:.1f} mm, in {seconds:.0f} s",
        f"position error (ATE RMSE): {f.ate_sim3_mm:.2f} mm after Sim(3) with scale {f.scale:.3f}, "
        f"{f.ate_origin_mm:.2f} mm with only the first poses aligned",
        f"rotation since frame 1, unaligned: off by {f.rotation_mean_deg:.2f} deg, {f.rotation_max_deg:.2f} at most",
        f"mesh to true surface, after Sim(3): mean {f.mesh_accuracy_mm:.2f} mm, half within "
        f"{f.mesh_median_mm:.2f} mm; true surface to mesh: mean {f.mesh_completeness_mm:.2f} mm",
        f"depth, each frame scaled by its median: AbsRel {f.depth_abs_rel:.3f}, before MAPIS {f.raw_depth_abs_rel:.3f}",
        f"mesh: {run / 'mesh.ply'} and mesh.glb; truth: {out / 'phantom' / 'mesh_truth.ply'}",
        f"trajectory: {run / 'trajectory.tum'}; truth: {out / 'phantom' / 'pose.txt'}",
        f"pictures: {pictures / 'trajectory.png'} (estimate green, truth red), mesh.png, depth.png",
    ]
