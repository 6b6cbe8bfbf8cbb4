"""Trajectories of COLMAP models: the poses of the images, whose number is the last one in their names."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import inverse
from scopemap.input.camera_files.colmap_model import ModelImage, read_images
from scopemap.input.trajectory.poses import file_of, from_quaternions, rigid, stamped
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

COLMAP_FILES = ("images.txt", "sparse/0/images.txt", "sparse/images.txt")


def camera_poses(images: list[ModelImage], mm_per_unit: float = 1.0) -> np.ndarray:
    """Return T_world_camera (N, 4, 4), mm; `InputError` at the first pose that is not rigid."""
    where = [image.where for image in images]
    values = np.array([image.values for image in images], dtype=np.float64).reshape(-1, 7)
    xyzw = np.roll(values[:, :4], -1, axis=1)
    return inverse(rigid(from_quaternions(xyzw, values[:, 4:] * mm_per_unit, where), where))


def read_colmap(path: Path, unit: Unit) -> Trajectory:
    """Read the registered images of a text model, in the order of their numbers; others have no pose and no row."""
    file = file_of(path, COLMAP_FILES)
    images = read_images(file)
    numbers = [[int(digits) for digits in re.findall(r"\d+", image.path.stem)[-1:]] for image in images]
    for image, found in zip(images, numbers, strict=True):
        if not found or found[0] > np.iinfo(np.int64).max:
            raise InputError(f"{image.where}: the image name {image.name!r} holds no number that could be the frame's")
    frames = np.ravel(numbers)
    order = np.argsort(frames, kind="stable")
    repeated = np.flatnonzero(np.diff(frames[order]) == 0)
    if repeated.size:
        where = images[order[repeated[0] + 1]].where
        raise InputError(f"{where}: the number in this image's name is that of an earlier image's, too")
    T_world_camera = camera_poses([images[row] for row in order], MM_PER_UNIT[unit])
    source = f"COLMAP {file.name}, world-to-camera inverted, scale arbitrary, {unit} (assumed)"
    return stamped(T_world_camera, frames[order], None, source)
