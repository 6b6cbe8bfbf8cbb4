"""TUM RGB-D: rooms seen by a Kinect, with poses by motion capture, and whatever else is written in its layout.

`rgb.txt` and `depth.txt` list `timestamp filename`, `groundtruth.txt` `timestamp tx ty tz qx qy qz qw`, colour camera
in the world, metres. Depth is registered to colour: uint16, 5000 = 1 m, 0 = unknown. `associations.txt`: `t_rgb
rgb_file t_depth depth_file`, or depth first. Frame number = position in rgb.txt, from 0. Sturm et al., IROS 2012.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.errors import InputError, reporting
from scopemap.input.images import ImageFolder
from scopemap.input.trajectory.columns import are_frame_numbers
from scopemap.input.trajectory.text import NumberTable, read_numbers, text_lines, tum_poses

CAMERAS: dict[str, CameraModel] = {
    "1": OpenCvCamera(PinholeCamera(517.3, 516.5, 318.6, 255.3, 640, 480), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": OpenCvCamera(PinholeCamera(520.9, 521.0, 325.1, 249.7, 640, 480), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": PinholeCamera(535.4, 539.2, 320.1, 247.6, 640, 480),
}
"""Of the colour images of freiburg1, 2 and 3 as published; those of freiburg3 were undistorted."""

DEPTH_UNIT_MM = 0.2
ASSOCIATED_WITHIN_S = 0.02
_IMAGES = "rgb.txt"
_DEPTHS = "depth.txt"
_POSES = "groundtruth.txt"
_PAIRS = "associations.txt"
_NAMED = re.compile(r"freiburg([123])|(?<![a-z0-9])fr([123])(?![a-z0-9])", re.IGNORECASE)


class TumRgbdFolder(ImageFolder):
    """One TUM RGB-D sequence, or a folder in its layout; `camera.yaml` beside rgb.txt replaces published constants.

    Images that a list names but that are not there, or lead out of the folder, are left out with a warning; the others
    keep their numbers. `InputError` for lists and poses that cannot be read.
    """

    name = "tum"
    stamped = True
    depth_code = ((16, DEPTH_UNIT_MM, 65535),)

    def __init__(self, path: Path) -> None:
        listed = _read_list(path / _IMAGES)
        ordered = sorted(listed)
        there = {number: entry for number, entry in enumerate(ordered) if _is_there(path, entry[1])}
        if not there:
            raise InputError(f"reading {path / _IMAGES}: none of the {len(ordered)} images that it names is there")
        super().__init__(path, [path / name for _, name in there.values()])
        self.numbers = list(there)
        self.times_s = {number: stamp for number, (stamp, _) in there.items()}
        self.notes = ["time stamps: those of rgb.txt; frame number = position in it"]
        if listed != ordered:
            self.warnings.append(f"{path / _IMAGES} is not in the order of time; its frames are numbered in that order")
        if are_frame_numbers(np.array([stamp for stamp, _ in listed])):
            self.notes.append("the time stamps are whole numbers, perhaps of frames: they are taken as seconds")
        self._warn_of_missing(_IMAGES, len(ordered), len(there))
        room = _NAMED.search("/".join(path.absolute().parts[-2:]))
        if room is not None and self.camera is None:
            name = f"freiburg{room[1] or room[2]}"
            with self._making_camera():
                self._set_camera(CAMERAS[name[-1]], f"published calibration of {name}", f"shipped for {name}")
        self._associate_depth({name: number for number, (_, name) in there.items()})
        self._associate_poses()

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds rgb.txt and depth.txt, groundtruth.txt or the folder `rgb`."""
        beside = (path / _DEPTHS).is_file() or (path / _POSES).is_file() or (path / "rgb").is_dir()
        return (path / _IMAGES).is_file() and beside

    def _associate_depth(self, number_of: dict[str, int]) -> None:
        """Find the depth files of frames: the pairs of associations.txt, else the nearest in time."""
        if (self.path / _PAIRS).is_file():
            named, how = _read_pairs(self.path / _PAIRS, number_of), _PAIRS
            pairs = {number: name for number, name in named.items() if _is_there(self.path, name)}
            self._warn_of_missing(_PAIRS, len(named), len(pairs))
        elif (self.path / _DEPTHS).is_file():
            listed = sorted(_read_list(self.path / _DEPTHS))
            there = [(stamp, name) for stamp, name in listed if _is_there(self.path, name)]
            self._warn_of_missing(_DEPTHS, len(listed), len(there))
            pairs = {number: there[row][1] for number, row in self._nearest([stamp for stamp, _ in there]).items()}
            how = f"the nearest in time, less than {ASSOCIATED_WITHIN_S:g} s away"
        else:
            return
        unit = f"{1 / DEPTH_UNIT_MM:g} units per mm" if self.depth_scale_mm is None else "depth_scale of camera.yaml"
        self._note_associated("depth", len(pairs), f"{how}; {unit}")
        self.depth_files = {number: self.path / name for number, name in pairs.items()}

    def _associate_poses(self) -> None:
        file = self.path / _POSES
        if not file.is_file():
            self.notes.append(f"no pose is known: there is no {_POSES}")
            return
        table = read_stamped(file)
        T, unit = tum_poses(table, "m")
        rows = self._nearest(table.values[:, 0].tolist())
        self._note_associated("pose", len(rows), f"the nearest in time; camera-to-world, {unit}")
        self.poses = {number: T[row] for number, row in rows.items()}

    def _nearest(self, stamps_s: list[float]) -> dict[int, int]:
        """Return the row of `stamps_s` (ascending) for each frame that has one."""
        pairs = associated(list(self.times_s.values()), stamps_s)
        return {self.numbers[position]: row for position, row in pairs.items()}

    def _warn_of_missing(self, file: str, listed: int, there: int) -> None:
        if there < listed:
            self._warn(f"{self.path / file}: {listed - there} of the {listed} images that it names are not there")

    def _note_associated(self, what: str, found: int, how: str) -> None:
        self.notes.append(f"{what}: of {found} of {len(self.numbers)} frames, {how}")
        if not found:
            self._warn(f"{self.path}: no {what} belongs to any frame; are the time stamps those of the same clock?")


