"""How whole, true and alike to its video is the surface of default runs; also where tissue moves.

    python -m scopemap_bench.scripts.surface --data FOLDER [--out FOLDER] [--only NAME ...]

First table: `scopemap evaluate --against-video` and `--truth`. Kept out: each tenth frame, compared with the surface of
the others; depth is the median of |ln ratio|; in brackets is what the coloured points of the nearest fused frame reach.
AbsRel is that of all depth maps with one scale. Runs of `overview --out FOLDER` are used again. Second table:
`--camera-at-rest` on EndoNeRF's `pulling_soft_tissues`: median of |z - stereo| at the vertices of each frame's surface
outside `gt_masks`, with one scale for all. Third table: laparoscopy phantoms, a part of whose tissue is pushed by 8 mm
in the middle of three seconds: the surface of a frame's segment against that frame, where tissue moved by 2 mm or more,
and against its true depth there, with one scale where tissue is at rest.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.engine.fusion.agreement import compare_with_frame
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.result.depth_maps import DepthReader
from scopemap.result.result import Result
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.reread_frames import open_truth
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.overview import PHANTOMS, Clip, clips, drawn

PULLING = "EndoNeRF pulling_soft_tissues"
CLIPS = (
    *("C3VD cecum_t1_a", "colonoscopy video", "laparoscopy video", PULLING),
    *("colon phantom", "laparoscopy phantom", "colon phantom, breathing"),
)
AT_REST = "camera at rest"
AT_A_SECOND = "surface at a second"
POKED = ("--scene", "laparoscopy", "--frames", 90, "--events", "poke:35-55", "--seed", 32)
SECONDS = {0: 0.0, 89: 89 / 30}
MOVED_MM = 2.0
GROWN_PX = 9


def print_surface(clip: Clip, out: Path) -> None:
    """Run a clip unless its run is there, and print its row of the first table."""
    run = measuring.run_once(drawn(clip).source, clip.run_folder(out), *clip.arguments)
    against = ("--truth", clip.source, "--align", "sim3") if clip.has_truth else ()
    # A clip without true depth refuses to measure it.
    depth = ("--depth", "sequence-median") if clip.name in PHANTOMS else ()
    figures = measuring.evaluated(run, "--against-video", *against, *depth)
    agreement = figures.get("against_video", {})
    kept_out, nearest = agreement.get("held_out", {}), agreement.get("nearest_frame", {})
    measuring.print_row(
        clip.name,
        measuring.cell(kept_out, ".3f", "coverage_mean", "coverage_least"),
        measuring.cell(kept_out, ".3f", "depth_error"),
        f"{measuring.cell(kept_out, '.3f', 'ssim')} ({measuring.cell(nearest, '.3f', 'ssim')})",
        measuring.cell(figures.get("depth", {}), ".3f", "abs_rel"),
        measuring.cell(figures, ".2f", "mesh_accuracy_mm"),
        measuring.cell(figures, ".2f", "mesh_completeness_mm"),
    )


def errors_at_rest(run: Path, source: Path) -> tuple[float, np.ndarray]:
    """Return the scale of all surfaces of a camera at rest, and the median error of each against stereo, mm."""
    pairs = []
    for frame, truth in open_truth(run, source):
        file = run / "surfaces" / f"{frame.index:06d}.ply"
        if not file.is_file() or truth is None or truth.depth_mm is None:
            continue
        # The camera is the world's: it is at rest.
        vertices = np.asarray(trimesh.load(file, process=False).vertices)
        column, row = np.rint(frame.camera.project(vertices)).astype(int).T
        stereo_mm = truth.depth_mm[row, column]
        known = np.isfinite(stereo_mm) & (stereo_mm > 0)
        pairs.append((vertices[known, 2], stereo_mm[known]))
    scale = float(np.median(np.concatenate([stereo_mm / found_mm for found_mm, stereo_mm in pairs])))
    return scale, np.array([np.median(np.abs(scale * found_mm - stereo_mm)) for found_mm, stereo_mm in pairs])


def moved_part(source: Path, run: Path, index: int) -> np.ndarray:
    """Return the pixels (H, W) of frame `index` of a phantom whose tissue moves between its first and last frame."""
    first, last, then = (
        np.asarray(trimesh.load(source / "mesh_truth" / f"{number:04d}.ply", process=False).vertices)
        for number in (*SECONDS, index)
    )
    frame = next(frame for frame, _ in open_truth(run, source) if frame.index == index)
    T_true = read_trajectory(source).T_world_camera[index]
    points = transform(inverse(T_true), then[np.linalg.norm(last - first, axis=1) > MOVED_MM])
    column, row = np.rint(frame.camera.project(points)).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < frame.camera.width) & (row < frame.camera.height)
    moved = np.zeros(frame.valid.shape, np.uint8)
    moved[row[inside], column[inside]] = 1
    return cv2.morphologyEx(moved, cv2.MORPH_CLOSE, np.ones((GROWN_PX, GROWN_PX), np.uint8)) > 0


def agreement_there(source: Path, run: Path, index: int) -> str:
    """Return depth error and SSIM of a run's surface against a frame where tissue moves, and its error to truth."""
    frame, truth = next(pair for pair in open_truth(run, source) if pair[0].index == index)
    depth_mm, T = DepthReader(run).read(index), read_trajectory(run).T_world_camera[index]
    moved = moved_part(source, run, index) & frame.valid
    mesh = Result(run).mesh_at(index)
    known_mm = np.where(moved, depth_mm, np.nan)
    found, _ = compare_with_frame(mesh, frame.camera, T, frame.rgb, known_mm, albedo=True)
    assert truth is not None
    assert truth.depth_mm is not None
    # Of one size where tissue is at rest.
    error = np.log(render_mesh(mesh, frame.camera, T).depth_mm / np.where(truth.depth_mm > 0, truth.depth_mm, np.nan))
    to_truth = np.nanmedian(np.abs(error[moved] - np.nanmedian(error[~moved & frame.valid])))
    return f"{found.depth_error:.1%}, {found.ssim:.2f}, {to_truth:.1%}"


