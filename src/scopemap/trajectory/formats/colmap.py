"""COLMAP's `images.txt`: `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, each followed by a line of image points.

The pose takes a point in the world to the camera, quaternion with the scalar first, OpenCV axes; the scale is arbitrary
(colmap.github.io/format.html). The last number in an image's name is the frame's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.trajectory.formats.poses import file_of, from_quaternions, rigid, stamped
from scopemap.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

COLMAP_FILES = ("images.txt", "sparse/0/images.txt", "sparse/images.txt")
_FIELDS_BEFORE_NAME = 9
_FIELDS_OF_POINT = 3


@dataclass(frozen=True)
class ModelImage:
    """An image of a COLMAP model, as it stands in the file.

    Attributes
    ----------
    name : its path below the folder of the images.
    camera : number of its camera.
    values : qw qx qy qz tx ty tz, takes a point in the world to the camera, in units of the model.
    where : file and place in it, for errors.
    """

    name: str
    camera: int
    values: tuple[float, ...]
    where: str

    @property
    def is_posed(self) -> bool:
        """Whether all values of the pose are finite."""
        return bool(np.isfinite(self.values).all())


def is_image_line(line: str) -> bool:
    """Whether a line gives the pose of an image: nine numbers, then a name; lines of points are numbers throughout."""
    fields = line.split(maxsplit=_FIELDS_BEFORE_NAME)
    return (
        len(fields) > _FIELDS_BEFORE_NAME
        and all(_is_number(field) for field in fields[:_FIELDS_BEFORE_NAME])
        and not _is_number(fields[_FIELDS_BEFORE_NAME].split()[0])
    )


def read_text_images(file: Path) -> list[ModelImage]:
    """Return the images of a text model in the order of the file; `InputError`, with the line, at anything else.

    The lines of points may be empty or, as some tools write them, not be there.
    """
    images: list[ModelImage] = []
    points_may_follow = False
    for number, line in _lines(file):
        where = f"{file}, line {number}"
        if line.startswith("#"):
            continue
        if is_image_line(line):
            images.append(_image(line, where))
            points_may_follow = True
        elif line.strip() and not (points_may_follow and _is_points_line(line)):
            raise InputError(
                f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and below it points of three numbers "
                f"each, found {line.strip()[:60]!r}"
            )
        else:
            points_may_follow = False
    return images


def poses_of(images: list[ModelImage], mm_per_unit: float = 1.0) -> np.ndarray:
    """Return T_camera_world (N, 4, 4), mm; `InputError` at the first pose that is not rigid."""
    if not images:
        return np.empty((0, 4, 4))
    where = [image.where for image in images]
    values = np.array([image.values for image in images], dtype=np.float64)
    unknown = next((image for image in images if not image.is_posed), None)
    if unknown is not None:
        raise InputError(f"{unknown.where}: a pose holds NaN or infinity; leave out frames without a pose")
    xyzw = np.roll(values[:, :4], -1, axis=1)
    return rigid(from_quaternions(xyzw, values[:, 4:] * mm_per_unit, where), where)


def read_colmap(path: Path, unit: Unit) -> Trajectory:
    """Read the registered images of a text model, in the order of their numbers; others have no pose and no row."""
    file = file_of(path, COLMAP_FILES)
    images = read_text_images(file)
    if not images:
        raise InputError(f"cannot read a trajectory from {file}: it holds no line of an image with its pose")
    frames = np.array([_frame_of(image) for image in images])
    order = np.argsort(frames, kind="stable")
    repeated = np.flatnonzero(np.diff(frames[order]) == 0)
    if repeated.size:
        where = images[order[repeated[0] + 1]].where
        raise InputError(f"{where}: the number in this image's name is that of an earlier image's, too")
    T = poses_of([images[row] for row in order], MM_PER_UNIT[unit])
    source = f"COLMAP images.txt, world-to-camera inverted, scale arbitrary, {unit} (assumed)"
    return stamped(inverse(T), frames[order], None, source)


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line, from 1; lines of points can make a file too large to hold at once."""
    try:
        with file.open(encoding="utf-8") as lines:
            yield from enumerate(lines, start=1)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the images of a COLMAP model from {file}: {error}") from None


def _image(line: str, where: str) -> ModelImage:
    _, *values, camera, name = line.split(maxsplit=_FIELDS_BEFORE_NAME)
    if not re.fullmatch(r"[0-9]{1,10}", camera):
        raise InputError(f"{where}: expected the number of a camera before the name, found {camera!r}")
    return ModelImage(name.strip(), int(camera), tuple(float(value) for value in values), where)


def _is_points_line(line: str) -> bool:
    """Whether a line holds points; there may be thousands, so the first alone is looked at."""
    fields = line.split()
    return len(fields) % _FIELDS_OF_POINT == 0 and all(_is_number(field) for field in fields[:_FIELDS_OF_POINT])


def _frame_of(image: ModelImage) -> int:
    digits = re.findall(r"\d+", PurePosixPath(image.name).stem)
    if not digits or int(digits[-1]) > np.iinfo(np.int64).max:
        raise InputError(f"{image.where}: the image name {image.name!r} holds no number that could be the frame's")
    return int(digits[-1])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
