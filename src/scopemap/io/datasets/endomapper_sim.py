"""EndoMapper's simulated colon, rendered with Unity: pictures, depth and poses (doi 10.1038/s41597-023-02564-7).

`rgb/image_NNNN.png`, `depth/aov_image_NNNN.exr` (the depth buffer, in channel R), and `trajectory.csv` with a row
`tX;tY;tZ;rX;rY;rZ;rW;time(s)` per picture, from 0: camera-to-world, decimetres. `calibration.txt` holds the pinhole.

The depth buffer v runs from 1 at 1 mm to 0 at 400 mm: the depth is 1 dm / (0.25 + 99.75 v).
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.calibration import check_plausible, fitted_to, rescaled_note
from scopemap.cameras.formats.reading import stated_calibration
from scopemap.errors import InputError
from scopemap.io.datasets.exr import can_read_exr, read_exr_red
from scopemap.io.datasets.unity import mirrored, numbers_of, poses_of_rows
from scopemap.io.images import FOLDER_RATE_HZ, ImageFolder
from scopemap.trajectory.formats.text import text_lines

CAMERA = PinholeCamera(472.64955, 472.64955, 479.5, 359.5, 960, 720)
"""As published with the simulated sequences."""

_TRAJECTORY = "trajectory.csv"
_CALIBRATION = "calibration.txt"
_HEADER = "tx;ty;tz;rx;ry;rz;rw;time(s)"
_COLUMNS = 8
_IMAGE = re.compile(r"image_(\d{1,9})")
_DEPTH = re.compile(r"aov_image_(\d{1,9})")
_MM_PER_DM = 100.0
_NEAR_DM, _FAR_DM = 0.01, 4.0
_ASPECT_TOLERANCE = 0.01
_LARGEST_SIDE_PX = 100_000


class EndoMapperSimFolder(ImageFolder):
    """One simulated sequence; `camera.yaml` beside it wins, and its `depth_scale` is the mm that a unit (dm) has."""

    name = "endomapper-sim"
    quality = "exact"

    def __init__(self, path: Path) -> None:
        files = _numbered(path / "rgb", _IMAGE, ".png")
        super().__init__(path, list(files.values()))
        self._depth_files = _numbered(path / "depth", _DEPTH, ".exr")
        self._poses, self._times_s, fault = read_trajectory_csv(path / _TRAJECTORY)
        self.warnings += [fault] if fault else []
        if self._times_s:
            self.stamped = True
            self.notes[0] = f"time stamps: those of {_TRAJECTORY}"
        self.notes += [
            f"poses: {_TRAJECTORY}, row = image number, decimetres, taken as Unity's left-handed axes and converted; "
            "the data set does not say which they are, and others use them as they stand",
            "depth: 1 dm / (0.25 + 99.75 v) of channel R, which other readers take in other ways",
        ]
        without = sum(number not in self._poses for number in self.numbers)
        if without:
            self._warn(f"{path / _TRAJECTORY}: {without} of {self.count} images have no pose in it")
        if self._depth_files and not can_read_exr():
            self._depth_files = {}
            self._warn(f"{path}: depth (OpenEXR) is left out; install its reader: pip install 'scopemap[datasets]'")
        if self.camera is None:
            self._use_published()

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `rgb/image_*.png`, `depth/aov_image_*.exr` and `trajectory.csv`."""
        if not (path / _TRAJECTORY).is_file():
            return False
        return any((path / "rgb").glob("image_*.png")) and any((path / "depth").glob("aov_image_*.exr"))

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose in the row of the picture's number, or None."""
        return self._poses.get(index)

    def _time_s(self, number: int) -> float:
        """Return the time of a picture's row; behind the last one they follow each other in 1/30 s, as all do."""
        if not self._times_s:
            return number / FOLDER_RATE_HZ
        last = len(self._times_s) - 1
        return self._times_s[min(number, last)] + max(number - last, 0) / FOLDER_RATE_HZ

    def _depth_mm(self, index: int) -> np.ndarray | None:
        file = self._depth_files.get(index)
        if file is None:
            return None
        v = read_exr_red(file)
        rows, columns = v.shape
        if abs(columns * self.height / (rows * self.width) - 1) > _ASPECT_TOLERANCE:
            raise InputError(
                f"reading {file}: depth of {columns}x{rows} px for images of {self.width}x{self.height} px"
            )
        # A depth buffer holds 0 to 1; NaN compares false.
        v = np.where((v >= 0) & (v <= 1), v, np.float32(np.nan))
        depth_dm = 1 / (1 / _FAR_DM + (1 / _NEAR_DM - 1 / _FAR_DM) * v)
        return (depth_dm * (self.depth_scale_mm or _MM_PER_DM)).astype(np.float32)

    def _use_published(self) -> None:
        file = self.path / _CALIBRATION
        camera = stated_calibration(file, (self.width, self.height)).camera if file.is_file() else CAMERA
        known = _CALIBRATION if file.is_file() else "published calibration of the simulated sequences"
        name = str(file) if file.is_file() else "shipped for it"
        self.camera = fitted_to(camera, (self.width, self.height), name)
        check_plausible(self.camera, f"the calibration {name}")
        self.camera_source = known + rescaled_note(camera, self.camera)


def read_trajectory_csv(file: Path) -> tuple[dict[int, np.ndarray], list[float], str]:
    """Return poses (4, 4), mm, OpenCV axes, and times, s, by row from 0, and what is wrong with the file, or "".

    The last row may break off, as it does in a published file: it is left out. Times that do not increase are none.
    Raises `InputError`, with the line, for anything else that is no such table.
    """
    lines = text_lines(file)
    while lines and not lines[-1].strip():
        lines.pop()
    header = lines[0].lstrip("\ufeff").replace(" ", "").lower() if lines else ""
    if header != _HEADER:
        raise InputError(f"reading {file}: expected the header tX;tY;tZ;rX;rY;rZ;rW;time(s), found {header[:60]!r}")
    where = [f"{file}, line {number}" for number in range(2, len(lines) + 1)]
    rows: list[list[float]] = []
    fault = ""
    for place, line in zip(where, lines[1:], strict=True):
        try:
            rows.append(numbers_of(line.split(";"), _COLUMNS, place))
        except InputError as error:
            if place != where[-1]:
                raise
            fault = f"{error}: the last row breaks off and was left out"
    if not rows:
        raise InputError(f"reading {file}: it holds no pose")
    values = np.array(rows)
    known, poses = poses_of_rows(values[:, :7], _MM_PER_DM, where[: len(rows)])
    times_s = values[:, 7].tolist()
    if not np.isfinite(times_s).all() or any(b <= a for a, b in pairwise(times_s)):
        times_s, fault = [], fault or f"{file}: the times do not increase and were left out"
    return dict(zip(np.flatnonzero(known).tolist(), mirrored(poses), strict=True)), times_s, fault


def _numbered(folder: Path, name: re.Pattern[str], suffix: str) -> dict[int, Path]:
    """Return the files with this name by number, ascending; `InputError` where two have one number."""
    found: dict[int, Path] = {}
    for file in folder.iterdir() if folder.is_dir() else ():
        match = name.fullmatch(file.stem) if file.suffix.lower() == suffix else None
        if match is not None and found.setdefault(int(match[1]), file) != file:
            raise InputError(f"reading {folder}: {file.name} and {found[int(match[1])].name} have the same number")
    return dict(sorted(found.items()))