def print_at_a_second(out: Path) -> None:
    """Run a poked phantom; print the third table."""
    source = measuring.phantom(out / "phantoms" / "poke", *POKED)
    run = measuring.run_once(source, out / "poke-whole")
    measuring.print_head("second", "surface of its segment: depth, SSIM, to truth")
    for index, second in SECONDS.items():
        measuring.print_row(f"{second:.1f}", agreement_there(source, run, index))


def measure(options: argparse.Namespace, out: Path) -> None:
    """Print the tables that are wanted."""
    wanted, pulling = options.only or [*CLIPS, AT_REST, AT_A_SECOND], Path("endonerf/pulling_soft_tissues")
    known = clips(options.data, out)
    known[PULLING] = Clip(PULLING, options.data / "endoscopy" / pulling, has_truth=False)
    heads = ("clip", "kept out: covered mean / least", "depth", "SSIM (points)", "AbsRel")
    measuring.print_head(*heads, "mesh to truth mm", "truth to mesh mm")
    for name in CLIPS:
        if name in wanted:
            print_surface(known[name], out)
    if AT_REST in wanted:
        run = measuring.run_once(known[PULLING].source, out / "at-rest", "--camera-at-rest", "--depth", "scopenet")
        scale, errors_mm = errors_at_rest(run, known[PULLING].source)
        print()
        measuring.print_head("surfaces", "scale", "error, median mm", "least / most mm")
        spread = f"{errors_mm.min():.2f} / {errors_mm.max():.2f}"
        measuring.print_row(len(errors_mm), f"{scale:.3f}", f"{np.median(errors_mm):.2f}", spread)
    if AT_A_SECOND in wanted:
        print()
        print_at_a_second(out)


def main() -> None:
    """Run, measure, print."""
    parser = measuring.options_of(__doc__, data=True, out=True)
    parser.add_argument("--only", nargs="+", help=f"names of clips, '{AT_REST}', '{AT_A_SECOND}'")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as out:
        measure(options, out)


if __name__ == "__main__":
    main()
