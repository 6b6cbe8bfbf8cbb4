"""How far from the truth are depth and mesh of whole runs, and what is the back end's correction of depth worth?

    python benchmarks/surface_of_runs.py --data FOLDER [--depth BACKEND]

FOLDER is the real data's (README, "Real data"). Six phantoms that took part in no choice are rendered first; on the
real clip cecum_t1_a the truth is two clouds of points, what its frames 0 and 1 see. Each is run with poses and depth as
tracked, with depth only scaled by the back end, and as by default. Depth: mean |d - g| / g with one scale for all
frames, and with each frame's own median; mesh, after `sim3` alignment of the poses: mean distances, mm (of the clip:
from the clouds to the mesh, and their median).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

# Siblings are found where this file runs as a script; here, too, where it is loaded by its path.
sys.path.insert(0, str(Path(__file__).resolve().parent))

from depth_scenes import drawn

from scopemap import Config, Reconstruction, open_sequence, reconstruct
from scopemap.evaluation.poses import match, pose_report
from scopemap.evaluation.surface import compare_surfaces
from scopemap.geometry.se3 import inverse, transform
from scopemap.io.datasets.c3vd import C3vdFolder
from scopemap.io.datasets.reference import read_reference
from scopemap.phantom.spec import PhantomSpec
from scopemap.phantom.writer import write_phantom
from scopemap.reconstruction import DepthReader

HEADER = "| run | ATE | depth, one scale | depth, medians | mesh to truth | truth to mesh |\n|---|---|---|---|---|---|"
VARIANTS: dict[str, dict[str, Any]] = {
    "as tracked": {"mapping.method": "none"},
    "depth only scaled": {"mapping.advanced.depth_step_sigma": 0.0},
    "default": {},
}
_CLIPPED_MM = 99.9
_SURFACE_POINTS_MM = 0.5


def phantoms(folder: Path, data: Path) -> Iterator[tuple[str, Path]]:
    """Render and yield the phantoms."""
    path = data / "endoscopy/c3vd_camera_paths/c4v2.txt"
    specs = {
        "colon, seed 21": PhantomSpec(scene="colon", frames=150, seed=21),
        "colon, seed 22, real camera path c4v2": PhantomSpec(scene="colon", frames=150, seed=22, path_file=path),
        "laparoscopy, seed 23": PhantomSpec(scene="laparoscopy", frames=120, seed=23),
        "laparoscopy, seed 24, 65 degrees": PhantomSpec(scene="laparoscopy", frames=120, seed=24, fov_deg=65),
        "colon that breathes, seed 25": PhantomSpec(scene="colon", frames=150, seed=25, deform=True),
        "laparoscopy that breathes, seed 26": PhantomSpec(scene="laparoscopy", frames=150, seed=26, deform=True),
    }
    for number, (name, spec) in enumerate(specs.items()):
        write_phantom(spec, folder / f"phantom{number}")
        yield name, folder / f"phantom{number}"


def depth_errors(truths_mm: dict[int, np.ndarray], depth: DepthReader) -> tuple[float, float]:
    """Return the mean relative error with one scale for all frames, and with each frame's own median."""
    pairs = []
    for index, truth_mm in truths_mm.items():
        told_mm = depth.read(index)
        if told_mm is None:
            continue
        known = np.isfinite(told_mm) & (told_mm > 0) & np.isfinite(truth_mm)
        pairs.append((told_mm[known], truth_mm[known]))
    told, true = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    scale = np.median(true) / np.median(told)
    one = [float((np.abs(scale * d - g) / g).mean()) for d, g in pairs]
    own = [float((np.abs(d * np.median(g) / np.median(d) - g) / g).mean()) for d, g in pairs]
    return float(np.mean(one)), float(np.mean(own))


def row(name: str, ate_mm: float, depth: tuple[float, float], mesh: tuple[float, float]) -> str:
    """Return a row of the table."""
    return f"| {name} | {ate_mm:.3f} | {depth[0]:.3f} | {depth[1]:.3f} | {mesh[0]:.2f} | {mesh[1]:.2f} |"


