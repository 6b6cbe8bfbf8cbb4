"""COLMAP models (colmap.github.io/format.html), text or binary; pixels count from the corner: half a px more."""

from __future__ import annotations

import io
import lzma
import math
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from struct import Struct
from typing import IO, Any

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.input.camera_files.calibration import LARGEST_SIDE_PX, check_plausible
from scopemap.input.camera_files.lens import with_lens

# How many parameters each model has; its place here is its number in binary files.
_PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4,
    "EUCM": 6, "EQUIRECTANGULAR": 2,
}  # fmt: skip
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYES = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
_READ = (*_PERSPECTIVE, "FOV", *_FISHEYES)
_OF_ONE_FOCAL_LENGTH = tuple(name for name in _READ if name.startswith(("SIMPLE", "RADIAL")))
_CORNER_TO_CENTRE_PX = 0.5
_MODEL_NAME = re.compile(r"[A-Z][A-Z_]{2,39}")
_ADVICE = (
    f"reconstruct with {', '.join(_READ[:-1])} or {_READ[-1]}, undistort the images with COLMAP, or put a calibration "
    "(camera.yaml) into the folder"
)
_COUNT = Struct("<Q")
_CAMERA = Struct("<IiQQ")  # number, number of the model, width, height; then the parameters, double
_IMAGE = Struct("<I7dI")  # number, qw qx qy qz tx ty tz, number of the camera; then name, 0, count of points, points
_POINT_BYTES = 24
_PIECE_BYTES = 1 << 20
_MOST_IMAGES = 1_000_000
_LONGEST_NAME_BYTES = 4096
_FIELDS_BEFORE_NAME = 9
_MODEL_IN_ARCHIVE = re.compile(r"(?:.*/)?sparse/(\d{1,9})/images\.bin")
_DAMAGED_ARCHIVE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError, ValueError)


