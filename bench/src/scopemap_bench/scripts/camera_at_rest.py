"""How far are the surfaces of a camera at rest from stereo depth? One scale for the whole clip, instruments left out.

    python -m scopemap_bench.scripts.camera_at_rest --data FOLDER [--out FOLDER] [--set NAME=VALUE ...]
    python -m scopemap_bench.scripts.camera_at_rest --data FOLDER --run FOLDER

FOLDER is the real data's (README, "Tests on real data"): EndoNeRF's `pulling_soft_tissues`, whose camera does not move.
`scopemap run --camera-at-rest` makes a surface per frame; stereo and masks only measure. Printed per surface: the
median of |z - stereo| at the surface's vertices outside `gt_masks`, mm, with one scale for all and with its own.
`--run` measures an earlier run.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from scopemap.actions.inputs import open_truth

# Siblings are found where this file runs as a script; here, too, where it is loaded by its path.
from scopemap_bench.scripts.overview import scopemap

CLIP = "endonerf/pulling_soft_tissues"
AIM_MM = 1.5


@dataclass(frozen=True)
class Pairs:
    """A frame's number, and depth of its surface's vertices and of stereo there, (N,) mm each."""

    index: int
    surface_mm: np.ndarray
    stereo_mm: np.ndarray

    def error_mm(self, scale: float) -> float:
        """Return the median difference after a scale."""
        return float(np.median(np.abs(scale * self.surface_mm - self.stereo_mm)))

    @property
    def scale(self) -> float:
        """The median ratio of stereo to surface."""
        return float(np.median(self.stereo_mm / self.surface_mm))


def pairs_of(run: Path, source: Path) -> list[Pairs]:
    """Return the pairs of every frame with a surface; raises `InputError` for a run of another input."""
    found = []
    for frame, truth in open_truth(run, source):
        file = run / "surfaces" / f"{frame.index:06d}.ply"
        if not file.is_file() or truth is None or truth.depth_mm is None:
            continue
        # The camera is the world's: it is at rest.
        vertices = np.asarray(trimesh.load(file, process=False).vertices)
        column, row = np.rint(frame.camera.project(vertices)).astype(int).T
        stereo_mm = truth.depth_mm[row, column]
        known = np.isfinite(stereo_mm) & (stereo_mm > 0)
        found.append(Pairs(frame.index, vertices[known, 2], stereo_mm[known]))
    return found


def main() -> None:
    """Run, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, help="keep the run here")
    parser.add_argument("--run", type=Path, help="measure this run")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the run")
    options = parser.parse_args()
    source = options.data / "endoscopy" / CLIP
    with tempfile.TemporaryDirectory() as scratch:
        run = options.run or options.out or Path(scratch) / "run"
        if options.run is None:
            changes = [word for one in ("depth.backend=scopenet", *options.set) for word in ("--set", one)]
            scopemap("run", str(source), "--out", str(run), "--overwrite", "--quiet", "--camera-at-rest", *changes)
        found = pairs_of(run, source)
    ratios = np.concatenate([pairs.stereo_mm / pairs.surface_mm for pairs in found])
    scale = float(np.median(ratios))
    print("| frame | one scale, mm | own scale, mm |\n|---|---|---|")
    errors = [(pairs.error_mm(scale), pairs.error_mm(pairs.scale)) for pairs in found]
    for pairs, (one, own) in zip(found, errors, strict=True):
        print(f"| {pairs.index} | {one:.2f} | {own:.2f} |")
    one, own = np.array(errors).T
    within = f"{(one <= AIM_MM).sum()} of {len(one)} within {AIM_MM} mm"
    spread = f"median {np.median(one):.2f} mm, {one.min():.2f} to {one.max():.2f}"
    print(f"\none scale for all ({scale:.3f}): {spread}; {within}")
    print(f"a scale per surface: median {np.median(own):.2f} mm")


if __name__ == "__main__":
    main()
