"""Writes runs of ours as a submission to the CLiMB challenge.

SUBMISSION/CLIP/RUN/{runtime.txt, camera_trajectory/cam_traj_map_000.txt, 3D_maps/0/points3D.txt}; a file or folder per
submap; RUN is 1 to 5. Source: EndoCartoScope/climb-challenge, submission_instructions/README.md.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import trimesh

from scopemap.errors import InputError
from scopemap.io.run_folder import RunFolder
from scopemap.trajectory.formats.folders import read_run, submap_folders
from scopemap.trajectory.trajectory import Trajectory
from scopemap_bench.trajectories.climb import write_submap

RUNS = ("1", "2", "3", "4", "5")
RUNTIME_KEYS = ("init_seconds", "processing_seconds")

# Points serve to look at: a mesh's 100,000 vertices, five times a clip, would fill a disk.
_MOST_POINTS = 20_000


def write_submission(run: Path, out: Path, clip: str = "") -> str:
    """Write the run in folder `run` as five equal runs of a clip below `out`, and return the clip's name.

    clip : by default the name of the run's input. Raises `InputError` where `run` is no run's folder, and where one of
    the clip's runs is there already.
    """
    try:
        facts = RunFolder(run).provenance
        seconds, clip = facts["seconds"], clip or Path(facts["input"]).stem
        prepare_s, fuse_s = seconds.get("prepare", 0.0), seconds.get("fuse", 0.0) + seconds.get("check surface", 0.0)
        # The time up to the last pose, the back end included; the mesh comes after it.
        times = zip(RUNTIME_KEYS, (prepare_s, seconds["total"] - prepare_s - fuse_s), strict=True)
    except (InputError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"exporting {run}: it is not the folder of a finished run ({error})") from None
    first, *others = (out / clip / number for number in RUNS)
    try:
        _write_maps(run, first)
        (first / "runtime.txt").write_text("".join(f"{key}={time_s:.3f}\n" for key, time_s in times))
        for folder in others:
            shutil.copytree(first, folder)
    except OSError as error:
        raise InputError(f"cannot write a submission: {error.filename}: {error.strerror}") from None
    return clip


def _write_maps(run: Path, folder: Path) -> None:
    submaps = read_run(run, "mm")
    folder.mkdir(parents=True)
    (folder / "camera_trajectory").mkdir()
    for number, (place, submap) in enumerate(zip(submap_folders(run), (submaps, *submaps.others), strict=True)):
        write_submap(folder / "camera_trajectory" / f"cam_traj_map_{number:03d}.txt", submap)
        file = folder / "3D_maps" / str(number) / "points3D.txt"
        file.parent.mkdir(parents=True)
        rows = _points(place / "mesh.ply", submap)
        np.savetxt(file, rows, fmt="%d %.6f %.6f %.6f %d %d %d %g", header="POINT3D_ID X Y Z R G B ERROR")


def _points(mesh_file: Path, submap: Trajectory) -> np.ndarray:
    """Return rows number x y z r g b error of the mesh's vertices; without a mesh of the camera centres.

    The challenge's evaluation breaks off at a map without points.
    """
    points = submap.positions_mm[submap.tracked]
    colours = np.zeros(points.shape)
    mesh = trimesh.load_mesh(mesh_file, process=False) if mesh_file.is_file() else None
    if mesh is not None and len(mesh.vertices) and isinstance(mesh.visual, trimesh.visual.ColorVisuals):
        points, colours = mesh.vertices, mesh.visual.vertex_colors[:, :3]
    rows = np.linspace(0, len(points) - 1, min(len(points), _MOST_POINTS)).astype(np.int64)
    return np.column_stack([np.arange(1, len(rows) + 1), points[rows], colours[rows], np.zeros(len(rows))])
