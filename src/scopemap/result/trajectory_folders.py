"""Folders of our own runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.input.trajectory.text import read_numbers, tum_poses
from scopemap.input.trajectory.trajectory import Trajectory, Unit
from scopemap.result.frame_table import FrameTable

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
    first, *others = (
        replace(frames.trajectory, source=f"run of scopemap, camera-to-world, {words}")
        for frames, words in map(read_frames, submap_folders(folder))
    )
    return replace(first, others=tuple(others))


def read_frames(folder: Path) -> tuple[FrameTable, str]:
    """Return the table of a run's or submap's frames with their poses, mm, and the unit of the file in words.

    Raises `InputError` where its files are missing, damaged, or not of one run.
    """
    poses = read_numbers(folder / "trajectory.tum").as_tum("TUM")
    frames = FrameTable.read(folder / "frames.csv")
    tracked = frames.tracked
    if len(poses.values) == len(frames.trajectory):
        poses = poses.rows(frames.trajectory.tracked)
    stamps_s = frames["time_s"][tracked]
    same_run = len(stamps_s) == len(poses.values) and np.abs(stamps_s - poses.values[:, 0]).max() <= _SAME_TIME_S
    if not same_run:
        raise InputError(
            f"{folder}: trajectory.tum ({len(poses.values)} poses) and frames.csv ({len(stamps_s)} tracked frames) are "
            "not of the same run; run again into an empty folder"
        )
    T, words = tum_poses(poses, "mm")
    frames.rows["T_world_camera"][tracked] = T
    return frames, words
