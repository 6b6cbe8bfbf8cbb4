"""The files of a COLMAP model, text and binary: `cameras` and `images` (colmap.github.io/format.html).

Binary files are little-endian. `images.bin`: a count (uint64); per image its number (uint32), qw qx qy qz tx ty tz
(double), its camera's number (uint32), its name ending in a zero byte, a count of points (uint64), 24 bytes each.
`cameras.bin`: a count (uint64); per camera its number (uint32), its model's (int32), width, height (uint64), parameters
(double). COLMAP's pixels count from the corner of the image, so principal points are half a pixel larger than here.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from struct import Struct

from scopemap.camera import CameraModel, PinholeCamera
from scopemap.errors import CalibrationError, InputError
from scopemap.lenses import FisheyeCamera, OpenCvCamera
from scopemap.trajectories.colmap import ModelImage, read_text_images

# How many parameters each model has; its place here is its number in binary files.
_PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}  # fmt: skip
_READ = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
_OF_ONE_FOCAL_LENGTH = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_CORNER_TO_CENTRE_PX = 0.5
_FOCAL_PER_WIDTH = (0.3, 5.0)
_LARGEST_SIDE_PX = 100_000

_COUNT = Struct("<Q")
_IMAGE = Struct("<I7dI")
_CAMERA = Struct("<IiQQ")
_POINT_BYTES = 24
_LONGEST_NAME_BYTES = 4096
# An image has at least a letter and the end of its name, and a count of points; a camera at least three parameters.
_SMALLEST_IMAGE_BYTES = _IMAGE.size + 2 + _COUNT.size
_SMALLEST_CAMERA_BYTES = _CAMERA.size + 24


@dataclass(frozen=True)
class ModelCamera:
    """A camera as it stands in the file: its model's name, image size in px, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


def model_files(folder: Path) -> tuple[Path, Path] | None:
    """Return the files (cameras, images) of the model in `folder`, binary before text as COLMAP does, or None."""
    pairs = ((folder / f"cameras{ending}", folder / f"images{ending}") for ending in (".bin", ".txt"))
    return next((pair for pair in pairs if pair[0].is_file() and pair[1].is_file()), None)


def read_images(file: Path) -> list[ModelImage]:
    """Return the images of a model; `InputError` for a file that is damaged, holds none, or names one twice."""
    images = _binary_images(file) if file.suffix == ".bin" else read_text_images(file)
    if not images:
        raise InputError(f"reading {file}: the COLMAP model holds no image with its pose")
    seen: set[PurePosixPath] = set()
    for image in images:
        if image_path(image) in seen:
            raise InputError(f"{image.where}: the image {image.name!r} comes again; leave one out")
        seen.add(image_path(image))
    return images


def image_path(image: ModelImage) -> PurePosixPath:
    """Return the image's path below the folder of the images, also where a name was written with backslashes."""
    return PurePosixPath(image.name.replace("\\", "/"))


def read_cameras(file: Path) -> dict[int, ModelCamera]:
    """Return the cameras of a model by number; `CalibrationError` or `InputError` for a file that is damaged."""
    cameras: dict[int, ModelCamera] = {}
    for number, camera in _binary_cameras(file) if file.suffix == ".bin" else _text_cameras(file):
        if number in cameras:
            raise CalibrationError(f"reading {file}: camera {number} comes again; leave one out")
        cameras[number] = camera
    return cameras


def camera_model(camera: ModelCamera, name: str) -> CameraModel:
    """Return the camera for pixel centres that count from 0; `name` is what errors call it.

    Raises `CalibrationError` for a model that has no counterpart here, and for parameters that fit no such images.
    """
    if camera.model not in _READ:
        raise CalibrationError(
            f"{name} is of the model {camera.model}, which is not read: reconstruct with {', '.join(_READ[:-1])} or "
            f"{_READ[-1]}, undistort the images with COLMAP, or put a calibration (camera.yaml) into the folder"
        )
    if len(camera.parameters) != _PARAMETERS[camera.model]:
        raise CalibrationError(
            f"{name}: found {len(camera.parameters)} parameters where the model {camera.model} has "
            f"{_PARAMETERS[camera.model]}"
        )
    doubled = camera.parameters[:1] if camera.model in _OF_ONE_FOCAL_LENGTH else ()
    fx, fy, cx, cy, *lens = (*doubled, *camera.parameters)
    size = (camera.width, camera.height)
    central = PinholeCamera(fx, fy, cx - _CORNER_TO_CENTRE_PX, cy - _CORNER_TO_CENTRE_PX, *size)
    _check_plausible(central, camera.parameters, name)
    if camera.model == "OPENCV_FISHEYE":
        return FisheyeCamera(central, tuple(lens))
    return OpenCvCamera(central, (*lens, 0.0, 0.0, 0.0)[:4]) if any(lens) else central


