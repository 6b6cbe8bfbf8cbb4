"""Where tissue has moved, does the surface as seen at a second agree better with the frames of then than that of all?

    python -m scopemap_bench.scripts.surface_at [--out FOLDER] [--seeds 31 32] [--set NAME=VALUE ...]

Laparoscopy phantoms of three seconds, a part of whose tissue is pushed by 8 mm in the middle (`--events poke:35-55`),
are run with default settings: with a mesh of all frames, and with `--surface-at` their first and their last second.
Printed: median |ln| of the mesh's depth over that of the frame of then, and the likeness (SSIM) of the mesh, rendered
there, to that frame, where tissue moved by 2 mm or more by the truth, and elsewhere.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.actions.inputs import open_truth
from scopemap.fusion.agreement import compare_with_frame
from scopemap.geometry.se3 import inverse, transform
from scopemap.io.depth_maps import DepthReader
from scopemap.trajectory.formats.opening import read_trajectory

# Siblings are found where this file runs as a script; here, too, where it is loaded by its path.
from scopemap_bench.scripts.overview import scopemap

FRAMES, RATE_HZ, EVENT = 90, 30.0, "poke:35-55"
MOVED_MM, GROWN_PX = 2.0, 9
HEAD = "| seed | second | surface | moved: depth, SSIM | elsewhere: depth, SSIM |\n|---|---|---|---|---|"


def row(seed: int, at_s: float, phantom: Path, run: Path, how: str) -> str:
    """Return the row of a run: its surface against the frame of a second."""
    index = round(at_s * RATE_HZ)
    first, last, then = (
        np.asarray(trimesh.load(phantom / "mesh_truth" / f"{number:04d}.ply", process=False).vertices)
        for number in (0, FRAMES - 1, index)
    )
    frame = next(frame for frame, _ in open_truth(run, phantom) if frame.index == index)
    T_true = read_trajectory(phantom).T_world_camera[index]
    own = transform(inverse(T_true), then[np.linalg.norm(last - first, axis=1) > MOVED_MM])
    column, row = np.rint(frame.camera.project(own)).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < frame.camera.width) & (row < frame.camera.height)
    moved = np.zeros(frame.valid.shape, np.uint8)
    moved[row[inside], column[inside]] = 1
    moved = cv2.morphologyEx(moved, cv2.MORPH_CLOSE, np.ones((GROWN_PX, GROWN_PX), np.uint8)) > 0
    depth_mm, T = DepthReader(run).read(index), read_trajectory(run).T_world_camera[index]
    mesh = trimesh.load(run / "mesh.ply", process=False)
    cells = []
    for part in (moved, ~moved):
        known_mm = np.where(part & frame.valid, depth_mm, np.nan)
        found, _ = compare_with_frame(mesh, frame.camera, T, frame.rgb, known_mm, albedo=True)
        cells.append(f"{found.depth_error:.4f}, {found.ssim:.3f}")
    return f"| {seed} | {at_s:.1f} | {how} | {' | '.join(cells)} |"


def main() -> None:
    """Render, run, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="keep phantoms and runs here")
    parser.add_argument("--seeds", type=int, nargs="+", default=[31, 32])
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the runs")
    options = parser.parse_args()
    changes = [word for one in options.set for word in ("--set", one)]
    with tempfile.TemporaryDirectory() as scratch:
        out = options.out or Path(scratch)
        print(HEAD, flush=True)
        for seed in options.seeds:
            phantom = out / f"poke{seed}"
            if not (phantom / "mesh_truth.ply").is_file():
                arguments = ("--scene", "laparoscopy", "--frames", str(FRAMES), "--seed", str(seed), "--events", EVENT)
                scopemap("phantom", str(phantom), *arguments, "--quiet")
            seconds = (0.0, (FRAMES - 1) / RATE_HZ)
            for how, at_s in (("all frames", None), *((f"at {second:.1f} s", second) for second in seconds)):
                run = out / f"run{seed}-{how.replace(' ', '-')}"
                at = [] if at_s is None else ["--surface-at", str(at_s)]
                scopemap("run", str(phantom), "--out", str(run), "--overwrite", "--quiet", *at, *changes)
                for second in seconds if at_s is None else (at_s,):
                    print(row(seed, second, phantom, run, how), flush=True)


if __name__ == "__main__":
    main()
