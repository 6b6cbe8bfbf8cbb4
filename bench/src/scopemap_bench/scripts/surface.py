"""How whole, true and alike to its video is the surface of a run, by default settings, on real clips and phantoms?

    python -m scopemap_bench.scripts.surface --data FOLDER [--phantoms FOLDER] [--out FOLDER] [--set NAME=VALUE]
            [--only NAME ...]
    python -m scopemap_bench.scripts.surface --data FOLDER --runs FOLDER ... [--unseen]

FOLDER is the real data's (README, "Tests on real data"); phantoms that are not in theirs are rendered. `--runs` holds
earlier runs by the clips' names: their poses and depth are fused again with today's default settings. Runs use networks
that need no download, whatever weights there are; LPIPS, which only measures, needs its own (SCOPEMAP_WEIGHTS_DIR).

First table, without truth: agreement of the surface with frames kept out of fusion and with those fused, depth as the
median of |ln ratio|, SSIM and LPIPS with, in brackets, what the coloured points of the nearest fused frame reach.
Second table, after `sim3` alignment of the poses: keyframes' depth, mean |d - g| / g with one scale for all, and mean
distances between mesh and true surface; of cecum_t1_a the truth is two clouds, what its frames 0 and 1 see.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap import Config
from scopemap.actions.against_video import RunFrames, SurfaceAgreement
from scopemap.actions.inputs import open_truth
from scopemap.errors import AlignmentError, InputError
from scopemap.evaluation.poses import match, pose_report
from scopemap.geometry.align import Similarity
from scopemap.geometry.se3 import inverse, transform
from scopemap.io.depth_maps import DepthReader
from scopemap.io.reference import read_reference
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap.trajectory.trajectory import TRACKED
from scopemap_bench.evaluation.depth import evaluate_depth_sequence
from scopemap_bench.evaluation.surface import distance_figures, distances_mm
from scopemap_bench.scoring import default_protocol, surface_figures

# Siblings are found where this file runs as a script; here, too, where it is loaded by its path.
from scopemap_bench.scripts.depth_scenes import drawn
from scopemap_bench.scripts.overview import PHANTOMS, scopemap

PHANTOM_NAMES = dict(zip(("colon", "laparoscopy", "tube", "breathe"), PHANTOMS, strict=True))
UNSEEN = {
    "colon-21": ("--scene", "colon", "--frames", "150", "--seed", "21"),
    "colon-22": ("--scene", "colon", "--frames", "150", "--seed", "22", "--path", "c3vd_camera_paths/c4v2.txt"),
    "laparoscopy-23": ("--scene", "laparoscopy", "--frames", "120", "--seed", "23"),
    "laparoscopy-24": ("--scene", "laparoscopy", "--frames", "120", "--seed", "24", "--set", "fov_deg=65"),
    "breathe-25": ("--scene", "colon", "--frames", "150", "--seed", "25", "--deform"),
    "laparoscopy-breathe-26": ("--scene", "laparoscopy", "--frames", "150", "--seed", "26", "--deform"),
}
"""Phantoms that took part in no choice; camera paths are below the data's folder "endoscopy"."""
AGREEMENT_HEAD = (
    "| clip | kept out: covered mean, least | depth | SSIM (points) | LPIPS (points) | fused: covered mean, least "
    "| depth | SSIM | LPIPS | fuse, refine ms per frame |\n|---|---|---|---|---|---|---|---|---|---|"
)
TRUTH_HEAD = (
    "| clip | ATE mm | keyframes' depth, AbsRel | mesh to truth mm, mean | truth to mesh mm, mean (median) |\n"
    "|---|---|---|---|---|"
)
NO_DOWNLOAD = "depth.backend=scopenet"
_CLIPPED_MM = 99.9


@dataclass(frozen=True)
class Measured:
    """A run of a clip: its folder, its surface, the agreement with the video, and seconds of fusion and refinement."""

    run: Path
    source: Path
    mesh: trimesh.Trimesh
    agreement: SurfaceAgreement
    fuse_s: float
    refine_s: float


