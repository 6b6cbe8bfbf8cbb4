"""A camera as a file states it, and the same camera for images of another size."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.errors import CalibrationError, SettingsError

Size: TypeAlias = tuple[int, int]
SizeOrigin: TypeAlias = Literal["stated", "images", "relative"]

LARGEST_SIDE_PX = 100_000
_LONGEST_RELATIVE_FOCAL = 10.0
# Of a principal point that is a share of the size.
_RELATIVE_CENTRE = (0.1, 0.9)
_LONGEST_MM = 50.0
_ASPECT_TOLERANCE = 0.01
_CROP = re.compile(r"crop:(\d{1,6}),(\d{1,6})")
_FOCAL_PER_WIDTH = (0.25, 5.0)  # of a pinhole: 127 to 11 degrees
_SHORTEST_BENT = 0.15  # of a lens with distortion: a capsule's .29, fisheyes whose circle is smaller than the picture
# Sizes of pictures that a principal point may be the middle of.
_STANDARD_SIZES = (
    (320, 240), (640, 480), (720, 480), (720, 576), (768, 576), (800, 600), (1024, 768), (1280, 720), (1280, 960),
    (1280, 1024), (1350, 1080), (1440, 1080), (1600, 1200), (1920, 1080), (1920, 1200), (3840, 2160),
)  # fmt: skip
_OFF_CENTRE = 0.15  # share of a side, farther than which the middle is that of other pictures
_NEAR_STANDARD = 0.06  # of a standard size, within which twice the principal point is: real lenses are off by 3 %
_FOCAL_RATIO = (0.2, 5.0)


@dataclass(frozen=True)
class Calibration:
    """A camera and where it is from.

    depth_scale_mm : mm per unit of the depth files beside it, or None where the file does not state it. source : how
    the camera is known, one phrase. file : the file, or its name in errors, or None. size_origin : where the size of
    `camera` is from. stated: the file. images: the file has none. relative: as images, and the file's numbers are
    shares of the size.
    """

    camera: CameraModel
    depth_scale_mm: float | None
    source: str
    size_origin: SizeOrigin = "stated"
    file: Path | str | None = None

    @property
    def name(self) -> str:
        """The name in error messages."""
        return f"the calibration {self.file}" if self.file else f"the {self.source}"


def pinhole_of(
    intrinsics: Sequence[float], stated: Size | None, image_size: Size, corner_px: float = 0.0
) -> tuple[PinholeCamera, SizeOrigin]:
    """Return the pinhole of fx fy cx cy, px or (cx and cy up to 1) shares of the size, and where its size is from.

    `corner_px` : what shares count the centre of the first pixel as: 0.5 where they count from the image's corner.
    Raises `ValueError` for numbers that are neither px nor shares.
    """
    fx, fy, cx, cy = intrinsics
    width, height = check_size(*(stated or image_size))
    are_shares = are_shares_of_size(intrinsics)
    if are_shares:
        fx, fy, cx, cy = fx * width, fy * height, cx * width - corner_px, cy * height - corner_px
    origin: SizeOrigin = "stated" if stated else "relative" if are_shares else "images"
    return PinholeCamera(fx, fy, cx, cy, width, height), origin


def are_shares_of_size(intrinsics: Sequence[float]) -> bool:
    """Return whether fx fy cx cy are shares of the size, else px; `ValueError` where they can be neither."""
    fx, fy, cx, cy = intrinsics
    if max(cx, cy) > 1 or not np.isfinite(intrinsics).all():
        return False
    least, most = _RELATIVE_CENTRE
    if max(abs(fx), abs(fy)) >= _LONGEST_RELATIVE_FOCAL or not least <= min(cx, cy) <= max(cx, cy) <= most:
        found = f"focal length {fx:g}, {fy:g} and principal point {cx:g}, {cy:g}"
        raise ValueError(f"its {found} are neither px nor shares of the picture's size")
    return True


def check_size(width: float, height: float) -> Size:
    """Return the size in whole pixels; `ValueError` where no image has it."""
    if not (1 <= width <= LARGEST_SIDE_PX and 1 <= height <= LARGEST_SIDE_PX) or width % 1 or height % 1:
        raise ValueError(f"its size is {width:g}x{height:g} px, which no image has")
    return int(width), int(height)


def fitted(calibration: Calibration, image_size: Size, fit: str = "exact") -> Calibration:
    """Return the calibration for images of `image_size` (width, height), px.

    `fit` is the setting `input.camera_fit`, the meaning of another size: exact, scale or crop:X,Y. Raises
    `CalibrationError`, with both sizes, where the camera is not one of these images.
    """
    crop = _CROP.fullmatch(fit)
    if crop is not None:
        calibration = _cropped(calibration, image_size, (int(crop[1]), int(crop[2])))
    elif fit == "scale":
        calibration = _scaled(calibration, image_size)
    elif fit != "exact":
        raise SettingsError(f"fitting a calibration: expected exact, scale or crop:X,Y, found {fit[:40]!r}")
    camera = calibration.camera
    if (camera.width, camera.height) != image_size:
        advice = (
            "give --camera-fit scale if the images were resized from that size, --camera-fit crop:X,Y if they were "
        )
        advice += "cut out of it, else another calibration (--camera)"
        raise CalibrationError(f"{_sizes(calibration, image_size)}; {advice}")
    check_plausible(camera, calibration.name)
    if calibration.size_origin == "images" and crop is None and (other := _size_of_centre(camera.central)):
        middle, images = (f"{width}x{height} px" for width, height in (other, image_size))
        fault = f"has no size, and its principal point is the middle of {middle}, but the images are {images}"
        raise CalibrationError(f"{calibration.name} {fault}: add image_width and image_height")
    return calibration


def _size_of_centre(central: PinholeCamera) -> Size | None:
    """Return the standard size that the principal point is the middle of, exactly or far from the images'; or None."""
    size, twice = (central.width, central.height), (2 * central.cx + 1, 2 * central.cy + 1)
    # Exact middles were set, not calibrated, counted from the first pixel's centre or its corner.
    nominal = [tuple(two - from_corner for two in twice) for from_corner in (0.0, 1.0)]
    if size not in nominal and (other := next((one for one in _STANDARD_SIZES if one in nominal), None)):
        return other
    if all(abs(two - side) <= 2 * _OFF_CENTRE * side for two, side in zip(twice, size, strict=True)):
        return None
    for other in _STANDARD_SIZES:
        if all(abs(two / side - 1) <= _NEAR_STANDARD for two, side in zip(twice, other, strict=True)):
            return other
    return None


