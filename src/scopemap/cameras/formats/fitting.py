"""Calibrations of another size than the images: refused, scaled or cut, as the user says; and whether a camera fits."""

from __future__ import annotations

import re
from dataclasses import replace

from scopemap.cameras.camera import CameraModel
from scopemap.cameras.formats.stated import Calibration, Size
from scopemap.errors import CalibrationError, SettingsError

_ASPECT_TOLERANCE = 0.01
_CROP = re.compile(r"crop:(\d{1,6}),(\d{1,6})")
_FOCAL_PER_WIDTH = (0.3, 5.0)
_FOCAL_RATIO = (0.2, 5.0)


def fitted(calibration: Calibration, image_size: Size, fit: str = "exact") -> Calibration:
    """Return the calibration for images of `image_size` (width, height), px.

    `fit` says what another size means, as the setting `input.camera_fit` does: exact, scale or crop:X,Y. Raises
    `CalibrationError`, with both sizes, where the camera is not one of these images.
    """
    crop = _CROP.fullmatch(fit)
    if crop is not None:
        calibration = _cut(calibration, image_size, (int(crop[1]), int(crop[2])))
    elif fit == "scale":
        calibration = _scaled(calibration, image_size)
    elif fit != "exact":
        raise SettingsError(f"fitting a calibration: expected exact, scale or crop:X,Y, found {fit[:40]!r}")
    camera = calibration.camera
    if (camera.width, camera.height) != image_size:
        raise CalibrationError(
            f"{_sizes(calibration, image_size)}; where the images were resized from that size, say so (--camera-fit "
            "scale), where they were cut out of it, say where (--camera-fit crop:X,Y), else give another calibration "
            f"(--camera){_turned_note(camera, image_size)}"
        )
    check_plausible(camera, calibration.name)
    return calibration


def fitted_to(camera: CameraModel, image_size: Size, name: str) -> CameraModel:
    """Return `camera`, which a data set is known to resize, for images of `image_size` (width, height), px.

    Raises `CalibrationError` unless the aspects agree within 1 %.
    """
    if (camera.width, camera.height) == image_size:
        return camera
    if not _same_aspect(camera, image_size):
        width, height = image_size
        raise CalibrationError(
            f"the calibration {name} is for {camera.width}x{camera.height} px, but the images are {width}x{height} px: "
            "another aspect, perhaps cropped; give a calibration for these images (--camera)"
        )
    return camera.resized(*image_size)


def rescaled_note(camera: CameraModel, scaled: CameraModel) -> str:
    """Return what a `camera_source` adds where `scaled` is `camera` at another size, else ""."""
    same = (camera.width, camera.height) == (scaled.width, scaled.height)
    return "" if same else f", rescaled from {camera.width}x{camera.height} px"


def check_plausible(camera: CameraModel, name: str) -> None:
    """Raise `CalibrationError` where no endoscope has such a camera for images of its size."""
    central = camera.central
    width, height = camera.width, camera.height
    least, most = (share * width for share in _FOCAL_PER_WIDTH)
    narrow, wide = _FOCAL_RATIO
    # Written so that NaN is refused, too.
    if not least < central.fx < most or not narrow < central.fy / central.fx < wide:
        raise CalibrationError(
            f"{name} does not fit images of {width}x{height} px: focal length {central.fx:g}, {central.fy:g} px "
            f"(plausible: {least:g} to {most:g})"
        )
    if not (0 <= central.cx < width and 0 <= central.cy < height):
        raise CalibrationError(
            f"{name} does not fit images of {width}x{height} px: its principal point {central.cx:g}, {central.cy:g} "
            "lies outside; it was made for larger images or for a crop"
        )


def _scaled(calibration: Calibration, image_size: Size) -> Calibration:
    camera = calibration.camera
    if calibration.size_origin == "images":
        raise CalibrationError(
            f"{calibration.name} does not say for which size it was made, so that it cannot be scaled (--camera-fit "
            "scale): add image_width and image_height"
        )
    if (camera.width, camera.height) == image_size:
        return replace(calibration, source=f"{calibration.source}, of the images' size: nothing to scale")
    if not _same_aspect(camera, image_size):
        raise CalibrationError(
            f"{_sizes(calibration, image_size)}: another aspect, which scaling (--camera-fit scale) does not explain; "
            f"where the images were cut out, say where (--camera-fit crop:X,Y){_turned_note(camera, image_size)}"
        )
    scaled = camera.resized(*image_size)
    return replace(calibration, camera=scaled, source=calibration.source + rescaled_note(camera, scaled))


def _cut(calibration: Calibration, image_size: Size, corner: tuple[int, int]) -> Calibration:
    camera, (x, y) = calibration.camera, corner
    if calibration.size_origin == "relative":
        raise CalibrationError(
            f"{calibration.name} holds shares of a size that it does not say, so that nothing can be cut out of it "
            "(--camera-fit crop): add width and height"
        )
    of_size = ""
    if calibration.size_origin == "stated":
        of_size = f" of {camera.width}x{camera.height} px"
        if x + image_size[0] > camera.width or y + image_size[1] > camera.height:
            raise CalibrationError(
                f"{_sizes(calibration, image_size)}: too large to have been cut out of it at {x},{y} px (--camera-fit "
                f"crop:{x},{y})"
            )
    source = f"{calibration.source}, cut out{of_size} at {x},{y} px"
    return replace(calibration, camera=camera.cropped(x, y, *image_size), source=source)


def _same_aspect(camera: CameraModel, image_size: Size) -> bool:
    width, height = image_size
    return abs(camera.width * height / (camera.height * width) - 1) <= _ASPECT_TOLERANCE


def _turned_note(camera: CameraModel, image_size: Size) -> str:
    turned = _same_aspect(camera, image_size[::-1]) and not _same_aspect(camera, image_size)
    return "; its height and width may be swapped" if turned else ""


def _sizes(calibration: Calibration, image_size: Size) -> str:
    camera = calibration.camera
    return (
        f"{calibration.name} is for {camera.width}x{camera.height} px, but the images are "
        f"{image_size[0]}x{image_size[1]} px"
    )