def _check_plausible(central: PinholeCamera, parameters: tuple[float, ...], name: str) -> None:
    width, height = central.width, central.height
    least, most = _FOCAL_PER_WIDTH
    if not (0 < width <= _LARGEST_SIDE_PX and 0 < height <= _LARGEST_SIDE_PX):
        raise CalibrationError(f"{name} is for images of {width}x{height} px, which are none")
    if not all(map(math.isfinite, parameters)):
        raise CalibrationError(f"{name}: a parameter is NaN or infinity")
    focal_fits = all(least * width < focal < most * width for focal in (central.fx, central.fy))
    if not (focal_fits and 0 <= central.cx < width and 0 <= central.cy < height):
        raise CalibrationError(
            f"{name} does not fit images of {width}x{height} px: focal length {central.fx:g}, {central.fy:g} px "
            f"(plausible: {least * width:g} to {most * width:g}), principal point {central.cx:g}, {central.cy:g}"
        )


def _text_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"cannot read the cameras of a COLMAP model from {file}: {error}") from None
    for number, line in enumerate(lines, start=1):
        fields = line.split()
        if not fields or line.startswith("#"):
            continue
        try:
            model, (key, width, height) = fields[1], (int(fields[i]) for i in (0, 2, 3))
            parameters = tuple(float(field) for field in fields[4:])
        except (IndexError, ValueError):
            raise CalibrationError(
                f"{file}, line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {line.strip()[:60]!r}"
            ) from None
        yield key, ModelCamera(model, width, height, parameters)


def _binary_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    names = list(_PARAMETERS)
    with _opened(file) as content:
        for _ in range(content.count(_SMALLEST_CAMERA_BYTES, "cameras")):
            key, model, width, height = content.take(_CAMERA)
            if not 0 <= model < len(names):
                raise CalibrationError(
                    f"reading {file}: camera {key} is of a model with the number {model}, of which nothing is known; "
                    f"reconstruct with {', '.join(_READ[:-1])} or {_READ[-1]}, or put a calibration (camera.yaml) into "
                    "the folder"
                )
            name = names[model]
            yield key, ModelCamera(name, width, height, content.take(Struct(f"<{_PARAMETERS[name]}d")))
        content.check_end()


def _binary_images(file: Path) -> list[ModelImage]:
    images = []
    with _opened(file) as content:
        for position in range(content.count(_SMALLEST_IMAGE_BYTES, "images")):
            _, *values, camera = content.take(_IMAGE)
            images.append(ModelImage(content.name(), camera, tuple(values), f"{file}, image {position + 1}"))
            content.skip(_POINT_BYTES * content.count(_POINT_BYTES, "points of an image"))
        content.check_end()
    return images


class _Content:
    """A binary file that is walked through; what its counts claim is believed only as far as it has bytes."""

    def __init__(self, file: Path, content: mmap.mmap) -> None:
        self._file, self._content, self._at = file, content, 0

    def take(self, form: Struct) -> tuple:
        """Return the next values, of the types in `form`."""
        start = self._at
        self.skip(form.size)
        return form.unpack(self._content[start : self._at])

    def count(self, least_bytes: int, what: str) -> int:
        """Return the next count, of `what` that takes `least_bytes` each at least."""
        (count,) = self.take(_COUNT)
        left = len(self._content) - self._at
        if count * least_bytes > left:
            raise InputError(
                f"reading {self._file}: it claims to hold {count} {what}, but has only {left} bytes left for them; it "
                "is damaged or cut off, write the COLMAP model anew"
            )
        return int(count)

    def name(self) -> str:
        """Return the next name, which ends in a zero byte."""
        start, most = self._at, self._at + _LONGEST_NAME_BYTES
        end = self._content.find(b"\0", start, most)
        if end <= start:
            raise InputError(f"reading {self._file}: no name of an image at byte {start}; it is damaged or cut off")
        self._at = end + 1
        try:
            return self._content[start:end].decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(f"reading {self._file}: the name at byte {start} is no text; it is damaged") from None

    def skip(self, size: int) -> None:
        """Pass over `size` bytes."""
        if self._at + size > len(self._content):
            raise InputError(f"reading {self._file}: it is cut off after {len(self._content)} bytes")
        self._at += size

    def check_end(self) -> None:
        """Raise `InputError` where bytes are left."""
        left = len(self._content) - self._at
        if left:
            raise InputError(f"reading {self._file}: {left} bytes are left after the last entry; it is damaged")


@contextmanager
def _opened(file: Path) -> Iterator[_Content]:
    try:
        with file.open("rb") as opened:
            # Mapped, since points, which are passed over, are most of a large model.
            content = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read a COLMAP model from {file}: {error}") from None
    with content:
        yield _Content(file, content)
