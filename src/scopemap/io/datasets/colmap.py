"""COLMAP: images with the model that structure from motion made of them, text or binary.

The images lie in `images`, or beside the model's files; the model in the folder itself, in `sparse/0`, `sparse` or
`colmap/sparse/0`. Where several models were made of the images, the folder of any of them (`sparse/1`) can be given.
Schoenberger and Frahm, "Structure-from-motion revisited", CVPR 2016; colmap.github.io/format.html.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from scopemap.cameras.formats.calibration import fitted_to, rescaled_note
from scopemap.cameras.formats.colmap import camera_model, read_cameras
from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.io.datasets.colmap_files import image_path, model_files, read_images
from scopemap.io.images import ImageFolder, image_files
from scopemap.io.source import SourceTruth
from scopemap.trajectory.formats.colmap import ModelImage, poses_of

_MODELS = (".", "sparse/0", "sparse", "colmap/sparse/0")
_DEEPEST_MODEL = 3
_IMAGES = "images"
_MOST_NAMED = 5


class ColmapFolder(ImageFolder):
    """All images of the folder; those in the model have its pose. A `camera.yaml` in the folder wins over its camera.

    Raises `InputError` where the model is damaged or has none of the images. Cameras that are damaged, differ, are of a
    model that has no counterpart here or do not fit are its `camera_fault`.
    """

    name = "colmap"

    def __init__(self, path: Path) -> None:
        found = _model(path)
        if found is None:
            raise InputError(
                f"reading {path}: no COLMAP model, looked for cameras.bin and images.bin, or both as .txt, in "
                f"{', '.join(_MODELS)}"
            )
        cameras_file, images_file = found
        images = read_images(images_file)
        files = _pictures(path, images)
        super().__init__(path, files)
        names = {file.name: number for file, number in zip(files, self.numbers, strict=True)}
        here = {names[name]: image for image in images if (name := image_path(image).name) in names}
        if self.camera is None:
            with self._making_camera():
                self._use_camera(cameras_file, Counter(image.camera for image in here.values()))
        posed = {number: image for number, image in here.items() if image.is_posed}
        if not posed:
            raise InputError(f"reading {images_file}: every pose of the images that are here holds NaN or infinity")
        poses = inverse(poses_of(list(posed.values())))
        self._poses = dict(zip(posed, poses, strict=True))
        self._say(images_file, len(images), len(here))

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether there is a model in `path` or in one of its usual places below, and images beside it."""
        return path.is_dir() and _model(path) is not None and any(_image_folders(path))

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose in the model; None for an image that it does not hold."""
        return self._poses.get(index)

    def truth(self, index: int) -> SourceTruth | None:
        """Return the pose, of arbitrary scale; None for an image that the model does not hold."""
        T_world_camera = self.pose(index)
        return None if T_world_camera is None else SourceTruth(T_world_camera, None, "sfm")

    def _use_camera(self, file: Path, uses: Counter[int]) -> None:
        cameras = read_cameras(file)
        unknown = [number for number in uses if number not in cameras]
        if unknown:
            raise InputError(f"reading {file}: it has no camera {unknown[0]}, by which images of the model were taken")
        most_used = [number for number, _ in uses.most_common()]
        models = {number: camera_model(cameras[number], f"camera {number} of {file}") for number in most_used}
        if len(set(models.values())) > 1:
            named = [f"camera {n}, {cameras[n].model}, {uses[n]} images" for n in most_used[:_MOST_NAMED]]
            raise InputError(
                f"reading {file}: the images were taken by {len(models)} cameras whose intrinsics differ "
                f"({'; '.join(named)}{'; ...' * (len(models) > _MOST_NAMED)}); a sequence has one: reconstruct with a "
                "single camera for all images, or give their calibration (--camera, or as camera.yaml in "
                f"{self.path})"
            )
        camera = models[most_used[0]]
        self.camera = fitted_to(camera, (self.width, self.height), f"camera {most_used[0]} of {file}")
        note = rescaled_note(camera, self.camera)
        self.camera_source = f"COLMAP {file.name}, {cameras[most_used[0]].model}{note}"

    def _say(self, file: Path, in_model: int, here: int) -> None:
        self.notes.append(
            "poses by structure from motion (COLMAP), world-to-camera inverted; scale unknown: units are taken as mm"
        )
        if len(self._poses) < len(self.files):
            self.notes.append(f"{len(self.files) - len(self._poses)} of {len(self.files)} images have no pose")
        others = _other_models(file.parent)
        if others:
            self.notes.append(
                f"{file.parent} was read, one of {len(others) + 1} models, each in a world of its own; the others: "
                f"{', '.join(others[:_MOST_NAMED])}{', ...' * (len(others) > _MOST_NAMED)}"
            )
        if here < in_model:
            self._warn(f"{in_model - here} of {in_model} images in {file} are not beside it and were left out")
        if len(self._poses) < here:
            self._warn(f"{here - len(self._poses)} poses in {file} hold NaN or infinity and were left out")


def _model(path: Path) -> tuple[Path, Path] | None:
    """Return the files (cameras, images) of the first model in its usual places, or None."""
    return next((files for place in _MODELS if (files := model_files(path / place)) is not None), None)


def _image_folders(path: Path) -> Iterator[Path]:
    """Yield the folders in which the images of the model may lie, the likeliest first."""
    if (path / _IMAGES).is_dir():
        yield path / _IMAGES
    if image_files(path):
        yield path
    if model_files(path) is not None:  # the model's own folder was given: `sparse/0`, or one beside `images`
        above = (parent / _IMAGES for parent in path.absolute().parents[:_DEEPEST_MODEL])
        yield from (folder for folder in above if folder.is_dir())


def _pictures(path: Path, images: list[ModelImage]) -> list[Path]:
    """Return all images of the folder that holds those of the model; `InputError` where there is none, or several."""
    inner = sorted({image_path(image).parent for image in images})
    if len(inner) > 1:
        named = ", ".join(repr(str(folder)) for folder in inner[:_MOST_NAMED]) + ", ..." * (len(inner) > _MOST_NAMED)
        raise InputError(
            f"reading {path}: the images of the COLMAP model lie in {len(inner)} folders ({named}), a sequence in one; "
            "reconstruct one of them, or leave the others out of the model"
        )
    wanted = {image_path(image).name for image in images}
    for folder in _image_folders(path):
        for place in (_below(folder, inner[0].parts), folder):
            files = image_files(place) if place is not None else []
            if any(file.name in wanted for file in files):
                return files
    raise InputError(
        f"reading {path}: none of the {len(images)} images in the COLMAP model (such as {images[0].name!r}) is there; "
        f"put them into {path / _IMAGES}"
    )


def _below(folder: Path, parts: tuple[str, ...]) -> Path | None:
    """Return the folder at `parts` below `folder`; the names were written by anyone, so none leads out of it."""
    for part in parts:
        inner = next((inner for inner in folder.iterdir() if inner.name == part and inner.is_dir()), None)
        if inner is None:
            return None
        folder = inner
    return folder


def _other_models(folder: Path) -> list[str]:
    """Return the names of the numbered models beside the one in `folder`."""
    if not folder.name.isdecimal():
        return []
    beside = (other for other in folder.absolute().parent.iterdir() if other.name.isdecimal() and other.is_dir())
    return sorted((o.name for o in beside if o.name != folder.name and model_files(o) is not None), key=int)