def clips(data: Path, phantoms: Path) -> Iterator[tuple[str, Path, tuple[str, ...]]]:
    """Yield name, input and the arguments of `scopemap phantom` that make it, if it is one."""
    endoscopy = data / "endoscopy"
    for place in (
        *("c3vd/cecum_t1_a", "video/colonoscopy_nflba_03.mp4", "video/laparoscopy_rvim.mp4"),
        "endonerf/pulling_soft_tissues",
    ):
        yield Path(place).stem, endoscopy / place, ()
    for name, phantom in PHANTOM_NAMES.items():
        yield name, phantoms / name, PHANTOMS[phantom]
    for name, arguments in UNSEEN.items():
        words = (str(endoscopy / word) if word.endswith(".txt") else word for word in arguments)
        yield name, phantoms / name, tuple(words)


def measure(name: str, source: Path, options: argparse.Namespace, out: Path) -> Measured:
    """Run a clip, or fuse an earlier run again, and compare the surface with the video."""
    if options.runs:
        run, fusion = options.runs / name, Config.load(settings=dict(one.split("=", 1) for one in options.set)).fusion
    else:
        run, fusion = out / name, None
        changes = [word for one in (NO_DOWNLOAD, *options.set) for word in ("--set", one)]
        scopemap("run", str(source), "--out", str(run), "--overwrite", "--quiet", *changes)
    with closing(RunFrames(run, fusion)) as frames:
        started = time.perf_counter()
        mesh = frames.fuse() if options.runs else trimesh.load_mesh(run / "mesh.ply", process=False)
        seconds = {"fuse": time.perf_counter() - started}
        agreement, count = frames.agreement(), len(frames.indices)
    if not options.runs:
        seconds = json.loads((run / "provenance.json").read_text())["seconds"]
    refine_s = sum(value for part, value in seconds.items() if "refine" in part)
    return Measured(run, source, mesh, agreement, seconds.get("fuse", 0.0) / count, refine_s / count)


def agreement_row(name: str, found: Measured) -> str:
    """Return the row of a clip in the table without truth."""
    figures = found.agreement.figures()
    nearest = figures["nearest_frame"]

    def text(kind: str, figure: str, *, reference: bool = False) -> str:
        beside = f" ({nearest.get(figure, math.nan):.3f})" if reference else ""
        return f"{figures[kind].get(figure, math.nan):.3f}{beside}"

    cells = [name]
    for kind in ("held_out", "fused"):
        cells.append(f"{text(kind, 'coverage_mean')}, {text(kind, 'coverage_least')}")
        cells += [text(kind, "depth_error"), *(text(kind, f, reference=kind == "held_out") for f in ("ssim", "lpips"))]
    return f"| {' | '.join(cells)} | {1e3 * found.fuse_s:.1f}, {1e3 * found.refine_s:.1f} |"


def truth_row(name: str, found: Measured, data: Path) -> str | None:
    """Return the row of a clip in the table with truth; None where there is none, or the camera is at rest."""
    reference = read_reference(found.source) if found.source.is_dir() else None
    if reference is None:
        return None
    try:
        matched = match(read_trajectory(found.run), reference, "sim3")
    except AlignmentError:
        return None
    ate_mm, clouds = pose_report(matched)["ate_rmse_mm"], cecum_clouds(found.source, data)
    if clouds:
        depth, distances = _against_clouds(found, clouds, matched.similarity, reference.T_world_camera)
        accuracy, completeness = math.nan, distance_figures("", distances)
        return _row(name, ate_mm, depth, accuracy, completeness["_mean_mm"], completeness["_median_mm"])
    sequence = open_truth(found.run, found.source)
    surface = surface_figures(found.mesh, sequence, matched.similarity)
    if not surface:
        return None
    figures = [surface[f"{kind}_mm"] for kind in ("accuracy_mean", "completeness_mean", "completeness_median")]
    return _row(name, ate_mm, keyframe_error(found), *figures)


