"""Stamped poses with a status each, and the files they live in.

A TUM file that we write says its unit and its time base in a `#` line, so that it can be read back without asking:

    # unit: mm; time: s; T_world_camera, OpenCV axes (x right, y down, z forward)
    # time tx ty tz qx qy qz qw

Other people's TUM and KITTI files carry no unit: the caller names it.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.errors import InputError, check_shape
from scopemap.geometry.se3 import orthonormalised

Unit = Literal["mm", "m"]
STATUSES = ("initial", "ok", "lost")
ASSUMED_FRAMES_PER_S = 30.0

_MM_PER_UNIT: dict[Unit, float] = {"mm": 1.0, "m": 1000.0}
_RIGID_TOLERANCE = 1e-2
_SAME_TIME_S = 2e-3


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time; lost frames stay in it.

    Attributes
    ----------
    indices : (N,) int64 frame numbers, ascending.
    times_s : (N,) float64 time stamps, s; index / 30 where the file gave none.
    T_world_camera : (N, 4, 4) float64 camera-to-world, mm, OpenCV axes; a lost frame repeats the last pose.
    status : (N,) of str: "initial", "ok" or "lost".
    has_indices : False where the file gave only times; `indices` then are row numbers and match nothing.
    """

    indices: np.ndarray
    times_s: np.ndarray
    T_world_camera: np.ndarray
    status: np.ndarray
    has_indices: bool = True

    def __post_init__(self) -> None:
        count = len(self.indices)
        check_shape("Trajectory.times_s", self.times_s, (count,))
        check_shape("Trajectory.T_world_camera", self.T_world_camera, (count, 4, 4))
        check_shape("Trajectory.status", self.status, (count,))
        if np.any(np.diff(self.indices) <= 0):
            raise ValueError("Trajectory.indices: expected ascending frame numbers without repetition")
        unknown = sorted(set(np.asarray(self.status).tolist()) - set(STATUSES))
        if unknown:
            raise ValueError(f"Trajectory.status: expected {', '.join(STATUSES)}, got {', '.join(map(repr, unknown))}")

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def tracked(self) -> np.ndarray:
        """(N,) bool, False where the frame is lost."""
        return np.asarray(self.status) != "lost"

    @property
    def positions_mm(self) -> np.ndarray:
        """(N, 3) float64 camera centres."""
        return self.T_world_camera[:, :3, 3]

    @property
    def path_length_mm(self) -> float:
        """Length of the polygon through all camera centres."""
        return path_length_mm(self.positions_mm)

    def rows(self, chosen: np.ndarray) -> Trajectory:
        """Return the trajectory of the rows that `chosen` (bool mask or row numbers) picks."""
        return replace(
            self,
            indices=self.indices[chosen],
            times_s=self.times_s[chosen],
            T_world_camera=self.T_world_camera[chosen],
            status=self.status[chosen],
        )


def path_length_mm(positions_mm: np.ndarray) -> float:
    """Return the length of the polygon through (N, 3) positions."""
    return float(np.linalg.norm(np.diff(positions_mm, axis=0), axis=1).sum())


