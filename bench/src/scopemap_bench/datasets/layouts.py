"""Layouts of folders of pictures, as a table: where pictures, depth and intrinsics are, and how depth is coded.

Poses as Unity writes them are left-handed with y up; a table of them has the columns `tX,tY,tZ,rX,rY,rZ,rW,time(s)`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.frame import TruthQuality
from scopemap.input.camera_files.reading import stated_calibration
from scopemap.input.decoding import by_number, frame_number
from scopemap.input.images import ImageFolder, image_files, images_in
from scopemap.input.trajectory.poses import from_quaternions
from scopemap.input.trajectory.text import fields_of, text_lines

_HEADER = ["tx", "ty", "tz", "rx", "ry", "rz", "rw", "time(s)"]
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Place:
    """Where a layout has its pictures, and the depth of each.

    images : folder of the pictures. names : of the pictures without ending; what the `*` stands for is a picture's key.
    depths : files with the depth of a picture, `{}` its key, the first that exists; one that ends in "/" is a folder
    whose images belong to the pictures with the same number. needs : folder beside it, or "".
    """

    images: str = ""
    names: str = "*"
    depths: tuple[str, ...] = ()
    needs: str = ""

    def pictures(self, path: Path) -> dict[Path, str]:
        """Return the pictures of the data set in `path` with their keys, in numeric order."""
        if self.needs and not (path / self.needs).is_dir():
            return {}
        form = re.compile(re.escape(self.names).replace(r"\*", "(.*)"))
        found = ((file, form.fullmatch(file.stem)) for file in image_files(path / self.images))
        return {file: match[1] for file, match in found if match}


class LayoutFolder(ImageFolder):
    """A folder of pictures in one of the `places` of its layout; a `camera.yaml` beside them replaces its intrinsics.

    needs : groups of files or folders (glob patterns), of each of which one is there where the layout is recognised.
    numbered : whether every picture must have a number of its own; else pictures may be counted.
    intrinsics : calibration files, `{}` the folder's name, each with the number of folders above in which it may be.
    remarks : notes. Raises `InputError` without pictures; intrinsics that cannot be used are its `camera_fault`.
    """

    places: ClassVar[tuple[Place, ...]] = ()
    needs: ClassVar[tuple[tuple[str, ...], ...]] = ()
    numbered: ClassVar[bool] = False
    intrinsics: ClassVar[tuple[tuple[str, int], ...]] = ()
    remarks: ClassVar[tuple[str, ...]] = ()

    def __init__(self, path: Path) -> None:
        self.place, pictures = _found(self.places, path)
        super().__init__(path, list(by_number(pictures).values()) if self.numbered else list(pictures))
        self.notes += self.remarks
        folders = (at for at in self.place.depths if at.endswith("/"))
        self.depth_files = next((found for at in folders if (found := numbered_images(path / at))), {})
        for number, picture in self.file_of.items():
            files = (path / at.format(pictures[picture]) for at in self.place.depths)
            depth = next((file for file in files if file.is_file()), None)
            if depth is not None:
                self.depth_files[number] = depth
        if self.camera is None:
            with self._making_camera():
                self._use_intrinsics()

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether `path` holds pictures in one of the places, and all that the layout needs."""
        there = all(any(any(path.glob(name)) for name in group) for group in cls.needs)
        return there and bool(_found(cls.places, path)[1])

    @classmethod
    def recognised(cls) -> str:
        """Return in words what the folder holds where the layout is recognised."""
        pictures = " or ".join(f"`{Path(place.images) / place.names}`" for place in cls.places)
        return ", and ".join([f"pictures {pictures}", *(" or ".join(f"`{n}`" for n in group) for group in cls.needs)])

    def _use_intrinsics(self) -> None:
        own = self.path.absolute()
        files = (at / name.format(own.name) for name, up in self.intrinsics for at in (own, *own.parents[:up]))
        file = next((file for file in files if file.is_file()), None)
        if file is not None:
            camera = stated_calibration(file, (self.width, self.height)).camera
            self._set_camera(camera, f"intrinsics of the data set ({file})", str(file))
            self.notes.append(f"{file.name} is taken for pixel centres that count from 0, and no distortion")


