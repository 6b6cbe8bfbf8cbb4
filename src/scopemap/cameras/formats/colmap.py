"""COLMAP's cameras, `cameras.txt` and `cameras.bin` (colmap.github.io/format.html, colmap.github.io/cameras.html).

`cameras.bin`: a count (uint64); per camera its number (uint32), its model's (int32), width, height (uint64), parameters
(double). COLMAP's pixels count from the corner of the image, so principal points are half a pixel larger than here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from struct import Struct

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.calibration import LARGEST_SIDE_PX, check_plausible
from scopemap.cameras.formats.colmap_binary import opened_model
from scopemap.cameras.lenses import FisheyeCamera, FovCamera, OpenCvCamera
from scopemap.errors import CalibrationError

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
_OF_ONE_FOCAL_LENGTH = (
    *("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
)
_CORNER_TO_CENTRE_PX = 0.5
_MODEL_NAME = re.compile(r"[A-Z][A-Z_]{2,39}")
_ADVICE = (
    f"reconstruct with {', '.join(_READ[:-1])} or {_READ[-1]}, undistort the images with COLMAP, or put a calibration "
    "(camera.yaml) into the folder"
)

_COUNT = Struct("<Q")
_CAMERA = Struct("<IiQQ")
# A camera has two parameters at least.
_SMALLEST_CAMERA_BYTES = _CAMERA.size + 16


@dataclass(frozen=True)
class ModelCamera:
    """A camera as it stands in the file: its model's name, image size in px, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


def is_cameras_text(text: str) -> bool:
    """Whether the first line that is no comment begins as `CAMERA_ID MODEL` does."""
    lines = (line.split() for line in text.splitlines() if line.strip() and not line.startswith("#"))
    fields = next(lines, [])
    return len(fields) > 3 and fields[0].isdecimal() and bool(_MODEL_NAME.fullmatch(fields[1]))


def is_cameras_binary(content: bytes) -> bool:
    """Whether content begins as `cameras.bin` does: a count, then a camera of a model that is known."""
    if len(content) < _COUNT.size + _SMALLEST_CAMERA_BYTES:
        return False
    (count,) = _COUNT.unpack_from(content)
    _, model, width, height = _CAMERA.unpack_from(content, _COUNT.size)
    return bool(0 < count <= len(content) and 0 <= model < len(_PARAMETERS) and width and height)


def only_camera(file: Path, *, binary: bool) -> CameraModel:
    """Return the camera of a file that holds one; `CalibrationError` or `InputError` for any other file."""
    cameras = list(_binary_cameras(file) if binary else _text_cameras(file))
    if len(cameras) != 1:
        raise CalibrationError(
            f"the calibration {file} holds {len(cameras)} cameras (COLMAP): leave the one of these images in it"
        )
    ((number, camera),) = cameras
    return camera_model(camera, f"camera {number} of {file}")


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
        raise CalibrationError(f"{name} is of the model {camera.model}, which is not read: {_ADVICE}")
    if len(camera.parameters) != _PARAMETERS[camera.model]:
        raise CalibrationError(
            f"{name}: found {len(camera.parameters)} parameters where the model {camera.model} has "
            f"{_PARAMETERS[camera.model]}"
        )
    if not (0 < camera.width <= LARGEST_SIDE_PX and 0 < camera.height <= LARGEST_SIDE_PX):
        raise CalibrationError(f"{name} is for images of {camera.width}x{camera.height} px, which are none")
    if not all(map(math.isfinite, camera.parameters)):
        raise CalibrationError(f"{name}: a parameter is NaN or infinity")
    doubled = camera.parameters[:1] if camera.model in _OF_ONE_FOCAL_LENGTH else ()
    fx, fy, cx, cy, *lens = (*doubled, *camera.parameters)
    size = (camera.width, camera.height)
    central = PinholeCamera(fx, fy, cx - _CORNER_TO_CENTRE_PX, cy - _CORNER_TO_CENTRE_PX, *size)
    try:
        model = _with_lens(camera.model, central, lens)
    except ValueError as error:
        raise CalibrationError(f"{name}: {error}") from None
    check_plausible(model, name)
    return model


def _with_lens(model: str, central: PinholeCamera, lens: list[float]) -> CameraModel:
    if model in _FISHEYES:
        return FisheyeCamera(central, (*lens, 0.0, 0.0, 0.0, 0.0)[:4])
    if not any(lens):
        return central
    if model == "FOV":
        return FovCamera(central, lens[0])
    return OpenCvCamera(central, tuple(lens) if model == "FULL_OPENCV" else (*lens, 0.0, 0.0, 0.0)[:4])


def _text_cameras(file: Path) -> Iterator[tuple[int, ModelCamera]]:
    try:
        content = file.read_bytes()
        if b"\0" in content:
            raise ValueError("it is binary, not text")
    except (OSError, ValueError) as error:
        raise CalibrationError(f"cannot read the cameras of a COLMAP model from {file}: {error}") from None
    # Bytes that are no UTF-8, as in comments of any tool, become question marks.
    for number, line in enumerate(content.decode("utf-8-sig", errors="replace").splitlines(), start=1):
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
    with opened_model(file) as content:
        for _ in range(content.count(_SMALLEST_CAMERA_BYTES, "cameras")):
            key, model, width, height = content.take(_CAMERA)
            if not 0 <= model < len(names):
                raise CalibrationError(
                    f"reading {file}: camera {key} is of a model with the number {model}, of which nothing is known; "
                    f"{_ADVICE}"
                )
            name = names[model]
            yield key, ModelCamera(name, width, height, content.take(Struct(f"<{_PARAMETERS[name]}d")))
        content.check_end()
