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
    """

    kind: str
    read: Reader
    files: tuple[str, ...] = ()
    fits: Callable[[Path], bool] | None = None
    can_be_named: bool = True


_OWN = (
    TrajectoryFormat("run", folders.read_run, ("trajectory.tum",)),
    TrajectoryFormat("tum", text.read_tum),
    TrajectoryFormat("kitti", text.read_kitti),
    TrajectoryFormat("c3vd", text.read_c3vd, ("pose.txt",)),
    TrajectoryFormat("colmap", colmap_poses.read_colmap, colmap_poses.COLMAP_FILES, lambda path: _is_colmap(path)),
)
_COLUMNS: dict[int, Reader] = {8: text.read_tum, 12: text.read_kitti, **dict.fromkeys((16, 17), text.read_c3vd)}


@cache
def _formats() -> tuple[TrajectoryFormat, ...]:
    return (*(known for _, added in plugins("scopemap.trajectory_formats") for known in added), *_OWN)


def trajectory_kinds() -> dict[str, Reader]:
    """Return the readers of all formats, by the name that `read_trajectory` takes as `kind`."""
    return {known.kind: known.read for known in (*_OWN, *_formats()) if known.can_be_named}


def read_trajectory(path: Path | str, *, unit: Unit = "mm", kind: str = "auto") -> Trajectory:
    """Read a trajectory of any format, recognised by its content; its `source` states what was assumed.

    The kinds, their conventions and units are listed in docs/formats.md, "Trajectories". `unit` is that of a file that
    neither states nor fixes one. Raises `InputError` with the line or frame at fault, and where content fits two kinds;
    `SettingsError` for an unknown `kind`.
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
    return (_reader_of_folder(path) if path.is_dir() else _reader_of_file(path))(path, unit)


def holds_trajectory(folder: Path) -> bool:
    """Return whether a folder holds poses in a known format."""
    return any(_holds(folder, known.files) for known in _formats())


def _holds(folder: Path, files: tuple[str, ...]) -> bool:
    return any(found.is_file() for pattern in files for found in folder.glob(pattern))


def _reader_of_folder(folder: Path) -> Reader:
    with_folders = [known for known in _formats() if known.files]
    found = [known for known in with_folders if _holds(folder, known.files)]
    if len(found) == 1:
        return found[0].read
    names = [f"{' or '.join(known.files[:2])} ({known.kind})" for known in found or with_folders]
    if found:
        raise InputError(f"the folder {folder} holds {' and '.join(names)}; name the kind, or the file itself")
    raise InputError(f"no trajectory in the folder {folder}: looked for {', '.join(names)}")


def _reader_of_file(path: Path) -> Reader:
    fitting = next((known.read for known in _formats() if known.fits is not None and known.fits(path)), None)
    if fitting is not None:
        return fitting
    columns = text.read_numbers(path).values.shape[1]
    if columns not in _COLUMNS:
        raise InputError(
            f"cannot read a trajectory from {path}: its lines hold {columns} numbers; known are 8 (TUM), 12 (KITTI) "
            "and 16 or 17 (C3VD pose.txt)"
        )
    return _COLUMNS[columns]


def _is_colmap(path: Path) -> bool:
    first = [line for line in text.text_lines(path) if text.fields_of(line)][:1]
    return bool(first) and is_image_line(first[0])
