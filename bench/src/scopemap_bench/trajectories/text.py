"""Text files of poses that OneSLAM, Open3D and Endo-Depth-and-Motion write, and those of 7-Scenes.

OneSLAM (github.com/arcadelab/OneSLAM, slam.py) writes its keyframes to `poses_pred.txt`, as TUM rows camera-to-world
under `# frame_index tx ty tz qx qy qz qw`; its data sets hold `poses_gt.txt` in that form. A `.log` has a line of three
integers per pose, then its 4x4 matrix (redwood-data.org/indoor/fileformat.html): Open3D writes camera-to-world,
Endo-Depth-and-Motion (UZ-SLAMLab) world-to-camera in metres, so that its kind must be named. 7-Scenes (Shotton et al.,
CVPR 2013) has a file of 4 lines per frame, camera-to-world, metres.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import inverse
from scopemap.input.trajectory.columns import are_frame_numbers
from scopemap.input.trajectory.poses import file_of, rigid, stamped
from scopemap.input.trajectory.text import fields_of, read_numbers, read_rows, text_lines, tum_poses
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

LOG_FILE = "trajectory.log"
ONESLAM_FILES = ("poses_pred.txt", "poses_gt.txt")


def is_oneslam(path: Path) -> bool:
    """Return whether a file has OneSLAM's comment."""
    return any(line.startswith("#") and "frame_index" in line for line in text_lines(path)[:2])


def is_log(path: Path) -> bool:
    """Return whether a file begins as a log does."""
    first = [fields for line in text_lines(path) if (fields := fields_of(line))][:2]
    return [len(fields) for fields in first] == [3, 4]


def refuse_log(path: Path, unit: Unit) -> Trajectory:
    """Raise `InputError`: a log does not state the direction of its poses."""
    path = path / LOG_FILE if path.is_dir() else path
    raise InputError(
        f"cannot tell which way the poses of {path} point: name the kind, 'open3d' (camera-to-world, as Open3D writes "
        "them) or 'endo-depth' (world-to-camera in metres, as Endo-Depth-and-Motion does)"
    )


def read_oneslam(path: Path, unit: Unit) -> Trajectory:
    """Read the keyframes of a OneSLAM run, or the `poses_gt.txt` of a data set in its layout."""
    table = read_numbers(file_of(path, ONESLAM_FILES)).as_tum("OneSLAM").sorted_by_stamp()
    stamps, (T, words) = table.values[:, 0], tum_poses(table, unit)
    if not are_frame_numbers(stamps):
        raise InputError(f"{table.path}: OneSLAM stamps poses by frame number; with seconds the kind is 'tum'")
    return stamped(T, stamps, None, f"OneSLAM, TUM rows by frame number, camera-to-world, {words}")


def read_open3d(path: Path, unit: Unit) -> Trajectory:
    """Read a log of camera-to-world poses, in `unit`; its first integers are the frames' numbers where they ascend."""
    T, indices = _read_log(file_of(path, (LOG_FILE,)), unit)
    return stamped(T, indices, None, f"Open3D log, camera-to-world, {unit} (assumed)")


def read_endo_depth(path: Path, unit: Unit) -> Trajectory:
    """Read a log of Endo-Depth-and-Motion: world-to-camera, always metres."""
    T, indices = _read_log(file_of(path, (LOG_FILE,)), "m")
    return stamped(inverse(T), indices, None, "Endo-Depth-and-Motion log, world-to-camera inverted, m")


def _read_log(path: Path, unit: Unit) -> tuple[np.ndarray, np.ndarray]:
    rows = read_rows(path)
    heads = rows[::5]
    if [len(numbers) for _, numbers in rows] != [3, 4, 4, 4, 4] * len(heads):
        raise InputError(f"reading {path}: a log has lines of 3, 4, 4, 4 and 4 numbers for each pose")
    T = np.array([numbers for row, (_, numbers) in enumerate(rows) if row % 5]).reshape(-1, 4, 4)
    T[:, :3, 3] *= MM_PER_UNIT[unit]
    indices = np.array([numbers[0] for _, numbers in heads])
    ascend = are_frame_numbers(indices) and bool(np.all(np.diff(indices) > 0))
    return rigid(T, [f"{path}, line {line}" for line, _ in heads]), indices if ascend else np.arange(len(T))


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
