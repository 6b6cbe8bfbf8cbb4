"""Which reader a file or folder of poses gets: the one that is named, or the only one that its content fits."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from pathlib import Path

from scopemap.errors import InputError, SettingsError
from scopemap.trajectory.formats import colmap, folders, open3d_log, scared, splatam, text
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
    "bodyslam": text.read_bodyslam,
    "endogslam": splatam.read_endogslam,
    "splatam": splatam.read_splatam,
    "open3d": open3d_log.read_open3d,
    "endo-depth": open3d_log.read_endo_depth,
    "colmap": colmap.read_colmap,
}
KINDS = ("auto", *READERS)

_COLUMNS: dict[int, Reader] = {8: text.read_tum, 12: text.read_kitti, 16: text.read_c3vd}
# A name in words, whether a folder holds it, and what reads it.
_FOLDERS: tuple[tuple[str, Callable[[Path], bool], Reader], ...] = (
    (
        "trajectory.tum with frames.csv (run)",
        lambda f: (f / "trajectory.tum").is_file() and (f / "frames.csv").is_file(),
        folders.read_run,
    ),
    ("pose.txt (c3vd)", lambda f: (f / "pose.txt").is_file(), text.read_c3vd),
    ("frame-*.pose.txt (7-scenes)", lambda f: any(f.glob("frame-*.pose.txt")), folders.read_seven_scenes),
    (
        "frame_data*.json or frame_data.tar.gz (scared)",
        lambda f: scared.find_scared(f) is not None,
        scared.read_scared,
    ),
    (
        "poses_pred.txt or poses_gt.txt (oneslam)",
        lambda f: any((f / name).is_file() for name in text.ONESLAM_FILES),
        text.read_oneslam,
    ),
    ("params.npz (endogslam, splatam)", lambda f: (f / splatam.PARAMS_FILE).is_file(), splatam.read_params),
    (
        "trajectory.log (open3d, endo-depth)",
        lambda f: (f / open3d_log.LOG_FILE).is_file(),
        lambda f, unit: _refuse_log(f / open3d_log.LOG_FILE),
    ),
    (
        "images.txt (colmap)",
        lambda f: any((f / name).is_file() for name in colmap.COLMAP_FILES),
        colmap.read_colmap,
    ),
)


def read_trajectory(path: Path, *, unit: Unit = "mm", kind: str = "auto") -> Trajectory:
    """Read a trajectory from whatever `path` holds, recognised by content; its `source` says what was assumed.

    | kind | file or folder | pose as stored | unit |
    |---|---|---|---|
    | run | folder with `trajectory.tum` and `frames.csv` | camera-to-world | mm |
    | tum | 8 columns | camera-to-world | stated in a `#` line, else `unit` |
    | kitti, bodyslam | 12 columns | camera-to-world | stated, else `unit` |
    | c3vd | `pose.txt`, 16 columns, transposed or row-major | camera-to-world | mm |
    | 7-scenes | folder of `frame-*.pose.txt` | camera-to-world | m |
    | scared | `frame_data*.json`, or `frame_data.tar.gz`, in a folder | world-to-camera | mm |
    | oneslam | `poses_pred.txt`, TUM rows by frame number | camera-to-world | `unit` |
    | endogslam, splatam | `params.npz` | world-to-camera | `unit` |
    | open3d | `trajectory.log` | camera-to-world | `unit` |
    | endo-depth | `trajectory.log` of Endo-Depth-and-Motion | world-to-camera | m |
    | colmap | `images.txt` | world-to-camera | `unit` |

    "m" and "mm" in the table are fixed. TUM time stamps that are all integers below 1e9 are frame numbers, unless the
    header says `time: s`. Where content fits two readings, the error asks for `kind`. Raises `InputError` with the line
    or frame at fault, `SettingsError` for an unknown `kind`.
    """
    path = Path(path)
    if kind not in KINDS:
        raise SettingsError(f"unknown kind of trajectory '{kind}'; known are {', '.join(KINDS)}")
    # Path.exists raises for names that no file system allows.
    if not os.path.exists(path):
        raise InputError(f"cannot read a trajectory: no file or folder {path}")
    _refuse_pickle(path)
    if kind != "auto":
        return READERS[kind](path, unit)
    return (_reader_of_folder(path) if path.is_dir() else _reader_of_file(path))(path, unit)


def holds_trajectory(folder: Path) -> bool:
    """Whether a folder holds poses in a form that is recognised."""
    return any(holds(folder) for _, holds, _ in _FOLDERS)


def _reader_of_folder(folder: Path) -> Reader:
    found = [(name, reader) for name, holds, reader in _FOLDERS if holds(folder)]
    if not found:
        raise InputError(
            f"no trajectory in the folder {folder}: looked for {', '.join(name for name, _, _ in _FOLDERS)}"
        )
    if len(found) > 1:
        names = " and ".join(name for name, _ in found)
        raise InputError(f"the folder {folder} holds {names}; say which kind is meant, or name the file itself")
    return found[0][1]


def _reader_of_file(path: Path) -> Reader:
    if zipfile.is_zipfile(path):
        return splatam.read_params
    if scared.find_scared(path) is not None:
        return scared.read_scared
    lines = text.text_lines(path)
    first = [line for line in lines if text.fields_of(line)][:2]
    widths = [len(text.fields_of(line)) for line in first]
    if widths == [3, 4]:
        return lambda file, unit: _refuse_log(file)
    if first and colmap.is_image_line(first[0]):
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


def _refuse_log(path: Path) -> Trajectory:
    raise InputError(
        f"cannot tell which way the poses of {path} point: say kind 'open3d' (camera-to-world, as Open3D writes them) "
        "or 'endo-depth' (world-to-camera in metres, as Endo-Depth-and-Motion does)"
    )


def _refuse_pickle(path: Path) -> None:
    if not path.is_file():
        return
    with path.open("rb") as file:
        start = file.read(2)
    pickled = len(start) == 2 and start[0] == 0x80 and 2 <= start[1] <= 5
    if pickled or path.suffix in (".pkl", ".pickle"):
        raise InputError(
            f"cannot read a trajectory from {path}: it is a Python pickle, which may run any code when it is loaded; "
            "write its poses as TUM or KITTI lines, or give the trajectory.log of Endo-Depth-and-Motion"
        )
