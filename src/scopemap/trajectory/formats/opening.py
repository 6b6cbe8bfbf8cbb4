"""Which reader a file or folder of poses gets: the one that is named, or the only one that its content fits."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from scopemap.cameras.formats.colmap import is_image_line
from scopemap.errors import InputError, SettingsError
from scopemap.trajectory.formats import climb, colmap, folders, scared, splatam, text
from scopemap.trajectory.trajectory import Trajectory, Unit

Reader = Callable[[Path, Unit], Trajectory]

READERS: dict[str, Reader] = {
    "run": folders.read_run,
    "tum": text.read_tum,
    "kitti": text.read_kitti,
    "c3vd": text.read_c3vd,
    "7-scenes": folders.read_seven_scenes,
    "scared": scared.read_scared,
    "oneslam": text.read_oneslam,
    "bodyslam": text.read_kitti,
    "endogslam": partial(splatam.read_params, split="train"),
    "splatam": partial(splatam.read_params, split="all"),
    "open3d": text.read_open3d,
    "endo-depth": text.read_endo_depth,
    "colmap": colmap.read_colmap,
    "climb": climb.read_climb,
}
KINDS = ("auto", *READERS)

_COLUMNS: dict[int, Reader] = {8: text.read_tum, 12: text.read_kitti, 16: text.read_c3vd}


def read_trajectory(path: Path | str, *, unit: Unit = "mm", kind: str = "auto") -> Trajectory:
    """Read a trajectory of any format, recognised by its content; its `source` states what was assumed.

    The kinds, their conventions and units are listed in docs/formats.md, "Trajectories". `unit` is that of a file that
    neither states nor fixes one. Raises `InputError` with the line or frame at fault, and where content fits two kinds;
    `SettingsError` for an unknown `kind`.
    """
    if kind not in KINDS:
        raise SettingsError(f"unknown kind of trajectory '{kind}'; known are {', '.join(KINDS)}")
    path = Path(path)
    # Path.exists raises for names that no file system allows.
    if not os.path.exists(path):
        raise InputError(f"cannot read a trajectory: no file or folder {path}")
    if not path.is_dir() and not path.is_file():  # a pipe would be waited for
        raise InputError(f"cannot read a trajectory: {path} is no file and no folder")
    if kind != "auto":
        return READERS[kind](path, unit)
    return (_reader_of_folder(path) if path.is_dir() else _reader_of_file(path))(path, unit)


def holds_trajectory(folder: Path) -> bool:
    """Return whether a folder holds poses in a known format."""
    return any(_holds(folder, files) for _, files, _ in _FOLDERS)


def _refuse_log(path: Path, unit: Unit) -> Trajectory:
    path = path / text.LOG_FILE if path.is_dir() else path
    raise InputError(
        f"cannot tell which way the poses of {path} point: name the kind, 'open3d' (camera-to-world, as Open3D writes "
        "them) or 'endo-depth' (world-to-camera in metres, as Endo-Depth-and-Motion does)"
    )


# Kind, files of which a folder holds one, and what reads it.
_FOLDERS: tuple[tuple[str, tuple[str, ...], Reader], ...] = (
    ("run", ("trajectory.tum",), folders.read_run),
    ("c3vd", ("pose.txt",), text.read_c3vd),
    ("7-scenes", ("frame-*.pose.txt",), folders.read_seven_scenes),
    ("scared", scared.SCARED_FILES, scared.read_scared),
    ("oneslam", text.ONESLAM_FILES, text.read_oneslam),
    ("endogslam, splatam", (splatam.PARAMS_FILE,), splatam.read_params),
    ("open3d, endo-depth", (text.LOG_FILE,), _refuse_log),
    ("colmap", colmap.COLMAP_FILES, colmap.read_colmap),
    ("climb", climb.CLIMB_FILES, climb.read_climb),
)


def _holds(folder: Path, files: tuple[str, ...]) -> bool:
    return any(found.is_file() for pattern in files for found in folder.glob(pattern))


def _reader_of_folder(folder: Path) -> Reader:
    found = [(kind, files, reader) for kind, files, reader in _FOLDERS if _holds(folder, files)]
    if len(found) == 1:
        return found[0][2]
    names = [f"{' or '.join(files[:2])} ({kind})" for kind, files, _ in found or _FOLDERS]
    if found:
        raise InputError(f"the folder {folder} holds {' and '.join(names)}; name the kind, or the file itself")
    raise InputError(f"no trajectory in the folder {folder}: looked for {', '.join(names)}")


def _reader_of_file(path: Path) -> Reader:
    if zipfile.is_zipfile(path):
        return splatam.read_params
    if scared.find_frame_data(path) is not None:
        return scared.read_scared
    lines = text.text_lines(path)
    first = [line for line in lines if text.fields_of(line)][:2]
    if [len(text.fields_of(line)) for line in first] == [3, 4]:
        return _refuse_log
    if first and is_image_line(first[0]):
        return colmap.read_colmap
    if any(line.startswith("#") and "frame_index" in line for line in lines[:2]):
        return text.read_oneslam
    columns = text.read_numbers(path).values.shape[1]
    if columns not in _COLUMNS:
        raise InputError(
            f"cannot read a trajectory from {path}: its lines hold {columns} numbers; known are 8 (TUM), 12 (KITTI) "
            "and 16 (C3VD pose.txt)"
        )
    return _COLUMNS[columns]