@dataclass(frozen=True)
class ModelCamera:
    """A camera of a model: its model's name, image size in px, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """An image of a model: path below the folder of the images, camera, qw qx qy qz tx ty tz world to camera."""

    name: str
    camera: int
    values: tuple[float, ...]
    where: str

    @property
    def is_posed(self) -> bool:
        """Whether all values of the pose are finite."""
        return all(map(math.isfinite, self.values))

    @property
    def path(self) -> PurePosixPath:
        """Its path below the folder of the images, also of a name with backslashes."""
        return PurePosixPath(self.name.replace("\\", "/"))


def model_files(folder: Path) -> tuple[Path, Path] | None:
    """Return the files (cameras, images) of the model in `folder`, binary before text as COLMAP does, or None."""
    pairs = ((folder / f"cameras{ending}", folder / f"images{ending}") for ending in (".bin", ".txt"))
    return next((pair for pair in pairs if pair[0].is_file() and pair[1].is_file()), None)


def read_cameras(file: Path) -> dict[int, ModelCamera]:
    """Return the cameras of a model by number; `CalibrationError` for a file that is damaged."""
    try:
        with file.open("rb") as stream:
            is_binary = file.suffix == ".bin" or b"\0" in stream.read(_COUNT.size)
            stream.seek(0)
            found = list(_binary_cameras(stream) if is_binary else _text_cameras(stream))
        if again := [number for number, count in Counter(number for number, _ in found).items() if count > 1]:
            raise ValueError(f"camera {again[0]} is repeated; leave one out")
    except (OSError, ValueError) as error:
        raise CalibrationError(f"cannot read the cameras of a COLMAP model from {file}: {error}") from None
    return dict(found)


def read_images(file: Path) -> list[ModelImage]:
    """Return the images of a model; `InputError` for a file that is damaged, holds none, or names one twice."""
    try:
        with file.open("rb") as stream:
            return _images_in(stream, str(file), file.suffix == ".bin")
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the images of a COLMAP model from {file}: {error}") from None


def read_largest_model(archive: Path) -> tuple[list[ModelImage], int, int]:
    """Return the images of the largest model `sparse/<M>/images.bin` in a zip archive, M, and how many there are."""
    try:
        with zipfile.ZipFile(archive) as opened:
            numbers = {name: int(m[1]) for name in opened.namelist() if (m := _MODEL_IN_ARCHIVE.fullmatch(name))}
            if not numbers:
                raise InputError(f"reading {archive}: it holds no COLMAP model (sparse/<number>/images.bin)")
            counts = {name: _taken(opened.open(name), _COUNT)[0] for name in numbers}
            largest = max(numbers, key=lambda name: (counts[name], -numbers[name]))
            with opened.open(largest) as stream:
                images = _images_in(stream, f"{archive}, {largest}", binary=True)
    except _DAMAGED_ARCHIVE as error:
        raise InputError(f"reading {archive}: the archive is damaged or incomplete ({error})") from None
    return images, numbers[largest], len(numbers)


def is_cameras_text(text: str) -> bool:
    """Whether the first line that is no comment begins as `CAMERA_ID MODEL` does."""
    lines = (line.split() for line in text.splitlines() if line.strip() and not line.startswith("#"))
    fields = next(lines, [])
    return len(fields) > 3 and fields[0].isdecimal() and bool(_MODEL_NAME.fullmatch(fields[1]))


def is_cameras_binary(content: bytes) -> bool:
    """Whether content begins as `cameras.bin` does: a count, then a camera of a known model."""
    if len(content) < _COUNT.size + _CAMERA.size:
        return False
    (count,), (_, model, width, height) = _COUNT.unpack_from(content), _CAMERA.unpack_from(content, _COUNT.size)
    return bool(0 < count <= len(content) and 0 <= model < len(_PARAMETERS) and width and height)


def is_image_line(line: str) -> bool:
    """Whether a line of text gives the pose of an image: nine numbers, then a name; lines of points are all numbers."""
    *numbers, name = line.split(maxsplit=_FIELDS_BEFORE_NAME) or [""]
    is_row = len(numbers) == _FIELDS_BEFORE_NAME and all(map(_is_number, numbers))
    return is_row and not _is_number(name.split()[0])


def only_camera(file: Path) -> CameraModel:
    """Return the camera of a file that holds one; `CalibrationError` for any other file."""
    cameras = read_cameras(file)
    if len(cameras) != 1:
        held = f"{len(cameras)} cameras (COLMAP): leave the one of these images in it"
        raise CalibrationError(f"the calibration {file} holds {held}")
    ((number, camera),) = cameras.items()
    return camera_model(camera, f"camera {number} of {file}")


def camera_model(camera: ModelCamera, name: str) -> CameraModel:
    """Return the camera for pixel centres that count from 0; `CalibrationError` for what has no counterpart here."""
    if camera.model not in _READ:
        raise CalibrationError(f"{name} is of the model {camera.model}, which is not read: {_ADVICE}")
    found, wanted = len(camera.parameters), _PARAMETERS[camera.model]
    if found != wanted:
        raise CalibrationError(f"{name}: found {found} parameters where the model {camera.model} has {wanted}")
    if not (0 < camera.width <= LARGEST_SIDE_PX and 0 < camera.height <= LARGEST_SIDE_PX):
        raise CalibrationError(f"{name} has an invalid image size, {camera.width}x{camera.height} px")
    if not all(map(math.isfinite, camera.parameters)):
        raise CalibrationError(f"{name}: a parameter is NaN or infinity")
    doubled = camera.parameters[:1] if camera.model in _OF_ONE_FOCAL_LENGTH else ()
    fx, fy, cx, cy, *lens = (*doubled, *camera.parameters)
    size = (camera.width, camera.height)
    central = PinholeCamera(fx, fy, cx - _CORNER_TO_CENTRE_PX, cy - _CORNER_TO_CENTRE_PX, *size)
    words = "fisheye" if camera.model in _FISHEYES else "fov" if camera.model == "FOV" else "opencv"
    if words != "fov":
        lens += [0.0] * (4 - len(lens))
    try:
        model, _ = with_lens(central, words, lens)
    except ValueError as error:
        raise CalibrationError(f"{name}: {error}") from None
    check_plausible(model, name)
    return model


def _text_cameras(stream: IO[bytes]) -> Iterator[tuple[int, ModelCamera]]:
    # Comments may have any encoding.
    for number, line in enumerate(io.TextIOWrapper(stream, "utf-8-sig", errors="replace"), start=1):
        fields = line.split()
        if not fields or line.startswith("#"):
            continue
        try:
            key, width, height = (int(fields[i]) for i in (0, 2, 3))
            yield key, ModelCamera(fields[1], width, height, tuple(float(field) for field in fields[4:]))
        except (IndexError, ValueError):
            expected = "expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
            raise ValueError(f"line {number}: {expected}, found {line.strip()[:60]!r}") from None


def _binary_cameras(stream: IO[bytes]) -> Iterator[tuple[int, ModelCamera]]:
    models = list(_PARAMETERS)
    (count,) = _taken(stream, _COUNT)
    for _ in range(count):
        key, model, width, height = _taken(stream, _CAMERA)
        if not 0 <= model < len(models):
            raise ValueError(f"camera {key} is of an unknown model, number {model}; {_ADVICE}")
        parameters = _taken(stream, Struct(f"<{_PARAMETERS[models[model]]}d"))
        yield key, ModelCamera(models[model], width, height, parameters)
    _check_end(stream)


def _images_in(stream: IO[bytes], where: str, binary: bool) -> list[ModelImage]:
    images = list((_binary_images if binary else _text_images)(stream, where))
    if not images:
        raise ValueError("it holds no image with its pose")
    last = {image.path: image for image in images}
    if again := [last[image.path] for image in images if last[image.path] is not image]:
        raise ValueError(f"the image {again[0].name!r} is repeated ({again[0].where}); leave one out")
    return images


def _text_images(stream: IO[bytes], where: str) -> Iterator[ModelImage]:
    """Yield the images of `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`; lines of points, all numbers, are skipped."""
    for number, line in enumerate(io.TextIOWrapper(stream, "utf-8"), start=1):
        if line.startswith("#"):
            continue
        if is_image_line(line):
            _, *values, camera, name = line.split(maxsplit=_FIELDS_BEFORE_NAME)
            if not re.fullmatch(r"[0-9]{1,10}", camera):
                raise ValueError(f"line {number}: expected the number of a camera before the name, found {camera!r}")
            yield ModelImage(name.strip(), int(camera), tuple(map(float, values)), f"{where}, line {number}")
        elif line.strip() and not _is_number(line.split()[-1]):
            expected = "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, or numbers"
            raise ValueError(f"line {number}: {expected}, found {line.strip()[:60]!r}")


def _binary_images(stream: IO[bytes], where: str) -> Iterator[ModelImage]:
    (count,) = _taken(stream, _COUNT)
    if count > _MOST_IMAGES:
        raise ValueError(f"it claims {count} images, expected {_MOST_IMAGES} at most")
    for position in range(count):
        _, *values, camera = _taken(stream, _IMAGE)
        name = b""
        while (letter := stream.read(1)) not in (b"\0", b"") and len(name) < _LONGEST_NAME_BYTES:
            name += letter
        if letter != b"\0" or not name:
            raise ValueError(f"image {position + 1} has no name; it is damaged or cut off")
        (points,) = _taken(stream, _COUNT)
        left = _POINT_BYTES * points
        while left > 0:  # a piece at a time: it is no more than a claim
            left -= len(_bytes(stream, min(left, _PIECE_BYTES)))
        yield ModelImage(name.decode(), camera, tuple(values), f"{where}, image {position + 1}")
    _check_end(stream)


def _check_end(stream: IO[bytes]) -> None:
    if stream.read(1):
        raise ValueError("bytes are left after the last entry; it is damaged")


def _taken(stream: IO[bytes], form: Struct) -> tuple[Any, ...]:
    """Return the next values, of the types in `form`."""
    return form.unpack(_bytes(stream, form.size))


def _bytes(stream: IO[bytes], size: int) -> bytes:
    content = stream.read(size)
    if len(content) < size:
        raise ValueError("it is cut off; write the model again")
    return content


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