def write_tum(path: Path, trajectory: Trajectory, *, unit: Unit = "mm") -> None:
    """Write `time tx ty tz qx qy qz qw` lines, time in s with 6 decimals, quaternions with qw >= 0.

    Lost frames are written too. The header says the unit, the time base and the axes.
    """
    quaternions = Rotation.from_matrix(trajectory.T_world_camera[:, :3, :3]).as_quat(canonical=True)
    positions = trajectory.positions_mm / _MM_PER_UNIT[unit]
    lines = [
        f"# unit: {unit}; time: s; T_world_camera, OpenCV axes (x right, y down, z forward)",
        "# time tx ty tz qx qy qz qw",
    ]
    for time_s, numbers in zip(trajectory.times_s, np.hstack([positions, quaternions]), strict=True):
        lines.append(f"{time_s:.6f} " + " ".join(f"{number:.9f}" for number in numbers))
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_kitti(path: Path, trajectory: Trajectory, *, unit: Unit = "mm") -> None:
    """Write the upper (3, 4) of each pose as one row-major line; the form has no room for times, unit or status."""
    rows = trajectory.T_world_camera[:, :3].copy()
    rows[:, :, 3] /= _MM_PER_UNIT[unit]
    lines = [" ".join(f"{number:.12g}" for number in row.ravel()) for row in rows]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_trajectory(path: Path, *, unit: Unit = "mm") -> Trajectory:
    """Read a trajectory from whatever `path` holds, recognised by content.

    A run folder (`trajectory.tum` and `frames.csv`), a C3VD or phantom folder (`pose.txt`), a 7-Scenes folder
    (`frame-*.pose.txt`, metres), or a text file: TUM (8 columns), KITTI (12), C3VD `pose.txt` (16; in its transposed
    form or row-major). `unit` is that of TUM and KITTI files that do not state theirs. TUM time stamps that are all
    integers are frame numbers, unless the header says `time: s`. Raises `InputError` with the line at fault.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path)
    if not path.is_file():
        raise InputError(f"cannot read a trajectory: no file or folder {path}")
    table = _read_numbers(path)
    readers = {8: _from_tum, 12: _from_kitti, 16: _from_matrices}
    columns = table.values.shape[1]
    if columns not in readers:
        raise InputError(
            f"cannot read a trajectory from {path}: its lines hold {columns} numbers; known are 8 (TUM), 12 (KITTI) "
            "and 16 (C3VD pose.txt)"
        )
    return readers[columns](table, unit)


def read_poses(path: Path) -> np.ndarray:
    """Return the camera-to-world poses (N, 4, 4), mm, of a `pose.txt`: 16 numbers a line, by commas or spaces.

    C3VD stores the transposed matrix, its documentation says row-major; which of both a file holds is decided once,
    over all its lines (with no translation at all they look alike: taken as stored). Raises `InputError`.
    """
    return _from_matrices(_read_numbers(Path(path)), "mm").T_world_camera


@dataclass(frozen=True)
class _Table:
    """The numbers of a text file: values (N, C), the line each row stood on, and the comment lines."""

    path: Path
    values: np.ndarray
    line_numbers: list[int]
    comments: str

    def scaled(self, unit: Unit) -> float:
        stated = re.search(r"\bunit:\s*(mm|m)\b", self.comments)
        return _MM_PER_UNIT["m" if (stated[1] if stated else unit) == "m" else "mm"]

    def sorted_by(self, keys: np.ndarray) -> _Table:
        order = np.argsort(keys, kind="stable")
        repeated = np.flatnonzero(np.diff(keys[order]) == 0)
        if repeated.size:
            line = self.line_numbers[order[repeated[0] + 1]]
            raise InputError(f"{self.path}, line {line}: the time stamp of an earlier line comes again; leave one out")
        return replace(self, values=self.values[order], line_numbers=[self.line_numbers[k] for k in order])

    def trajectory(self, T: np.ndarray, indices: np.ndarray | None, times_s: np.ndarray | None = None) -> Trajectory:
        T = _checked_poses(T, [f"{self.path}, line {line}" for line in self.line_numbers])
        return _trajectory(T, indices, times_s)


def _trajectory(T: np.ndarray, indices: np.ndarray | None, times_s: np.ndarray | None = None) -> Trajectory:
    numbers = np.arange(len(T), dtype=np.int64) if indices is None else indices.astype(np.int64)
    times_s = numbers / ASSUMED_FRAMES_PER_S if times_s is None else times_s
    status = np.array(["initial"] + ["ok"] * (len(T) - 1))
    return Trajectory(numbers, times_s, T, status, has_indices=indices is not None)


def _read_numbers(path: Path) -> _Table:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read a trajectory from {path}: {error}") from None
    rows: list[list[float]] = []
    line_numbers: list[int] = []
    for number, line in enumerate(lines, start=1):
        fields = line.partition("#")[0].replace(",", " ").split()
        if not fields:
            continue
        rows.append(_parse_row(fields, f"{path}, line {number}"))
        line_numbers.append(number)
        if len(rows[-1]) != len(rows[0]):
            raise InputError(
                f"{path}, line {number}: found {len(fields)} numbers where earlier lines have {len(rows[0])}"
            )
    if not rows:
        raise InputError(f"cannot read a trajectory from {path}: it holds no pose")
    comments = "\n".join(line for line in lines if line.lstrip().startswith("#"))
    return _Table(path, np.array(rows), line_numbers, comments)


def _parse_row(fields: list[str], where: str) -> list[float]:
    try:
        row = [float(field) for field in fields]
    except ValueError as error:
        raise InputError(f"{where}: expected numbers ({error}); mark comments by '#'") from None
    if not np.all(np.isfinite(row)):
        raise InputError(f"{where}: a pose holds NaN or infinity; leave out frames without a pose")
    return row


def _checked_poses(T: np.ndarray, where: list[str]) -> np.ndarray:
    """Return poses with exact rotations; `InputError` at the first that is no rigid motion."""
    R = T[:, :3, :3]
    deviation = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    bottom = np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1)
    wrong = np.flatnonzero((deviation > _RIGID_TOLERANCE) | (np.linalg.det(R) < 0) | (bottom > _RIGID_TOLERANCE))
    if wrong.size:
        raise InputError(
            f"{where[wrong[0]]}: not a rigid motion (R^T R is off the identity by {deviation[wrong[0]]:.3g}, det R = "
            f"{np.linalg.det(R[wrong[0]]):.3g}); poses must be camera-to-world without scale"
        )
    # Files carry six digits or so: make the rotations exact, as the inverse by transposition needs them.
    return np.stack([orthonormalised(pose) for pose in T])


def _from_tum(table: _Table, unit: Unit) -> Trajectory:
    table = table.sorted_by(table.values[:, 0])
    times, T = _tum_poses(table, unit)
    if re.search(r"\btime:\s*s\b", table.comments) or np.any(times != np.round(times)):
        return table.trajectory(T, None, times)
    return table.trajectory(T, times)


def _tum_poses(table: _Table, unit: Unit) -> tuple[np.ndarray, np.ndarray]:
    times, positions, quaternions = np.split(table.values, [1, 4], axis=1)
    norms = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1.0) > _RIGID_TOLERANCE)
    if wrong.size:
        line = table.line_numbers[wrong[0]]
        raise InputError(f"{table.path}, line {line}: the quaternion has length {norms[wrong[0]]:.3g} instead of 1")
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    T[:, :3, 3] = positions * table.scaled(unit)
    return times[:, 0], T


def _from_kitti(table: _Table, unit: Unit) -> Trajectory:
    T = np.tile(np.eye(4), (len(table.values), 1, 1))
    T[:, :3] = table.values.reshape(-1, 3, 4)
    T[:, :3, 3] *= table.scaled(unit)
    return table.trajectory(T, np.arange(len(T)))


def _from_matrices(table: _Table, unit: Unit) -> Trajectory:
    columns = table.values.shape[1]
    if columns != 16:
        raise InputError(f"{table.path}, line {table.line_numbers[0]}: expected 16 numbers, a matrix, found {columns}")
    T = table.values.reshape(-1, 4, 4)
    if np.allclose(T[:, :3, 3], 0):
        T = np.swapaxes(T, 1, 2)
    elif not np.allclose(T[:, 3, :3], 0):
        raise InputError(f"cannot read poses from {table.path}: neither the last row nor the last column is 0 0 0 1")
    return table.trajectory(T, np.arange(len(T)))


def _read_folder(folder: Path) -> Trajectory:
    if (folder / "trajectory.tum").is_file() and (folder / "frames.csv").is_file():
        return _read_run(folder)
    if (folder / "pose.txt").is_file():
        return read_trajectory(folder / "pose.txt")
    if any(folder.glob("frame-*.pose.txt")):
        return _read_seven_scenes(folder)
    raise InputError(
        f"no trajectory in the folder {folder}: looked for trajectory.tum with frames.csv (a run), pose.txt (C3VD, "
        "phantom) and frame-*.pose.txt (7-Scenes)"
    )


def _read_run(folder: Path) -> Trajectory:
    table = _read_numbers(folder / "trajectory.tum")
    if table.values.shape[1] != 8:
        raise InputError(f"cannot read {table.path}: found {table.values.shape[1]} numbers in a line instead of 8")
    indices, times_s, status = _read_frames(folder / "frames.csv")
    same_run = len(indices) == len(table.values) and np.abs(times_s - table.values[:, 0]).max() <= _SAME_TIME_S
    if not same_run:
        raise InputError(
            f"{folder}: trajectory.tum ({len(table.values)} poses) and frames.csv ({len(indices)} frames) are not of "
            "the same run; run again into an empty folder"
        )
    poses = table.trajectory(_tum_poses(table, "mm")[1], indices, times_s)
    return replace(poses, status=status)


def _read_frames(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    try:
        rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        indices = np.array([int(row["index"]) for row in rows], dtype=np.int64)
        times_s = np.array([float(row["time_s"]) for row in rows])
        status = np.array([row["status"] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"cannot read {path}: every row needs index, time_s and status ({error})") from None
    if np.any(np.diff(indices) <= 0) or not set(status.tolist()) <= set(STATUSES):
        raise InputError(f"cannot read {path}: index must ascend and status be one of {', '.join(STATUSES)}")
    return indices, times_s, status


def _read_seven_scenes(folder: Path) -> Trajectory:
    numbered = sorted((int(re.sub(r"\D", "", path.name)), path) for path in folder.glob("frame-*.pose.txt"))
    tables = [_read_numbers(path) for _, path in numbered]
    for table in tables:
        if table.values.shape != (4, 4):
            raise InputError(f"{table.path}: expected 4 lines of 4 numbers, found {table.values.shape}")
    T = np.stack([table.values for table in tables])
    T[:, :3, 3] *= _MM_PER_UNIT["m"]
    T = _checked_poses(T, [str(table.path) for table in tables])
    return _trajectory(T, np.array([number for number, _ in numbered]))
