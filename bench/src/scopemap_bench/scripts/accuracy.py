"""Errors against the truth, one row per run, as Markdown: real frames, phantoms, ablations.

    python -m scopemap_bench.scripts.accuracy --data FOLDER [--only real|phantom|backend|ablation|photometric]
            [--keep FOLDER]

FOLDER is the real data's (README, "Real data"); its `weights` are used for RAFT and LPIPS. Phantoms are rendered first.
ATE in mm after the stated alignment; rotation in degrees since the first frame, unaligned; "10" is the RPE over 10
frames; TLR before any alignment. ms is wall time per frame, reading and looking ahead in a second thread.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scopemap import Config, open_sequence, reconstruct
from scopemap.evaluation.poses import match, pose_report
from scopemap.io.reference import read_reference
from scopemap_bench.evaluation.surface import compare_surfaces
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom

HEADER = (
    "| run | frames tracked | alignment | ATE | rotation mean / max | 10: mm / deg | TLR | mesh to truth | ms |\n"
    "|---|---|---|---|---|---|---|---|---|"
)
SHADING = {"depth.backend": "shading"}
NO_SURFACE = {"fusion.enabled": False}
TRACKED = {"mapping.method": "none"}
# One part each taken away or replaced: of what tracks and makes depth consistent, measured without the back end, which
# would hide most of it ...
FRONT_END: dict[str, dict[str, Any]] = {
    "no corners": {"tracking.advanced.corner_depth_sigma": 0.0},
    "no early keyframes": {"tracking.advanced.min_keyframe_agreement": 0.0},
    "keyframe every 2": {"tracking.keyframe_every": 2},
    "keyframe every 5": {"tracking.keyframe_every": 5},
    "keyframe every 20": {"tracking.keyframe_every": 20},
    "no frame scale": {"mapis.advanced.frame_scale": "none"},
    "no blending": {"mapis.paper.blend": "none"},
    "constant blend": {"mapis.paper.blend": "constant"},
    "paper's equation for the blend": {"mapis.paper.blend": "paper-equation"},
    "depth values copied, not moved": {"mapis.paper.order": "refine-first"},
    "WEMA": {"smoothing.method": "wema"},
    "WEMA, s = 1": {"smoothing.method": "wema", "smoothing.dynamic": False},
    "no flow": {"networks.flow": "none"},
}
# ... of photometric alignment, where it is used: measured depth ...
PHOTOMETRIC: dict[str, dict[str, Any]] = {
    "no distance to the frame's depth": {"tracking.advanced.depth_weight": 0.0},
    "grey values only": {"tracking.paper.channels": "grey"},
    "no lamp": {"tracking.paper.lamp_gamma": 0.0},
    "no gain and bias": {"tracking.paper.gain_bias": False},
    "neither lamp nor gain and bias": {"tracking.paper.lamp_gamma": 0.0, "tracking.paper.gain_bias": False},
    "no SO(3) stage": {"tracking.paper.rotation_first": False},
    "Gauss-Newton": {"tracking.paper.solver": "gauss-newton"},
    "full resolution": {"tracking.advanced.finest_level": 0},
}
# ... of the back end, with all of the front end; of loop closure, where the camera returns.
LOOPS: dict[str, dict[str, Any]] = {"no loops": {"mapping.min_loop_inliers": 0}}
BACK_END: dict[str, dict[str, Any]] = {
    "links to the keyframe before only": {"mapping.advanced.keyframe_gaps": (1,)},
    "depth of keyframes hardly adjusted": {"mapping.advanced.scale_sigma": 1e-3},
    "back end, but no corners while tracking": {"tracking.advanced.corner_depth_sigma": 0.0},
}


@dataclass(frozen=True)
class Run:
    """One row: an input, how it is aligned, the settings that differ from the default, and the frames; None: all."""

    name: str
    source: Path
    align: str
    settings: dict[str, Any] = field(default_factory=dict)
    frames: slice | None = None


def real_runs(data: Path) -> Iterator[Run]:
    """Yield the runs on real frames."""
    cecum, trans = data / "endoscopy/c3vd/cecum_t1_a", data / "endoscopy/c3vd/trans_t1_a"
    kitchen = data / "rgbd/7scenes_kitchen_100f"
    files = {"depth.backend": f"files:{cecum}_depth_anything"}
    near_far = {"depth.near_far_mm": (13.5, 100.0)}
    raft = {"networks.flow": "raft-small", "networks.perceptual": "lpips"}
    yield Run("cecum_t1_a, Depth Anything files, near-far, RAFT small, LPIPS", cecum, "sim3", files | near_far | raft)
    yield Run("the same, DIS, structural similarity", cecum, "sim3", files | near_far)
    yield Run("the same, no back end", cecum, "sim3", files | near_far | TRACKED)
    one_field = {"input.deinterlace": True}
    yield Run("the same, one field of each picture", cecum, "sim3", files | near_far | one_field)
    yield Run("anchored by shading, DIS", cecum, "sim3", files | {"depth.anchor": "shading"})
    yield Run("cecum_t1_a, scopenet, RAFT small, LPIPS", cecum, "sim3", raft)
    yield Run("cecum_t1_a, scopenet, DIS, structural similarity", cecum, "sim3")
    yield Run("the same, no back end", cecum, "sim3", TRACKED)
    yield Run("cecum_t1_a, shading, RAFT small, LPIPS", cecum, "sim3", SHADING | raft)
    yield Run("cecum_t1_a, shading, DIS, structural similarity", cecum, "sim3", SHADING)
    yield Run("the same, no back end", cecum, "sim3", SHADING | TRACKED)
    yield Run(
        "trans_t1_a, true depth",
        trans,
        "se3",
        {"depth.backend": f"files:{trans}", "fusion.advanced.min_weight": 0.5},
    )
    room = {"fusion.voxel_mm": 10, "fusion.truncation_mm": 40, "fusion.max_depth_mm": 4000}
    yield Run("7scenes_kitchen_100f, measured depth", kitchen, "sim3", {"depth.backend": f"files:{kitchen}"} | room)


def phantom_runs(folder: Path, data: Path) -> Iterator[Run]:
    """Render the phantoms and yield the runs on them."""
    path = data / "endoscopy/c3vd_camera_paths/t3v2.txt"
    specs = {
        "colon, 200 frames": PhantomSpec(scene="colon", frames=200, seed=0),
        "colon, another seed": PhantomSpec(scene="colon", frames=120, seed=5),
        "colon, real camera path t3v2": PhantomSpec(scene="colon", frames=120, seed=1, path_file=path),
        "laparoscopy": PhantomSpec(scene="laparoscopy", frames=120, seed=2),
    }
    for number, (name, spec) in enumerate(specs.items()):
        source = folder / f"phantom{number}"
        write_phantom(spec, source)
        yield Run(f"{name}, true depth", source, "origin", {"depth.backend": f"files:{source}"})
        yield Run(f"{name}, scopenet", source, "sim3")
        yield Run(f"{name}, scopenet, no back end", source, "sim3", TRACKED)
        yield Run(f"{name}, shading", source, "sim3", SHADING)


def backend_runs(folder: Path, data: Path) -> Iterator[Run]:
    """Yield runs as tracked, as by default, and adjusted even where tissue moves by itself; scopenet throughout."""
    path = data / "endoscopy/c3vd_camera_paths/c4v2.txt"
    specs = {
        "colon, real camera path c4v2": PhantomSpec(scene="colon", frames=60, seed=1, path_file=path),
        "laparoscopy": PhantomSpec(scene="laparoscopy", frames=60, seed=2),
        "laparoscopy that breathes": PhantomSpec(scene="laparoscopy", frames=60, seed=4, deform=True, breath_frames=60),
    }
    for number, (name, spec) in enumerate(specs.items()):
        source = folder / f"adjusted{number}"
        write_phantom(spec, source)
        for variant, changes in {
            "as tracked": TRACKED,
            "default": {},
            "always adjusted": {"mapping.advanced.max_sigma_px": 99.0, "mapping.advanced.max_depth_change": 9.0},
        }.items():
            yield Run(f"{name}, {variant}", source, "sim3", NO_SURFACE | changes)


def ablation_runs(folder: Path, data: Path) -> Iterator[Run]:
    """Yield each ablation where its part can matter.

    Fast motion: every third frame of the real clip (Depth Anything files). Predicted and true depth: a phantom. Loops:
    a phantom that ends where it began.
    """
    cecum, colon, returning = data / "endoscopy/c3vd/cecum_t1_a", folder / "ablated", folder / "returning"
    write_phantom(PhantomSpec(scene="colon", frames=120, seed=5), colon)
    write_phantom(PhantomSpec(scene="colon", frames=301, seed=5, loop=True), returning)
    files = {"depth.backend": f"files:{cecum}_depth_anything", "depth.near_far_mm": (13.5, 100.0)}
    fast = (cecum, "cecum_t1_a, every third frame", files, slice(None, None, 3))
    for source, where, settings, frames in (fast, (colon, "colon, scopenet", {}, None)):
        light = settings | NO_SURFACE
        for name, changes in ({"default": {}} | BACK_END).items():
            yield Run(f"{name}: {where}", source, "sim3", light | changes, frames)
        for name, changes in ({"as tracked": {}} | FRONT_END).items():
            yield Run(f"{name}: {where}", source, "sim3", light | TRACKED | changes, frames)
    for name, changes in ({"default": {}} | LOOPS).items():
        yield Run(f"{name}: colon that returns, scopenet", returning, "sim3", NO_SURFACE | changes)
    exact = {"depth.backend": f"files:{colon}"} | NO_SURFACE
    for name, changes in ({"as tracked": {}} | PHOTOMETRIC).items():
        yield Run(f"{name}: colon, true depth", colon, "origin", exact | changes)


def photometric_runs(data: Path) -> Iterator[Run]:
    """Yield the ablations of photometric alignment where it gives every pose: fast motion, predicted depth."""
    cecum = data / "endoscopy/c3vd/cecum_t1_a"
    alone = {"depth.backend": f"files:{cecum}_depth_anything", "depth.near_far_mm": (13.5, 100.0)}
    alone |= NO_SURFACE | TRACKED | {"tracking.advanced.corner_depth_sigma": 0.0}
    for name, changes in ({"photometric alignment alone": {}} | PHOTOMETRIC).items():
        where = "cecum_t1_a, every third frame, Depth Anything"
        yield Run(f"{name}: {where}", cecum, "sim3", alone | changes, slice(None, None, 3))


def row(run: Run, out: Path | None) -> str:
    """Reconstruct, measure, and return the table row."""
    started = time.perf_counter()
    config = Config.load(settings=run.settings)
    result = reconstruct(open_sequence(run.source, frames=run.frames, settings=config.input), config, out=out)
    ms = 1e3 * (time.perf_counter() - started) / len(result.frames)
    matched = match(result.trajectory, read_reference(run.source), run.align)
    report, mesh_file = pose_report(matched), run.source / "mesh_truth.ply"
    surface = ""
    if mesh_file.is_file() and len(result.mesh.faces):
        import trimesh

        moved = result.mesh.copy()
        moved.vertices = matched.similarity.transform_points(moved.vertices)
        surface = f"{compare_surfaces(moved, trimesh.load_mesh(mesh_file))['accuracy_mean_mm']:.2f}"
    rotation = f"{report['rotation_unaligned_mean_deg']:.2f} / {report['rotation_unaligned_max_deg']:.2f}"
    ten = ""
    if report["rpe_10_mm"] == report["rpe_10_mm"]:
        ten = f"{report['rpe_10_mm']:.3f} / {report['rpe_10_deg']:.3f}"
    tracked = f"{report['tracked']} of {report['frames']}"
    return (
        f"| {run.name} | {tracked} | {run.align} | {report['ate_rmse_mm']:.3f} | {rotation} | {ten} "
        f"| {report['tlr']:.3f} | {surface} | {ms:.0f} |"
    )


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", choices=("real", "phantom", "backend", "ablation", "photometric"))
    parser.add_argument("--keep", type=Path, help="keep the runs' folders here")
    options = parser.parse_args()
    os.environ.setdefault("SCOPEMAP_WEIGHTS_DIR", str(options.data / "weights"))
    with tempfile.TemporaryDirectory() as scratch:
        groups = {
            "real": lambda: real_runs(options.data),
            "phantom": lambda: phantom_runs(Path(scratch), options.data),
            "backend": lambda: backend_runs(Path(scratch), options.data),
            "ablation": lambda: ablation_runs(Path(scratch), options.data),
            "photometric": lambda: photometric_runs(options.data),
        }
        number = 0
        for group in [options.only] if options.only else groups:
            print(f"\n### {group}\n\n{HEADER}", flush=True)
            for run in groups[group]():
                print(row(run, options.keep / f"{number:02d}" if options.keep else None), flush=True)
                number += 1


if __name__ == "__main__":
    main()