def read_stamped(file: Path) -> NumberTable:
    """Return the rows `stamp tx ty tz qx qy qz qw` of a file, by ascending stamp; NaN or a quaternion of 0 is no pose.

    Raises `InputError`, with the line, for any other row, for a stamp that is repeated, and where no pose is left.
    """
    table = read_numbers(file, missing=True).as_tum("stamp tx ty tz qx qy qz qw")
    known = np.isfinite(table.values).all(axis=1) & table.values[:, 4:].any(axis=1)
    if not known.any():
        raise InputError(f"reading {file}: it holds no pose; leave the file out where none is known")
    return table.rows(known).sorted_by_stamp()


def associated(stamps_s: list[float], others_s: list[float]) -> dict[int, int]:
    """Return pairs of rows of two ascending lists of time stamps, the nearest first, less than 0.02 s apart."""
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


def _fields_by_line(file: Path, form: str) -> Iterator[tuple[str, list[str]]]:
    """Yield place and fields of each line that is no comment; `InputError` for one that is not `timestamp name ...`."""
    for number, line in enumerate(text_lines(file), start=1):
        fields = line.split()
        if fields and not fields[0].startswith("#"):
            with reporting(f"{file}, line {number}: expected `{form}`, found '{line.strip()[:80]}'"):
                if len(fields) != len(form.split()) or not np.isfinite([float(text) for text in fields[::2]]).all():
                    raise ValueError("not such a line")
            yield f"{file}, line {number}", fields


def _read_list(file: Path) -> list[tuple[float, str]]:
    """Return (time stamp, name) of each image in a list, in its order."""
    listed: dict[float, str] = {}
    for where, (stamp, name) in _fields_by_line(file, "timestamp filename"):
        if float(stamp) in listed:
            raise InputError(f"{where}: the time stamp of an earlier line is repeated; leave one out")
        listed[float(stamp)] = name
    if not listed:
        raise InputError(f"reading {file}: it names no image")
    return list(listed.items())


def _read_pairs(file: Path, number_of: dict[str, int]) -> dict[int, str]:
    """Return the depth file of each frame that associations.txt names, colour or depth first."""
    pairs: dict[int, str] = {}
    for where, (_, one, _, other) in _fields_by_line(file, "timestamp rgb_file timestamp depth_file"):
        colour, depth = (one, other) if one in number_of else (other, one)
        if colour in number_of and pairs.setdefault(number_of[colour], depth) != depth:
            raise InputError(f"{where}: {colour} has another depth image in an earlier line")
    return pairs


def _is_there(folder: Path, name: str) -> bool:
    """Return whether `name`, which a stranger may have written, is that of a file below `folder`."""
    # Path.is_file raises for names that no file system allows.
    return not os.path.isabs(name) and not os.path.normpath(name).startswith("..") and os.path.isfile(folder / name)
