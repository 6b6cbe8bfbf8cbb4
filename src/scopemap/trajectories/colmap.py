"""COLMAP's `images.txt`: `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, each followed by a line of image points.

The pose takes a point in the world to the camera, quaternion with the scalar first, OpenCV axes; the scale is arbitrary
(colmap.github.io/format.html). The last number in an image's name is the frame's.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

import numpy as np

from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.trajectories.poses import file_of, from_quaternions, rigid, stamped
from scopemap.trajectories.text import parse_row, text_lines
from scopemap.trajectory import MM_PER_UNIT, Trajectory, Unit

COLMAP_FILES = ("images.txt", "sparse/0/images.txt", "sparse/images.txt")
_FIELDS_BEFORE_NAME = 9


def is_image_line(line: str) -> bool:
    """Whether a line gives the pose of an image: nine numbers, then a name; lines of points are numbers throughout."""
    fields = line.split(maxsplit=_FIELDS_BEFORE_NAME)
    return (
        len(fields) > _FIELDS_BEFORE_NAME
        and all(_is_number(field) for field in fields[:_FIELDS_BEFORE_NAME])
        and not _is_number(fields[_FIELDS_BEFORE_NAME].split()[0])
    )


def read_colmap(path: Path, unit: Unit) -> Trajectory:
    """Read the registered images of a text model, in the order of their numbers; others have no pose and no row."""
    file = file_of(path, COLMAP_FILES)
    lines = enumerate(text_lines(file), start=1)
    images = [(number, line) for number, line in lines if not line.startswith("#") and is_image_line(line)]
    if not images:
        raise InputError(f"cannot read a trajectory from {file}: it holds no line of an image with its pose")
    frames = np.array([_frame_of(line, f"{file}, line {number}") for number, line in images])
    order = np.argsort(frames, kind="stable")
    repeated = np.flatnonzero(np.diff(frames[order]) == 0)
    if repeated.size:
        number = images[order[repeated[0] + 1]][0]
        raise InputError(f"{file}, line {number}: the number in this image's name is that of an earlier image's, too")
    where = [f"{file}, line {images[row][0]}" for row in order]
    values = np.array([parse_row(images[row][1].split()[1:8], place) for row, place in zip(order, where, strict=True)])
    xyzw = np.roll(values[:, :4], -1, axis=1)
    T = rigid(from_quaternions(xyzw, values[:, 4:] * MM_PER_UNIT[unit], where), where)
    source = f"COLMAP images.txt, world-to-camera inverted, scale arbitrary, {unit} (assumed)"
    return stamped(inverse(T), frames[order], None, source)


def _frame_of(line: str, where: str) -> int:
    name = line.split(maxsplit=_FIELDS_BEFORE_NAME)[_FIELDS_BEFORE_NAME]
    digits = re.findall(r"\d+", PurePosixPath(name).stem)
    if not digits or int(digits[-1]) > np.iinfo(np.int64).max:
        raise InputError(f"{where}: the image name {name!r} holds no number that could be the frame's")
    return int(digits[-1])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
