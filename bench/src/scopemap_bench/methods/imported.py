"""ImportedTrajectory: a trajectory file of another system, scored as a run of this one."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.evaluation.poses import associate
from scopemap.input.sequence import Sequence
from scopemap.input.trajectory.trajectory import TRACKED, Trajectory, write_tum
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.plan import MethodPlan


class ImportedTrajectory:
    """Reads the file of a sequence and seed, as `plan.files` names it; frames without a pose in it are lost."""

    def __init__(self, plan: MethodPlan, data: Path | None, name: str, seed: int) -> None:
        self._plan, self._name = plan, plan.files.format(sequence=name, seed=seed)
        self._file = None if data is None else data / self._name

    def missing(self, settings: Mapping[str, Any]) -> str:
        """Return the file that is not in the data folder."""
        return "" if self._file is not None and self._file.exists() else f"not supplied: {self._name}"

    def run(self, sequence: Sequence, settings: Mapping[str, Any], out: Path) -> dict[str, float]:
        """Write the trajectory as a run's folder; its time is unknown."""
        file = self._file or Path(self._name)
        read = read_trajectory(file, unit=self._plan.unit, kind=self._plan.kind)
        write_trajectory(read, sequence, out, str(file))
        return {}


def write_trajectory(read: Trajectory, sequence: Sequence, out: Path, imported: str) -> None:
    """Write a trajectory and its `others` as a run's folder; imported : from what. `InputError`: no frame's."""
    frames = [(frame.index, frame.time_s, frame.name) for frame in sequence.frames()]
    indices, times_s = np.array([f[0] for f in frames]), np.array([f[1] for f in frames])
    submaps = [on_frames(submap, indices, times_s) for submap in (read, *read.others)]
    submaps = [submap for submap in submaps if submap.tracked.any()]
    if not submaps:
        raise InputError(f"{imported}: none of its {len(read)} poses belongs to a frame of {sequence.path}")
    for number, submap in enumerate(submaps):
        folder = out / f"maps/{number}" if number else out
        folder.mkdir(parents=True, exist_ok=True)
        write_tum(folder / "trajectory.tum", submap)
        with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as table:
            writer = csv.writer(table)
            writer.writerow(["index", "time_s", "name", "status", "map"])
            for (index, time_s, name), status in zip(frames, submap.status.tolist(), strict=True):
                tracked = status in TRACKED
                if tracked or number == 0:
                    writer.writerow([index, f"{time_s:.6f}", name, status, number if tracked else ""])
    facts = {"input": str(sequence.path), "imported": imported, "convention": read.source}
    (out / "provenance.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")


def on_frames(trajectory: Trajectory, indices: np.ndarray, times_s: np.ndarray) -> Trajectory:
    """Return the trajectory at the frames (N,), matched by number, else by time; frames without a pose are lost."""
    frames = Trajectory(indices, times_s, np.full((len(indices), 4, 4), np.nan), np.full(len(indices), "lost"))
    known = trajectory.rows(trajectory.tracked)
    rows_known, rows = associate(known, frames)
    status, T_world_camera = np.full(len(indices), "lost", dtype="<U9"), frames.T_world_camera.copy()
    status[rows], status[rows[:1]] = "ok", "initial"
    T_world_camera[rows] = known.T_world_camera[rows_known]
    return Trajectory(indices, times_s, T_world_camera, status)