def aligned(result: Reconstruction, source: Path) -> tuple[float, trimesh.Trimesh]:
    """Return the position error and the mesh, moved by the alignment of the poses."""
    matched = match(result.trajectory, read_reference(source), "sim3")
    mesh = result.mesh.copy()
    mesh.vertices = matched.similarity.transform_points(mesh.vertices)
    return pose_report(matched)["ate_rmse_mm"], mesh


def phantom_rows(folder: Path, data: Path, settings: dict[str, Any]) -> Iterator[str]:
    """Run the phantoms and yield their rows."""
    for name, source in phantoms(folder, data):
        truth = C3vdFolder(source)
        for variant, changes in VARIANTS.items():
            config = Config.load(settings=settings | changes)
            result = reconstruct(open_sequence(source), config, out=folder / "run", overwrite=True)
            truths_mm: dict[int, np.ndarray] = {}
            for record in result.records[::5]:
                true = truth.truth(record.index)
                assert true is not None and true.depth_mm is not None  # noqa: PT018
                known = (true.depth_mm > 0) & (true.depth_mm < _CLIPPED_MM)
                truths_mm[record.index] = np.where(known, true.depth_mm, np.nan)
            ate_mm, mesh = aligned(result, source)
            surface = compare_surfaces(mesh, trimesh.load_mesh(source / "mesh_truth.ply"))
            errors = depth_errors(truths_mm, DepthReader(folder / "run"))
            yield row(
                f"{name}, {variant}", ate_mm, errors, (surface["accuracy_mean_mm"], surface["completeness_mean_mm"])
            )


def clip_rows(folder: Path, data: Path, settings: dict[str, Any]) -> Iterator[str]:
    """Run cecum_t1_a and yield its rows."""
    source = data / "endoscopy/c3vd/cecum_t1_a"
    poses = read_reference(source)
    assert poses is not None
    clouds = {
        index: np.asarray(trimesh.load(source.parent / "cecum_t1_a_gt_clouds" / f"{index:04d}_depth_pcd.ply").vertices)
        for index in (0, 1)
    }
    for variant, changes in VARIANTS.items():
        result = reconstruct(
            open_sequence(source), Config.load(settings=settings | changes), out=folder / "run", overwrite=True
        )
        truths_mm, seen = {}, []
        for index, cloud in clouds.items():
            points = transform(inverse(poses.T_world_camera[index]), cloud)
            inside = (points[:, 2] > 0) & (points[:, 2] <= _CLIPPED_MM)
            truths_mm[index] = drawn(points[inside], result.camera)
            seen.append(cloud[inside])
        ate_mm, mesh = aligned(result, source)
        surface = trimesh.sample.sample_surface_even(mesh, int(mesh.area / _SURFACE_POINTS_MM**2), seed=0)[0]
        off_mm = cKDTree(surface).query(np.concatenate(seen))[0]
        errors = depth_errors(truths_mm, DepthReader(folder / "run"))
        yield row(f"cecum_t1_a, {variant}", ate_mm, errors, (float(np.mean(off_mm)), float(np.median(off_mm))))


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--depth", default="scopenet", help="depth backend of the runs on phantoms")
    options = parser.parse_args()
    light = {"networks.flow": "dis", "networks.perceptual": "structure"}
    files = f"files:{options.data}/endoscopy/c3vd/cecum_t1_a_depth_anything"
    near_far = {"depth.backend": files, "depth.near_far_mm": (13.5, 100.0)}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        print(HEADER, flush=True)
        for line in phantom_rows(folder, options.data, light | {"depth.backend": options.depth}):
            print(line, flush=True)
        print(f"\nOn the clip: mean and median distance from the clouds to the mesh.\n\n{HEADER}", flush=True)
        for line in clip_rows(folder, options.data, light):
            print(line, flush=True)
        print(f"\nThe same with Depth Anything's files.\n\n{HEADER}", flush=True)
        for line in clip_rows(folder, options.data, light | near_far):
            print(line, flush=True)


if __name__ == "__main__":
    main()
