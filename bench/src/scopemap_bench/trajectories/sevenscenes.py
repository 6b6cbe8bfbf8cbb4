"""Poses of 7-Scenes: a file of 4 lines per frame, camera-to-world, metres.

Shotton et al., "Scene coordinate regression forests for camera relocalization in RGB-D images", CVPR 2013.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.trajectory.formats.poses import rigid, stamped
from scopemap.trajectory.formats.text import read_numbers
from scopemap.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit


def read_seven_scenes(folder: Path, unit: Unit) -> Trajectory:
    """Read `frame-NNNNNN.pose.txt` files, always metres; the number in the name is the frame's."""
    numbered = sorted((int(re.sub(r"\D", "", path.name)), path) for path in folder.glob("frame-*.pose.txt"))
    if not numbered:
        raise InputError(f"cannot read a trajectory from {folder}: looked for frame-*.pose.txt")
    poses = []
    for _, path in numbered:
        pose = read_seven_scenes_pose(path)
        if pose is None:
            raise InputError(f"{path}: a pose holds NaN or infinity; leave out frames without a pose")
        poses.append(pose)
    return stamped(np.stack(poses), np.array([number for number, _ in numbered]), None, "7-Scenes, camera-to-world, m")


def read_seven_scenes_pose(file: Path) -> np.ndarray | None:
    """Return the camera-to-world pose (4, 4), mm, of one file; None where tracking lost it (NaN or infinity)."""
    table = read_numbers(file, missing=True)
    if table.values.size != 16:
        raise InputError(f"reading {file}: expected 4x4 numbers, found {table.values.shape}")
    if not np.isfinite(table.values).all():
        return None
    T = table.values.reshape(4, 4).copy()
    T[:3, 3] *= MM_PER_UNIT["m"]
    return rigid(T[None], [str(file)])[0]
