"""What tissue that moves does to a run with a rigid and with a non-rigid adjustment, on phantoms with exact truth.

    python -m scopemap_bench.scripts.moving_tissue [--out FOLDER] [--seeds 31 32 33]

Phantoms of 100 frames: tissue pushed two ways, breathing of 4 mm twice, a part that is poked, and tissue at rest.
Shape: median distance, over every tenth frame, of the points of its depth map, at its pose, from the true tissue then;
one Sim(3) for all, fitted without what is farther off than three medians. ATE is after a Sim(3) of the path.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.actions.inputs import open_truth
from scopemap.geometry.align import Similarity, umeyama
from scopemap.geometry.se3 import transform
from scopemap.io.depth_maps import DepthReader
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.scripts import measuring

PHANTOMS = {
    "pushed": ("--scene", "laparoscopy", "--events", "push:30-60"),
    "breath": ("--scene", "colon", "--deform", "--set", "breath_mm=4", "--set", "breath_frames=60"),
    "poked": ("--scene", "laparoscopy", "--events", "poke:30-60"),
    "still": (
        "--scene",
        "laparoscopy",
    ),
}
FRAMES, EVERY, PIXELS = 100, 10, 8
CODES = {
    "mapping-adjusted": "rigid",
    "mapping-not-rigid": "as tracked",
    "mapping-depth-disagrees": "as tracked",
    "mapping-tissue-moves": "moving",
}


def shape_error_mm(run: Path, source: Path) -> float:
    """Return the median distance of a run's depth maps from the true tissue, each at its time, mm."""
    paths = [read_trajectory(folder).T_world_camera for folder in (run, source)]
    depth = DepthReader(run)
    found: list[np.ndarray] = []
    true: list[np.ndarray] = []
    for frame, truth in open_truth(run, source):
        estimated_mm = depth.read(frame.index)
        if frame.index % EVERY or truth is None or truth.depth_mm is None or estimated_mm is None:
            continue
        row, column = np.mgrid[: frame.camera.height : PIXELS, : frame.camera.width : PIXELS].reshape(2, -1)
        depths = [depth_mm[row, column] for depth_mm in (estimated_mm, truth.depth_mm)]
        known = frame.valid[row, column] & np.isfinite(depths[0]) & (depths[1] > 0)
        rays = frame.camera.unproject(np.column_stack([column, row])[known].astype(float))
        for points, depth_mm, T in zip((found, true), depths, paths, strict=True):
            points.append(transform(T[frame.index], depth_mm[known, None] * rays))
    return _median_distance(np.concatenate(found), np.concatenate(true))


def _median_distance(found: np.ndarray, true: np.ndarray) -> float:
    kept = np.ones(len(found), bool)
    far = np.zeros(len(found))
    for _ in range(3):
        aligned: Similarity = umeyama(found[kept], true[kept], with_scale=True)
        far = np.linalg.norm(aligned.transform_points(found) - true, axis=1)
        kept = far < 3 * np.median(far)
    return float(np.median(far))


def print_phantom(name: str, seed: int, folder: Path) -> None:
    """Render a phantom, run it both ways unless that was done, and print its row."""
    stem = f"{name}-{seed}"
    source = measuring.phantom(folder / stem, "--frames", FRAMES, "--seed", seed, *PHANTOMS[name])
    cells: list[list[str]] = []
    for method in ("rigid", "full"):
        run = measuring.run_once(source, folder / f"{stem}-{method}", "--set", f"mapping.method={method}")
        codes = [notice["code"] for notice in measuring.provenance(run)["notices"]]
        figures = measuring.evaluated(run, "--truth", source, "--align", "sim3", "--depth", "none")
        done = next((CODES[code] for code in codes if code in CODES), "as tracked")
        measured = [measuring.cell(figures, ".2f", name) for name in ("ate_rmse_mm", "mesh_accuracy_mm")]
        cells.append([done, measured[0], f"{shape_error_mm(run, source):.2f}", measured[1]])
    measuring.print_row(f"{name}, seed {seed}", *(" / ".join(column) for column in zip(*cells, strict=True)))


def main() -> None:
    """Print the table."""
    parser = measuring.options_of(__doc__, out=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[31, 32, 33], help="seeds of the phantoms")
    options = parser.parse_args()
    with measuring.folder_or_scratch(options.out) as folder:
        folder.mkdir(parents=True, exist_ok=True)
        print("With mapping.method=rigid / by default:\n")
        measuring.print_head("phantom", "taken as", "ATE RMSE mm", "shape over time mm", "mesh to truth mm")
        for name in PHANTOMS:
            for seed in options.seeds:
                print_phantom(name, seed, folder)


if __name__ == "__main__":
    main()
