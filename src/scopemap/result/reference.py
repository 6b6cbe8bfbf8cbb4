"""The true trajectory of a sequence, for scores: no image is decoded and no depth is read for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError, ScopemapError
from scopemap.input.opening import open_source, readers
from scopemap.input.sequence import Sequence
from scopemap.input.source import Source
from scopemap.input.trajectory.trajectory import Trajectory, Unit
from scopemap.result.trajectories import holds_trajectory, read_trajectory, trajectory_kinds


def read_reference(path: Path | str, *, unit: Unit | None = None, kind: str = "auto") -> Trajectory | None:
    """Return the true poses of a data set's sequence, or of a trajectory file or folder; None where there are none.

    A folder is read as a data set first: its reader defines the camera of the poses. `unit` and `kind` are those
    of `read_trajectory` and call for a trajectory; `kind` may be the name of a data set's reader, too. Raises
    `InputError` where `path` is neither, `SettingsError` for an unknown `kind`.
    """
    path = Path(path)
    is_trajectory = not path.is_dir() or holds_trajectory(path)
    asked_for = kind in trajectory_kinds() or (kind == "auto" and unit == "m")
    if not path.is_dir() or (is_trajectory and asked_for) or kind not in ("auto", *readers()):
        return read_trajectory(path, unit=unit, kind=kind)
    try:
        # Poses need no camera: one that does not fit takes nothing from them.
        source = open_source(path, dataset=None if kind == "auto" else kind)
        reference = _true_poses(source, slice(None))
    except ScopemapError as fault:
        if is_trajectory:
            return read_trajectory(path, unit=unit, kind=kind)
        raise InputError(f"no true poses in {path}: no trajectory was recognised, and as a data set: {fault}") from None
    if reference is None:
        return read_trajectory(path, unit=unit, kind=kind) if is_trajectory else None
    return replace(reference, source=f"data set {source.name}, camera-to-world, mm")


def reference_trajectory(sequence: Sequence) -> Trajectory | None:
    """Return the true poses of the sequence's selected frames; None where none, or not which frames, are known.

    `indices` and `times_s` are those of the frames, unreadable ones included; a frame without a true pose is left out.
    Raises `InputError` for unreadable poses.
    """
    return _true_poses(sequence.source, sequence.selection)


def _true_poses(source: Source, selection: slice) -> Trajectory | None:
    stamped = [(*stamp, source.pose(stamp[0])) for stamp in source.stamps(selection) or []]
    known = [(index, time_s, pose) for index, time_s, pose in stamped if pose is not None]
    if not known:
        return None
    indices, times_s, poses = zip(*known, strict=True)
    status = np.array(["initial"] + ["ok"] * (len(known) - 1))
    return Trajectory(np.array(indices, dtype=np.int64), np.array(times_s, dtype=np.float64), np.stack(poses), status)
