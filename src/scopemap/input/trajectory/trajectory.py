"""Stamped camera poses with a status each, and the two forms in which they are written, TUM and KITTI."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import check_shape

Unit = Literal["mm", "m"]
OTHER_MAP: Final = "other-map"
"""Status of a frame that was tracked, in another submap than the one asked about: it has no pose in this one."""
ROTATION_ONLY: Final = "rotation-only"
"""Status of a frame that is lost but for its rotation, since a wall fills the picture: it has no position."""
TRACKED = ("initial", "ok")
STATUSES = (*TRACKED, "lost", OTHER_MAP, ROTATION_ONLY)
SKIPPED = "skipped"
"""Status in frames.csv of a frame that a run left out; such a frame is in no trajectory."""
ASSUMED_FRAMES_PER_S = 30.0
MM_PER_UNIT: dict[Unit, float] = {"mm": 1.0, "m": 1000.0}


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time; frames without a pose stay in it.

    indices : (N,) int64 frame numbers, ascending. times_s : (N,) float64, s; index / 30 where the file gave none.
    T_world_camera : (N, 4, 4) float64 camera-to-world, mm, OpenCV axes; NaN where the frame is not tracked, but for
        the rotation where that was followed.
    status : (N,) of str: "initial", "ok", "lost", "other-map" for a frame that is tracked in another submap, or
        "rotation-only" for one that is lost but for its rotation.
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
        """(N,) bool, False where the frame is lost or in another submap."""
        return np.isin(self.status, TRACKED)

    @property
    def positions_mm(self) -> np.ndarray:
        """(N, 3) float64 camera centres; NaN where the frame is not tracked."""
        return self.T_world_camera[:, :3, 3]

    @property
    def path_length_mm(self) -> float:
        """Length of the polygon through the camera centres of the tracked frames."""
        return path_length_mm(self.positions_mm[self.tracked])

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


def write_tum(path: Path, trajectory: Trajectory, *, unit: Unit = "mm", comment: str = "") -> None:
    """Write `time tx ty tz qx qy qz qw` lines, time in s with 6 decimals, quaternions with qw >= 0.

    Tracked frames only, as SLAM systems do. The header says the world, the convention, the unit and the time base, then
    `comment`.
    """
    tracked = trajectory.rows(trajectory.tracked)
    rows = np.empty((len(tracked), 8))
    rows[:, 0], rows[:, 1:4] = tracked.times_s, tracked.positions_mm / MM_PER_UNIT[unit]
    if len(rows):
        rows[:, 4:] = Rotation.from_matrix(tracked.T_world_camera[:, :3, :3]).as_quat(canonical=True)
    frames = f"{len(rows)} tracked frames of {len(trajectory)}; a frame without a line has no pose"
    axes = "pose: camera-to-world (T_world_camera); axes: OpenCV (x right, y down, z forward)"
    lines = [frames, axes, f"unit: {unit}; time: s", *([comment] if comment else []), "time tx ty tz qx qy qz qw"]
    np.savetxt(path, rows, fmt=["%.6f"] + ["%.9f"] * 7, header="\n".join(lines))


def numbers_file(path: Path) -> Path:
    """Return the file beside one of poses that states the frame of each line: `poses.frames.txt` of `poses.txt`."""
    return path.with_name(f"{path.stem}.frames.txt")


def write_kitti(path: Path, trajectory: Trajectory, *, unit: Unit = "mm") -> None:
    """Write the upper (3, 4) of each pose as one row-major line; the form has no room for times, unit or status.

    A frame without a pose is a line of NaN: the number of a line is the frame's.
    """
    rows = trajectory.T_world_camera[:, :3].copy()
    rows[:, :, 3] /= MM_PER_UNIT[unit]
    np.savetxt(path, rows.reshape(-1, 12), fmt="%.12g")
