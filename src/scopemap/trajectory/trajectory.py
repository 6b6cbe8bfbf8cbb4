"""Stamped camera poses with a status each, and the two forms in which they are written, TUM and KITTI."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.errors import check_shape

Unit = Literal["mm", "m"]
STATUSES = ("initial", "ok", "lost")
SKIPPED = "skipped"
"""Status in frames.csv of a frame that a run left out: it has no line in trajectory.tum."""
ASSUMED_FRAMES_PER_S = 30.0
MM_PER_UNIT: dict[Unit, float] = {"mm": 1.0, "m": 1000.0}


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time; lost frames stay in it.

    indices : (N,) int64 frame numbers, ascending. times_s : (N,) float64, s; index / 30 where the file gave none.
    T_world_camera : (N, 4, 4) float64 camera-to-world, mm, OpenCV axes; a lost frame repeats the last pose.
    status : (N,) of str: "initial", "ok" or "lost".
    has_indices : False where the file gave only times; `indices` then are row numbers and match nothing.
    source : what was read, and the convention and unit that were stated or assumed; empty where nothing was read.
    others : the other submaps, each in a world and a scale of its own.
    """

    indices: np.ndarray
    times_s: np.ndarray
    T_world_camera: np.ndarray
    status: np.ndarray
    has_indices: bool = True
    source: str = ""
    others: tuple[Trajectory, ...] = ()

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
    rows = np.column_stack([trajectory.times_s, trajectory.positions_mm / MM_PER_UNIT[unit], quaternions])
    axes = "T_world_camera, OpenCV axes (x right, y down, z forward)"
    header = f"unit: {unit}; time: s; {axes}\ntime tx ty tz qx qy qz qw"
    np.savetxt(path, rows, fmt=["%.6f"] + ["%.9f"] * 7, header=header)


def write_kitti(path: Path, trajectory: Trajectory, *, unit: Unit = "mm") -> None:
    """Write the upper (3, 4) of each pose as one row-major line; the form has no room for times, unit or status."""
    rows = trajectory.T_world_camera[:, :3].copy()
    rows[:, :, 3] /= MM_PER_UNIT[unit]
    np.savetxt(path, rows.reshape(-1, 12), fmt="%.12g")
