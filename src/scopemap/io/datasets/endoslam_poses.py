"""The files of poses in EndoSLAM: a table in time by Unity, and a spreadsheet of the robot that held a real endoscope.

`Poses/colon_position_rotation.csv`: `tX,tY,tZ,rX,rY,rZ,rW,time(s)`, row = image number, from 0, left-handed; its last
row is often cut off. `Poses/*.xlsx`: `ImageFrame` (the number in the image's name), `trans_x,y,z` (metres) and the
quaternion `quot_x,y,z,w`, by name of the column. Not documented: the unit of Unity, the frame and axes of the robot.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.frame import TruthQuality
from scopemap.io.datasets.spreadsheet import read_sheet
from scopemap.io.datasets.unity import mirrored, numbers_of, poses_of_rows
from scopemap.trajectory.formats.text import text_lines

POSE_FILES = ("*position_rotation.csv", "*.xlsx")
"""Names of the files that are read, of Unity and of the robot."""

_HEADER = ["tx", "ty", "tz", "rx", "ry", "rz", "rw", "time(s)"]
_COLUMNS = [*(f"trans_{axis}" for axis in "xyz"), *(f"quot_{axis}" for axis in "xyzw")]
_MM_PER_METRE = 1000.0
_SAME = 1e-6


@dataclass(frozen=True)
class CameraPath:
    """What a file of poses says.

    Attributes
    ----------
    poses : camera-to-world (4, 4), mm, by image number; an image without a pose is not among them.
    count : rows of the file, with a pose or without.
    times_s : (count,) float64, time stamps of images 0, 1, ...; None where the file has none.
    quality : how the poses came about.
    notes : what had to be assumed. warnings : what is wrong in the file.
    """

    poses: dict[int, np.ndarray]
    count: int
    times_s: np.ndarray | None
    quality: TruthQuality
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def find_poses(folder: Path) -> Path | None:
    """Return the file of poses in `folder`, which need not exist, or None; several are an `InputError`."""
    for pattern in POSE_FILES:
        # Excel leaves "~$" locks behind, zips made on a Mac "._" files.
        found = sorted(file for file in folder.glob(pattern) if not file.name.startswith((".", "~")))
        if len(found) > 1:
            names = ", ".join(file.name for file in found[:5])
            raise InputError(f"reading {folder}: it holds {len(found)} files of poses ({names}); leave one there")
        if found:
            return found[0]
    return None


def read_camera_path(file: Path) -> CameraPath:
    """Return the poses in a CSV table of Unity or a spreadsheet. Raises `InputError`, with line or row."""
    return _read_table(file) if file.suffix.lower() == ".csv" else _read_sheet(file)


def _read_table(file: Path) -> CameraPath:
    lines = "\n".join(text_lines(file)).lstrip("\ufeff").rstrip().splitlines()
    first = 1
    if lines and any(name in lines[0].lower() for name in _HEADER):
        found = [name.strip().lower() for name in lines[0].split(",")]
        if found != _HEADER:
            raise InputError(f"{file}, line 1: expected the columns {','.join(_HEADER)}, found {lines[0].strip()}")
        first = 2
    if len(lines) < first:
        raise InputError(f"reading {file}: it holds no pose")
    where = [f"{file}, line {number}" for number in range(first, len(lines) + 1)]
    rows, warnings = _table_rows([line.split(",") for line in lines[first - 1 :]], where)
    known, T = poses_of_rows(rows[:, :7], _MM_PER_METRE, where[: len(rows)])
    quaternions = rows[known, 3:7]
    if len(quaternions) > 1 and np.ptp(quaternions, axis=0).max() < _SAME:
        warnings.append(f"{file.name}: all rotations are the same; figures of rotation measured on it mislead")
    notes = [
        "poses: their unit is not documented, read as metres; compare after aligning scale",
        "poses: Unity's left-handed axes, y mirrored to OpenCV's (EndoGSLAM mirrors z; neither is documented)",
        f"poses: row of {file.name} = image number, from 0 (it does not say)",
    ]
    poses = dict(zip(np.flatnonzero(known).tolist(), mirrored(T), strict=True))
    return CameraPath(poses, len(rows), _without_gaps(rows[:, 7]), "exact", notes, warnings)


def _table_rows(fields: list[list[str]], where: list[str]) -> tuple[np.ndarray, list[str]]:
    """Return the rows (N, 8), and a warning where the last was left out because it is cut off."""
    rows: list[list[float]] = []
    latest = -np.inf
    for cells, place in zip(fields, where, strict=True):
        try:
            row = numbers_of(cells, len(_HEADER), place)
            if row[7] <= latest:
                raise InputError(f"{place}: the time {row[7]:g} s is not after {latest:g} s of an earlier line")
        except InputError:
            # Only at the end: a row left out in between would shift the poses of all images after it.
            if place == where[-1] and rows:
                return np.array(rows), [f"{place}: the last row is cut off or out of order, and was left out"]
            raise
        rows.append(row)
        latest = max(latest, row[7])
    return np.array(rows), []


def _without_gaps(times_s: np.ndarray) -> np.ndarray | None:
    known = np.flatnonzero(np.isfinite(times_s))
    return np.interp(np.arange(len(times_s)), known, times_s[known]) if known.size else None


def _read_sheet(file: Path) -> CameraPath:
    sheet = read_sheet(file)
    names = [name.lower().replace("quat_", "quot_") for name in sheet[0][1]] if sheet else []
    missing = [name for name in ("imageframe", *_COLUMNS) if name not in names]
    if missing:
        found = ", ".join(filter(None, names)) or "-"
        raise InputError(f"{file}: the first sheet has no column {', '.join(missing)}, found {found}")
    wanted = [names.index(name) for name in ("imageframe", *_COLUMNS)]
    filled = [(number, row) for number, row in sheet[1:] if any(row[column] for column in wanted)]
    where = [f"{file}, row {number}" for number, _ in filled]
    cells = [[row[column] or "nan" for column in wanted] for _, row in filled]
    rows = np.array([numbers_of(c, len(wanted), place) for c, place in zip(cells, where, strict=True)])
    if not len(rows):
        raise InputError(f"reading {file}: it holds no pose")
    known, T = poses_of_rows(rows[:, 1:], _MM_PER_METRE, where)
    poses = _by_image(rows[:, 0], known, T, where)
    notes = [
        "poses: metres, as in the file; whose they are (camera or robot hand) and in which axes is not documented",
        "poses: joined by ImageFrame = number in the image's name",
    ]
    return CameraPath(poses, len(rows), None, "kinematic", notes)


def _by_image(images: np.ndarray, known: np.ndarray, T: np.ndarray, where: list[str]) -> dict[int, np.ndarray]:
    poses: dict[int, np.ndarray] = {}
    remaining = iter(T)
    for image, holds, place in zip(images.tolist(), known.tolist(), where, strict=True):
        if not (np.isfinite(image) and image >= 0 and image == int(image)):
            raise InputError(f"{place}: ImageFrame must be the number of an image, found {image:g}")
        if not holds:
            continue
        pose = next(remaining)
        if int(image) in poses and np.abs(poses[int(image)] - pose).max() > _SAME:
            raise InputError(f"{place}: image {int(image)} has another pose in an earlier row; leave one out")
        poses[int(image)] = pose
    return poses
