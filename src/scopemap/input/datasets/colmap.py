"""COLMAP: images (in `images` or beside the model) and their model, in `.`, `sparse/0`, `sparse`, `colmap/sparse/0`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from scopemap.engine.errors import InputError
from scopemap.input.camera_files.colmap_model import ModelImage, camera_model, model_files, read_cameras, read_images
from scopemap.input.images import ImageFolder, image_files
from scopemap.input.trajectory.colmap_poses import camera_poses

_MODELS = (".", "sparse/0", "sparse", "colmap/sparse/0")
_DEEPEST_MODEL = 3
_IMAGES = "images"


class ColmapFolder(ImageFolder):
    """All images of the folder; those in the model have its pose. A `camera.yaml` in the folder wins over its camera.

    Raises `InputError` where the model is damaged or has none of the images. Cameras that are damaged, differ, do not
    fit, or have a model without a counterpart here are its `camera_fault`.
    """

    name = "colmap"
    quality = "sfm"

    def __init__(self, path: Path) -> None:
        if (found := _model(path)) is None:
            looked_for = "cameras.bin and images.bin, or both as .txt"
            raise InputError(f"reading {path}: no COLMAP model, looked for {looked_for}, in {', '.join(_MODELS)}")
        cameras_file, images_file = found
        images = read_images(images_file)
        files = _files_of(path, images)
        super().__init__(path, files)
        names = {file.name: number for file, number in zip(files, self.numbers, strict=True)}
        here = {names[image.path.name]: image for image in images if image.path.name in names}
        if self.camera is None:
            with self._making_camera():
                self._use_camera(cameras_file, {image.camera for image in here.values()})
        posed = {number: image for number, image in here.items() if image.is_posed}
        if not posed:
            raise InputError(f"reading {images_file}: every pose of the images that are here holds NaN or infinity")
        self.poses = dict(zip(posed, camera_poses(list(posed.values())), strict=True))
        self._report_model(images_file, len(images), len(here))

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether there is a model in `path` or in one of its usual places below, and images beside it."""
        return path.is_dir() and _model(path) is not None and any(_image_folders(path))

    def _use_camera(self, file: Path, uses: set[int]) -> None:
        cameras = read_cameras(file)
        unknown = [number for number in uses if number not in cameras]
        if unknown:
            raise InputError(f"reading {file}: it has no camera {unknown[0]}, by which images of the model were taken")
        models = {number: camera_model(cameras[number], f"camera {number} of {file}") for number in uses}
        if len(set(models.values())) > 1:
            advice = "reconstruct with a single camera for all images, or give their calibration (--camera)"
            differ = f"the images were taken by {len(models)} cameras whose intrinsics differ; a sequence has one"
            raise InputError(f"reading {file}: {differ}: {advice}")
        number, camera = next(iter(models.items()))
        self._set_camera(camera, f"COLMAP {file.name}, {cameras[number].model}", f"camera {number} of {file}")

    def _report_model(self, file: Path, in_model: int, here: int) -> None:
        self.notes.append(
            "poses come from structure from motion (COLMAP, world-to-camera); their unknown scale is read as mm"
        )
        if len(self.poses) < len(self.files):
            self.notes.append(f"{len(self.files) - len(self.poses)} of {len(self.files)} images have no pose")
        if here < in_model:
            self._warn(f"{in_model - here} of {in_model} images in {file} are not beside it and were left out")
        if len(self.poses) < here:
            self._warn(f"{here - len(self.poses)} poses in {file} hold NaN or infinity and were left out")


def _model(path: Path) -> tuple[Path, Path] | None:
    return next((files for place in _MODELS if (files := model_files(path / place)) is not None), None)


def _image_folders(path: Path) -> Iterator[Path]:
    """Yield the folders in which the images of the model may be, the likeliest first."""
    if (path / _IMAGES).is_dir():
        yield path / _IMAGES
    if image_files(path):
        yield path
    if model_files(path) is not None:  # the model's own folder was given: `sparse/0`, or one beside `images`
        above = (parent / _IMAGES for parent in path.absolute().parents[:_DEEPEST_MODEL])
        yield from (folder for folder in above if folder.is_dir())


def _files_of(path: Path, images: list[ModelImage]) -> list[Path]:
    """Return all images of the folder that holds those of the model; `InputError` where there is none, or several."""
    inner = sorted({image.path.parent for image in images})
    if len(inner) > 1:
        several = f"the images of the COLMAP model are in {len(inner)} folders, a sequence in one"
        raise InputError(f"reading {path}: {several}; reconstruct one of them, or leave the others out of the model")
    wanted = {image.path.name for image in images}
    # Names from a file of unknown origin must not lead out of the folder.
    stays_inside = not inner[0].is_absolute() and ".." not in inner[0].parts
    for folder in _image_folders(path):
        # Path.is_dir raises for names that no file system allows.
        for place in (folder / inner[0], folder) if stays_inside and os.path.isdir(folder / inner[0]) else (folder,):
            files = image_files(place)
            if any(file.name in wanted for file in files):
                return files
    none = f"none of the {len(images)} images in the COLMAP model (such as {images[0].name!r}) is there"
    raise InputError(f"reading {path}: {none}; put them into {path / _IMAGES}")
