"""Which reader a file or folder of poses gets: the one that is named, or the only one that its content fits."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from scopemap.engine.errors import InputError, SettingsError
from scopemap.input.camera_files.colmap_model import is_image_line
from scopemap.input.plugins import plugins
from scopemap.input.trajectory import colmap_poses, text
from scopemap.input.trajectory.trajectory import Trajectory, Unit
from scopemap.result import trajectory_folders as folders

Reader = Callable[[Path, Unit], Trajectory]


@dataclass(frozen=True)
class TrajectoryFormat:
    """A format of trajectories.

    kind : its name. read : its reader. files : patterns, of which a folder in this format holds one.
    fits : whether a file has this format by its content; None where that does not tell. can_be_named : as `kind`.
    unit : of lengths where neither the file nor the caller states one.
    """

    kind: str
    read: Reader
    files: tuple[str, ...] = ()
    fits: Callable[[Path], bool] | None = None
    can_be_named: bool = True
    unit: Unit = "mm"

    def __call__(self, path: Path, unit: Unit | None) -> Trajectory:
        """Read a file or folder; `unit` None: the format's."""
        return self.read(path, unit or self.unit)


_OWN = (
    TrajectoryFormat("run", folders.read_run, ("trajectory.tum",)),
    # TUM, KITTI and EuRoC are metres by their definitions (docs/formats.md).
    TrajectoryFormat("tum", text.read_tum, unit="m"),
    TrajectoryFormat("kitti", text.read_kitti, unit="m"),
    TrajectoryFormat("euroc", text.read_euroc, text.EUROC_FILES, unit="m"),
    TrajectoryFormat("c3vd", text.read_c3vd, ("pose.txt",)),
    TrajectoryFormat("colmap", colmap_poses.read_colmap, colmap_poses.COLMAP_FILES, lambda path: _is_colmap(path)),
)
_COLUMNS = {8: "tum", 12: "kitti", 16: "c3vd", 17: "c3vd"}


@cache
def _formats() -> tuple[TrajectoryFormat, ...]:
    return (*(known for _, added in plugins("scopemap.trajectory_formats") for known in added), *_OWN)


def trajectory_kinds() -> dict[str, TrajectoryFormat]:
    """Return all formats, by the name that `read_trajectory` takes as `kind`."""
    return {known.kind: known for known in (*_OWN, *_formats()) if known.can_be_named}


def read_trajectory(path: Path | str, *, unit: Unit | None = None, kind: str = "auto") -> Trajectory:
    """Read a trajectory of any format, recognised by its content; its `source` states what was assumed.

    The kinds, their conventions and units are listed in docs/formats.md, "Trajectories". `unit` is that of a file that
    neither states nor fixes one; None: the usual one of its format, m for TUM, KITTI and EuRoC. Raises `InputError`
    with the line or frame at fault, and where content fits two kinds; `SettingsError` for an unknown `kind`.
    """
    kinds = trajectory_kinds()
    if kind not in ("auto", *kinds):
        raise SettingsError(f"unknown kind of trajectory '{kind}'; known are {', '.join(('auto', *kinds))}")
    path = Path(path)
    # Path.exists raises for names that no file system allows.
    if not os.path.exists(path):
        raise InputError(f"cannot read a trajectory: no file or folder {path}")
    if not path.is_dir() and not path.is_file():  # a pipe would be waited for
        raise InputError(f"cannot read a trajectory: {path} is no file and no folder")
    if kind != "auto":
        return kinds[kind](path, unit)
    return (_format_of_folder(path) if path.is_dir() else _format_of_file(path))(path, unit)


def holds_trajectory(folder: Path) -> bool:
    """Return whether a folder holds poses in a known format."""
    return any(_holds(folder, known.files) for known in _formats())


def _holds(folder: Path, files: tuple[str, ...]) -> bool:
    return any(found.is_file() for pattern in files for found in folder.glob(pattern))


def _format_of_folder(folder: Path) -> TrajectoryFormat:
    with_folders = [known for known in _formats() if known.files]
    found = [known for known in with_folders if _holds(folder, known.files)]
    if len(found) == 1:
        return found[0]
    names = [f"{' or '.join(known.files[:2])} ({known.kind})" for known in found or with_folders]
    if found:
        raise InputError(f"the folder {folder} holds {' and '.join(names)}; name the kind, or the file itself")
    raise InputError(f"no trajectory in the folder {folder}: looked for {', '.join(names)}")


def _format_of_file(path: Path) -> TrajectoryFormat:
    fitting = next((known for known in _formats() if known.fits is not None and known.fits(path)), None)
    if fitting is not None:
        return fitting
    table = text.read_numbers(path)
    columns = table.values.shape[1]
    if columns not in _COLUMNS and table.columns is None:
        raise InputError(
            f"cannot read a trajectory from {path}: its lines hold {columns} numbers; known are 8 (TUM), 12 (KITTI), "
            "16 or 17 (C3VD pose.txt) and 17 (EuRoC), or a header that names time, position and quaternion"
        )
    named = table.columns is not None
    return trajectory_kinds()["tum" if named else "euroc" if text.is_euroc(table) else _COLUMNS[columns]]


def _is_colmap(path: Path) -> bool:
    first = [line for line in text.text_lines(path) if text.fields_of(line)][:1]
    return bool(first) and is_image_line(first[0])
