"""TUM RGB-D: rooms seen by a Kinect, with poses by motion capture, and whatever else is written in its layout.

`rgb.txt` and `depth.txt` list `timestamp filename`, `groundtruth.txt` lists `timestamp tx ty tz qx qy qz qw`, where the
colour camera is in the world, metres. Depth is registered to colour: uint16, 5000 = 1 m, 0 = unknown. Optional
`associations.txt`: `t_rgb rgb_file t_depth depth_file`, or depth first. Frame number = position in rgb.txt, from 0.
Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.calibration import fitted_to, rescaled_note
from scopemap.cameras.lenses import OpenCvCamera
from scopemap.errors import InputError
from scopemap.io.images import ImageFolder, read_depth16
from scopemap.trajectory.formats.poses import are_frame_numbers
from scopemap.trajectory.formats.text import NumberTable, fields_of, parse_row, text_lines, tum_poses
from scopemap.trajectory.trajectory import Unit

CAMERAS: dict[str, CameraModel] = {
    "1": OpenCvCamera(PinholeCamera(517.3, 516.5, 318.6, 255.3, 640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": OpenCvCamera(PinholeCamera(520.9, 521.0, 325.1, 249.7, 640, 480), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": PinholeCamera(535.4, 539.2, 320.1, 247.6, 640, 480),
}
"""Of the colour images of freiburg1, 2 and 3 as published; those of freiburg3 were undistorted."""

DEPTH_UNIT_MM = 0.2
ASSOCIATED_WITHIN_S = 0.02
_IMAGES, _DEPTHS, _POSES, _PAIRS = "rgb.txt", "depth.txt", "groundtruth.txt", "associations.txt"
_NAMED = re.compile(r"freiburg([123])|(?<![a-z0-9])fr([123])(?![a-z0-9])", re.IGNORECASE)
_POSE_COLUMNS = 8
_PAIR_COLUMNS = 4
_ENDOSCOPIC_DEPTH_MM = (5.0, 500.0)

_Listing = list[tuple[float, str]]


class TumRgbdFolder(ImageFolder):
    """One TUM RGB-D sequence, or a folder in its layout; `camera.yaml` beside rgb.txt wins over published constants.

    Images that a list names but that are not there are left out with a warning; the others keep their numbers. Names
    that are absolute or lead out of the folder count as not there. Raises `InputError` for
    lists and poses that cannot be read; images that no published camera fits are its `camera_fault`.
    """

    name = "tum"
    stamped = True

    def __init__(self, path: Path) -> None:
        listed = _read_list(path / _IMAGES)
        ordered = sorted(listed)
        there = {number: entry for number, entry in enumerate(ordered) if _is_there(path, entry[1])}
        if not there:
            raise InputError(f"reading {path / _IMAGES}: none of the {len(ordered)} images that it names is there")
        super().__init__(path, [path / name for _, name in there.values()])
        self.numbers = list(there)
        self._times_s = {number: stamp for number, (stamp, _) in there.items()}
        self.notes = ["time stamps: those of rgb.txt; frame number = position in it"]
        if listed != ordered:
            self.warnings.append(f"{path / _IMAGES} is not in the order of time; its frames are numbered in that order")
        if are_frame_numbers(np.array([stamp for stamp, _ in listed])):
            self.notes.append("the time stamps are whole numbers, perhaps of frames: they are taken as seconds")
        self._tell_missing(_IMAGES, len(ordered), len(there))
        room = _NAMED.search("/".join(path.absolute().parts[-2:]))
        self._depth_is_checked = room is not None  # rooms are deeper than what an endoscope sees
        if room is not None and self.camera is None:
            number = room[1] or room[2]
            with self._making_camera():
                self.camera = fitted_to(CAMERAS[number], (self.width, self.height), f"shipped for freiburg{number}")
                note = rescaled_note(CAMERAS[number], self.camera)
                self.camera_source = f"published calibration of freiburg{number}{note}"
        self._depth_of = self._associated_depth({name: number for number, (_, name) in there.items()})
        self._pose_of = self._associated_poses()

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds rgb.txt and depth.txt, groundtruth.txt or the folder `rgb`."""
        beside = (path / _DEPTHS).is_file() or (path / _POSES).is_file() or (path / "rgb").is_dir()
        return (path / _IMAGES).is_file() and beside

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose by motion capture; None where none was taken within 0.02 s of the image."""
        return self._pose_of.get(index)

    def _time_s(self, number: int) -> float:
        return self._times_s[number]

    def _depth_mm(self, index: int) -> np.ndarray | None:
        file = self._depth_of.get(index)
        values = None if file is None else read_depth16(file)
        if values is None:
            return None
        depth_mm = values * np.float32(self.depth_scale_mm or DEPTH_UNIT_MM)
        depth_mm = np.where(values > 0, depth_mm, np.nan).astype(np.float32)
        if not self._depth_is_checked:
            self._depth_is_checked = True
            fault = unlikely_depth(depth_mm)
            if fault is not None:
                self._warn(f"{file}: {fault}; `depth_scale` in camera.yaml beside {_IMAGES} states another unit")
        return depth_mm

    def _associated_depth(self, number_of: dict[str, int]) -> dict[int, Path]:
        """Return the depth files of frames: the pairs of associations.txt, else the nearest in time."""
        if (self.path / _PAIRS).is_file():
            named = _read_pairs(self.path / _PAIRS, number_of)
            pairs = {number: name for number, name in named.items() if _is_there(self.path, name)}
            self._tell_missing(_PAIRS, len(named), len(pairs))
            how = _PAIRS
        elif (self.path / _DEPTHS).is_file():
            listed = sorted(_read_list(self.path / _DEPTHS))
            there = [(stamp, name) for stamp, name in listed if _is_there(self.path, name)]
            self._tell_missing(_DEPTHS, len(listed), len(there))
            pairs = {number: there[row][1] for number, row in self._nearest([stamp for stamp, _ in there]).items()}
            how = f"the nearest in time, less than {ASSOCIATED_WITHIN_S:g} s away"
        else:
            return {}
        unit = f"{1 / DEPTH_UNIT_MM:g} units per mm" if self.depth_scale_mm is None else "depth_scale of camera.yaml"
        self._tell_associated("depth", len(pairs), f"{how}; {unit}")
        return {number: self.path / name for number, name in pairs.items()}

    def _associated_poses(self) -> dict[int, np.ndarray]:
        file = self.path / _POSES
        if not file.is_file():
            self.notes.append(f"no pose is known: there is no {_POSES}")
            return {}
        poses = read_stamped_poses(file, "m")
        rows = self._nearest(poses.stamps.tolist())
        self._tell_associated("pose", len(rows), f"the nearest in time; camera-to-world, {poses.unit}")
        return {number: poses.T_world_camera[row] for number, row in rows.items()}

    def _nearest(self, stamps_s: list[float]) -> dict[int, int]:
        """Return the row of `stamps_s` (ascending) for each frame that has one."""
        return {self.numbers[i]: row for i, row in associated(list(self._times_s.values()), stamps_s).items()}

    def _tell_missing(self, file: str, listed: int, there: int) -> None:
        if there < listed:
            self._warn(f"{self.path / file}: {listed - there} of the {listed} images that it names are not there")

    def _tell_associated(self, what: str, found: int, how: str) -> None:
        self.notes.append(f"{what}: of {found} of {len(self.numbers)} frames, {how}")
        if not found:
            self._warn(f"{self.path}: no {what} belongs to any frame; are the time stamps those of the same clock?")


@dataclass(frozen=True)
class StampedPoses:
    """Rows `stamp tx ty tz qx qy qz qw` of a file.

    Attributes
    ----------
    stamps : (N,) float64, ascending. T_world_camera : (N, 4, 4) float64, mm.
    unit : of translations in the file, in words. mm_per_unit : its length.
    """

    stamps: np.ndarray
    T_world_camera: np.ndarray
    unit: str
    mm_per_unit: float


def read_stamped_poses(file: Path, unit: Unit) -> StampedPoses:
    """Return the poses in a TUM file; `unit` holds unless a comment states another (`# unit: mm`).

    A row with NaN or with the quaternion 0 0 0 0 says that there is no pose. Raises `InputError`, with the line, for
    any other row that is none, for a stamp that comes again, and where no pose is left.
    """
    lines = text_lines(file)
    split = ((number, fields_of(line)) for number, line in enumerate(lines, start=1))
    rows = {number: fields for number, fields in split if fields and not _is_unknown(fields)}
    wrong = next((number for number, fields in rows.items() if len(fields) != _POSE_COLUMNS), None)
    if wrong is not None:
        raise InputError(
            f"{file}, line {wrong}: found {len(rows[wrong])} numbers where a pose has {_POSE_COLUMNS}: "
            "stamp tx ty tz qx qy qz qw"
        )
    if not rows:
        raise InputError(f"reading {file}: it holds no pose; leave the file out where none is known")
    values = np.array([parse_row(fields, f"{file}, line {number}") for number, fields in rows.items()])
    comments = "\n".join(line for line in lines if line.lstrip().startswith("#"))
    table = NumberTable(file, values, list(rows), comments).sorted_by_stamp()
    T_world_camera, words = tum_poses(table, unit)
    return StampedPoses(table.values[:, 0], T_world_camera, words, table.unit(unit)[0])


def associated(stamps_s: list[float], others_s: list[float]) -> dict[int, int]:
    """Return pairs of rows of two ascending lists of time stamps: the nearest first, each row in one pair at most.

    As the data set's own tool does it: pairs are less than 0.02 s apart.
    """
    windows = np.searchsorted(others_s, np.add.outer(stamps_s, [-ASSOCIATED_WITHIN_S, ASSOCIATED_WITHIN_S]))
    gaps = sorted(
        (abs(stamp - others_s[k]), i, k)
        for i, (stamp, window) in enumerate(zip(stamps_s, windows, strict=True))
        for k in range(*window)
    )
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for gap_s, i, k in gaps:
        if gap_s < ASSOCIATED_WITHIN_S and i not in pairs and k not in taken:
            pairs[i] = k
            taken.add(k)
    return pairs


def unlikely_depth(depth_mm: np.ndarray) -> str | None:
    """Return what is unlikely in a depth image (h, w), mm, NaN = unknown, of an endoscope; None where nothing is."""
    known = depth_mm[np.isfinite(depth_mm)]
    nearest, farthest = _ENDOSCOPIC_DEPTH_MM
    if not known.size or nearest <= np.median(known) <= farthest:
        return None
    return f"the median depth is {np.median(known):g} mm, where an endoscope has {nearest:g} to {farthest:g}"


def _is_unknown(fields: list[str]) -> bool:
    try:
        numbers = [float(field) for field in fields[1:]]
    except ValueError:
        return False
    return len(fields) == _POSE_COLUMNS and (any(map(math.isnan, numbers)) or not any(numbers[3:]))


def _rows_of(file: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield place and fields of each line that is no comment; raises `InputError` where the file is no text."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the list {file}: {error}") from None
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"{file}, line {number}", line.split()


def _read_list(file: Path) -> _Listing:
    """Return (time stamp, name) of each image in a list, in its order."""
    listed: dict[float, str] = {}
    for where, fields in _rows_of(file):
        stamp = _number(fields[0])
        if len(fields) != 2 or stamp is None:
            raise InputError(f"{where}: expected `timestamp filename`, found '{' '.join(fields)[:80]}'")
        if stamp in listed:
            raise InputError(f"{where}: the time stamp of an earlier line comes again; leave one out")
        listed[stamp] = fields[1]
    if not listed:
        raise InputError(f"reading {file}: it names no image")
    return list(listed.items())


def _read_pairs(file: Path, number_of: dict[str, int]) -> dict[int, str]:
    """Return the depth file of each frame that associations.txt names, colour or depth first."""
    pairs: dict[int, str] = {}
    for where, fields in _rows_of(file):
        if len(fields) != _PAIR_COLUMNS or _number(fields[0]) is None or _number(fields[2]) is None:
            raise InputError(f"{where}: expected `timestamp rgb_file timestamp depth_file`, or depth first")
        colour, depth = (fields[1], fields[3]) if fields[1] in number_of else (fields[3], fields[1])
        if colour in number_of and pairs.setdefault(number_of[colour], depth) != depth:
            raise InputError(f"{where}: {colour} has another depth image in an earlier line")
    return pairs


def _number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _is_there(folder: Path, name: str) -> bool:
    """Whether `name`, which anyone may have written, is that of a file below `folder`; links are the user's own."""
    inside = not os.path.isabs(name) and not os.path.normpath(name).startswith("..")
    # Path.is_file raises for names that no file system allows.
    return inside and os.path.isfile(folder / name)
