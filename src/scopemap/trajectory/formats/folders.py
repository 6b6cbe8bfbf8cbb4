"""Folders of our own runs."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.errors import InputError, reporting
from scopemap.trajectory.formats.poses import stamped
from scopemap.trajectory.formats.text import read_numbers, tum_poses
from scopemap.trajectory.trajectory import ROTATION_ONLY, SKIPPED, STATUSES, TRACKED, Trajectory, Unit

_SAME_TIME_S = 2e-3


def submap_folders(run: Path) -> list[Path]:
    """Return the folders of a run's submaps, its own first, then `maps/1`, `maps/2`, ..."""
    found = [file.parent for file in run.glob("maps/*/trajectory.tum") if file.parent.name.isdecimal()]
    return [run, *sorted(found, key=lambda folder: int(folder.name))]


def read_run(folder: Path, unit: Unit) -> Trajectory:
    """Read `trajectory.tum` and `frames.csv` of a run and its submaps, always mm, with frame numbers.

    Frames without a pose in `trajectory.tum` stay in it by their status; those that the run skipped are left out. Runs
    of earlier versions, with a line for each lost frame, are read, too.
    """
    first, *others = map(_read_run_submap, submap_folders(folder))
    return replace(first, others=tuple(others))


def _read_run_submap(folder: Path) -> Trajectory:
    table = read_numbers(folder / "trajectory.tum").with_columns(8, "TUM")
    path = folder / "frames.csv"
    with reporting(f"cannot read {path}: every row needs index, time_s and status"):
        if not path.is_file():  # a pipe would be waited for
            raise FileNotFoundError("there is no such file")
        # Names of files may hold what Python takes for the end of a line.
        with path.open(newline="", encoding="utf-8") as lines:
            rows = [row for row in csv.DictReader(lines) if row["status"] != SKIPPED]
        indices = np.array([int(row["index"]) for row in rows], dtype=np.int64)
        times_s = np.array([float(row["time_s"]) for row in rows])
        status = np.array([row["status"] for row in rows])
    if np.any(np.diff(indices) <= 0) or not set(status.tolist()) <= set(STATUSES):
        raise InputError(f"cannot read {path}: index must ascend and status be one of {', '.join(STATUSES)}")
    tracked = np.isin(status, TRACKED)
    if len(table.values) == len(indices):
        table = table.rows(tracked)
    stamps_s = times_s[tracked]
    same_run = len(stamps_s) == len(table.values) and np.abs(stamps_s - table.values[:, 0]).max() <= _SAME_TIME_S
    if not same_run:
        raise InputError(
            f"{folder}: trajectory.tum ({len(table.values)} poses) and frames.csv ({len(stamps_s)} tracked frames) are "
            "not of the same run; run again into an empty folder"
        )
    poses, words = tum_poses(table, "mm")
    T = np.full((len(indices), 4, 4), np.nan)
    T[tracked] = poses
    found = replace(stamped(T, indices, times_s, f"run of scopemap, camera-to-world, {words}"), status=status)
    for place in np.flatnonzero(status == ROTATION_ONLY):
        with reporting(f"cannot read {path}: the orientation of frame {indices[place]} is no quaternion"):
            quaternion = [float(number) for number in rows[place]["orientation"].split()]
            found.T_world_camera[place, :3, :3] = Rotation.from_quat(quaternion).as_matrix()
    return found