def _row(name: str, *figures: float) -> str:
    ate_mm, depth, accuracy_mm, completeness_mm, median_mm = figures
    return f"| {name} | {ate_mm:.3f} | {depth:.4f} | {accuracy_mm:.2f} | {completeness_mm:.2f} ({median_mm:.2f}) |"


def keyframe_error(found: Measured) -> float:
    """Return the mean relative error of the depth of a run's keyframes, with one scale for all of them."""
    with (found.run / "frames.csv").open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["keyframe"] and row["status"] in TRACKED]
    keyframes, depth = {int(row["keyframe"]) for row in rows}, DepthReader(found.run)
    sequence = open_truth(found.run, found.source)
    pairs = [
        (told_mm, truth.depth_mm)
        for frame, truth in sequence
        if frame.index in keyframes
        and truth is not None
        and truth.depth_mm is not None
        and (told_mm := depth.read(frame.index)) is not None
    ]
    return _one_scale_error(pairs, default_protocol(sequence).depth_range_mm)


def _one_scale_error(pairs: list[tuple[np.ndarray, np.ndarray]], range_mm: tuple[float, float]) -> float:
    report = evaluate_depth_sequence(lambda: pairs, scaling="sequence-median", truth_range_mm=range_mm)
    return float(report.mean["abs_rel"])


def cecum_clouds(source: Path, data: Path) -> dict[int, np.ndarray]:
    """Return the true points (N, 3), world mm, that frames of a C3VD clip see, by number; {} where there are none."""
    folder = data / "endoscopy" / "c3vd" / f"{source.name}_gt_clouds"
    return {
        int(file.name.split("_")[0]): np.asarray(trimesh.load(file).vertices)
        for file in sorted(folder.glob("*_depth_pcd.ply"))
    }


def _against_clouds(
    found: Measured, clouds: dict[int, np.ndarray], similarity: Similarity, T_world_camera: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the error of the depth of the clouds' frames, and the distances from the clouds to the mesh, mm."""
    camera, depth = open_truth(found.run, found.source).camera, DepthReader(found.run)
    pairs, seen = [], []
    for index, cloud in clouds.items():
        points = transform(inverse(T_world_camera[index]), cloud)
        inside = (points[:, 2] > 0) & (points[:, 2] <= _CLIPPED_MM)
        seen.append(cloud[inside])
        if (told_mm := depth.read(index)) is not None:
            pairs.append((told_mm, drawn(points[inside], camera)))
    mesh = found.mesh.copy()
    mesh.vertices = similarity.transform_points(np.asarray(mesh.vertices))
    return _one_scale_error(pairs, (0.0, _CLIPPED_MM)), distances_mm(np.concatenate(seen), mesh)


def main() -> None:
    """Run, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--phantoms", type=Path, help="keep phantoms here, by the clips' names, or take them from here")
    parser.add_argument("--runs", type=Path, help="fuse these runs again instead of running the clips")
    parser.add_argument("--out", type=Path, help="keep runs here")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the runs")
    parser.add_argument("--only", nargs="+", help="names of clips")
    parser.add_argument("--unseen", action="store_true", help="also the phantoms that took part in no choice")
    options = parser.parse_args()
    truths: list[Any] = []
    with tempfile.TemporaryDirectory() as scratch:
        out = options.out or Path(scratch)
        print(AGREEMENT_HEAD, flush=True)
        for name, source, phantom in clips(options.data, options.phantoms or out / "phantoms"):
            if name not in (options.only or [name]) or (name in UNSEEN and not (options.unseen or options.only)):
                continue
            if phantom and not (source / "mesh_truth.ply").is_file():
                scopemap("phantom", str(source), *phantom, "--quiet")
            try:
                found = measure(name, source, options, out)
            except InputError as error:
                print(f"| {name} | {error} |", flush=True)
                continue
            print(agreement_row(name, found), flush=True)
            truths.append(truth_row(name, found, options.data))
    print("\n".join(["", TRUTH_HEAD, *filter(None, truths)]))


if __name__ == "__main__":
    main()