def check_plausible(camera: CameraModel, name: str) -> None:
    """Raise `CalibrationError` where no endoscope has such a camera for images of its size."""
    central, width, height = camera.central, camera.width, camera.height
    shortest, longest = _FOCAL_PER_WIDTH
    least, most = (shortest if isinstance(camera, PinholeCamera) else _SHORTEST_BENT) * width, longest * width
    narrow, wide = _FOCAL_RATIO
    # Written so that NaN is refused, too.
    if not least < central.fx < most or not narrow < central.fy / central.fx < wide:
        fault = f"focal length {central.fx:g}, {central.fy:g} px (plausible: {least:g} to {most:g})"
        if 0 < central.fx < min(least, _LONGEST_MM):
            fault += "; if it is in mm, multiply it by the picture's width in px and divide by the sensor's in mm"
    elif not (0 <= central.cx < width and 0 <= central.cy < height):
        fault = f"its principal point {central.cx:g}, {central.cy:g} is outside; it was made for a larger image"
    else:
        return
    raise CalibrationError(f"{name} does not fit images of {width}x{height} px: {fault}")


def _scaled(calibration: Calibration, image_size: Size) -> Calibration:
    camera = calibration.camera
    if calibration.size_origin == "images":
        cannot = "so that it cannot be scaled (--camera-fit scale): add image_width and image_height"
        raise CalibrationError(f"{calibration.name} does not state its image size, {cannot}")
    width, height = image_size
    if (camera.width, camera.height) == image_size:
        return calibration
    if abs(camera.width * height / (camera.height * width) - 1) > _ASPECT_TOLERANCE:
        advice = (
            "give --camera-fit crop:X,Y if the images were cut out of that size, else a calibration for these images"
        )
        raise CalibrationError(
            f"{_sizes(calibration, image_size)}: another aspect, perhaps cropped; {advice} (--camera)"
        )
    source = f"{calibration.source}, rescaled from {camera.width}x{camera.height} px"
    return replace(calibration, camera=camera.resized(width, height), source=source)


def _cropped(calibration: Calibration, image_size: Size, corner: tuple[int, int]) -> Calibration:
    camera, (x, y) = calibration.camera, corner
    if calibration.size_origin == "relative":
        cannot = "so that nothing can be cut out of it (--camera-fit crop): add width and height"
        raise CalibrationError(f"{calibration.name} holds shares of a size that it does not state, {cannot}")
    is_stated = calibration.size_origin == "stated"
    if is_stated and (x + image_size[0] > camera.width or y + image_size[1] > camera.height):
        cut = f"cut out of it at {x},{y} px (--camera-fit crop:{x},{y})"
        raise CalibrationError(f"{_sizes(calibration, image_size)}: too large to have been {cut}")
    of_size = f" of {camera.width}x{camera.height} px" if is_stated else ""
    source = f"{calibration.source}, cut out{of_size} at {x},{y} px"
    return replace(calibration, camera=camera.cropped(x, y, *image_size), source=source)


def _sizes(calibration: Calibration, image_size: Size) -> str:
    camera, (width, height) = calibration.camera, image_size
    return f"{calibration.name} is for {camera.width}x{camera.height} px, but the images are {width}x{height} px"