def _found(places: tuple[Place, ...], path: Path) -> tuple[Place, dict[Path, str]]:
    """Return the first place that holds pictures, with these; the last one, empty, where none does."""
    place, pictures = places[-1], dict[Path, str]()
    for place in places:
        pictures = place.pictures(path)
        if pictures:
            break
    return place, pictures


def mirrored(T: np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4) of the left-handed world with y up in OpenCV's axes, both camera and world: M T M."""
    return _MIRROR @ T @ _MIRROR


class UnityFolder(LayoutFolder):
    """A folder of images rendered with Unity, numbered as the rows of a table of poses."""

    numbered = True
    quality: TruthQuality = "exact"

    def _read_table(self, file: Path, mm_per_unit: float) -> int:
        """Read the poses and time stamps of a table; return its rows' number.

        Its header may be missing. A last row that is cut off, as in published files, and times that do not increase are
        left out with a warning. Raises `InputError`, with the line, for anything else that is no such table.
        """
        lines = "\n".join(text_lines(file)).rstrip().splitlines()
        has_header = bool(lines) and any(name in lines[0].lower() for name in _HEADER)
        if has_header and fields_of(lines[0].lower()) != _HEADER:
            raise InputError(f"{file}, line 1: expected the columns {','.join(_HEADER)}, found {lines[0][:80]!r}")
        where = [f"{file}, line {number}" for number in range(1, len(lines) + 1)]
        rows: list[list[float]] = []
        for place, line in list(zip(where, lines, strict=True))[has_header:]:
            try:
                rows.append([float(field) for field in fields_of(line)])
                if len(rows[-1]) != len(_HEADER):
                    raise ValueError(f"found {len(rows.pop())} columns where {len(_HEADER)} numbers were expected")
            except ValueError as error:
                # Only at the end: a row left out in between would shift the poses of all images after it.
                if place != where[-1] or not rows:
                    raise InputError(f"{place}: {error}") from None
                self._warn(f"{place}: {error}: the last row is cut off and was left out")
        if not rows:
            raise InputError(f"reading {file}: it holds no pose")
        values = np.array(rows)
        by_row = poses_by_row(values[:, :7], mm_per_unit, where[has_header:])
        self.poses = {row: mirrored(T) for row, T in by_row.items()}
        known = np.flatnonzero(np.isfinite(values[:, 7]))
        times_s = np.interp(np.arange(len(rows)), known, values[known, 7]) if known.size else np.zeros(2)
        self.stamped = bool((np.diff(times_s) > 0).all())
        if self.stamped:
            # Images beyond the last row follow it at the assumed rate.
            last = len(rows) - 1
            self.times_s = {n: float(times_s[min(n, last)]) + max(n - last, 0) / self.rate_hz for n in self.numbers}
            self.notes[0] = f"time stamps: those of {file.name}"
        else:
            self._warn(f"{file}: the times do not increase and were left out")
        return len(rows)


def numbered_images(folder: Path) -> dict[int, Path]:
    """Return the images in `folder` with a number in their names, depth and masks too, as `by_number`."""
    return by_number(file for file in images_in(folder) if frame_number(file) is not None)


def poses_by_row(rows: np.ndarray, mm_per_unit: float, where: list[str]) -> dict[int, np.ndarray]:
    """Return the pose (4, 4), translation in mm, of each row (N, 7) `tx ty tz qx qy qz qw`, by number of the row.

    A row that holds NaN or infinity has no pose. Raises `InputError`, with its `where`, for other quaternions.
    """
    known = np.flatnonzero(np.isfinite(rows).all(axis=1))
    T = from_quaternions(rows[known, 3:], rows[known, :3] * mm_per_unit, [where[row] for row in known])
    return dict(zip(known.tolist(), T, strict=True))
