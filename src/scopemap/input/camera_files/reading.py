"""Reading a camera: numbers as typed, or a calibration file, whose format is recognised by its content."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import OmnidirectionalCamera
from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files import colmap_model, text_formats
from scopemap.input.camera_files.calibration import LARGEST_SIDE_PX, Calibration, Size, check_size, fitted, pinhole_of
from scopemap.input.camera_files.lens import lens_of, model_in
from scopemap.input.camera_files.parsing import (
    MOST_TERMS,
    Fields,
    calibration_bytes,
    named_values,
    number_rows,
    read_tree,
)

_FORMATS = (
    "OpenCV, ROS, Kalibr, COLMAP, ORB-SLAM, OCamCalib, a camera matrix, lines `fx: 520`, or one line fx fy cx cy "
    "[k1 k2 p1 p2 [k3]]"
)
_SCARED = "camera-calibration"  # in frame_data*.json
_KALIBR_CAMERA = re.compile(r"cam\d{1,3}")
_MATRIX_NAMES = (
    "camera_matrix", "K", "K1", "M1", "M", "cam_K", "intrinsic_matrix", "KL", "mtx", "camera_matrix_1",
    "intrinsics_matrix", "intrinsics", "intrinsic", "camera_intrinsics",
)  # fmt: skip
# Under these names some files put what others have at their top.
_INNER = ("intrinsics", "projection_parameters", "camera_intrinsics", "intrinsic")
_NERFSTUDIO = "fl_x"
_INTRINSICS = {
    "fx": ("fx", _NERFSTUDIO, "focal_x", "focal_length_x", "fc_x"),
    "fy": ("fy", "fl_y", "focal_y", "focal_length_y", "fc_y"),
    "cx": ("cx", "ppx", "cc_x"),
    "cy": ("cy", "ppy", "cc_y"),
}
_CORNER_TO_CENTRE_PX = 0.5
_SIZES = ("image_size", "img_size", "im_size", "resolution", "image_resolution", "frame_size", "image_shape")
_SIDES = (
    ("image_width", "image_height"),
    ("img_width", "img_height"),
    ("im_width", "im_height"),
    ("frame_width", "frame_height"),
    ("res_x", "res_y"),
)
# Of the image, or of the calibration board, whose number of corners or squares has the same names.
_UNSURE_SIDES = (("width", "height"), ("w", "h"), ("cols", "rows"))


def read_calibration(camera: Path | str, image_size: Size, fit: str = "exact") -> Calibration:
    """Return the camera in a file, or of numbers `fx fy cx cy [k1 k2 p1 p2 [k3]]`, for images of `image_size`, px.

    `image_size` is (width, height). A calibration without a size is taken as made for the images. `fit` is the meaning
    of another size: exact: it is refused; scale: the images were resized from it (aspects agree within 1 %); crop:X,Y:
    they were cut out of it at that pixel. Raises `CalibrationError` where the camera cannot be read or does not fit.
    """
    return fitted(stated_calibration(camera, image_size), image_size, fit)


def stated_calibration(camera: Path | str, image_size: Size) -> Calibration:
    """Return the camera at the file's own size, or that of the images where it has none; raises `CalibrationError`."""
    typed, file = number_rows(str(camera)), Path(camera)
    if typed and len(typed[0]) > 1 and not os.path.isfile(file):
        try:
            return replace(text_formats.of_numbers(typed, image_size), source="camera of the numbers given (--camera)")
        except ValueError as error:
            raise CalibrationError(f"cannot use the camera '{str(camera)[:200]}': {error}") from None
    try:
        calibration = _read(file, image_size)
    except ValueError as error:
        raise CalibrationError(f"the calibration {file} cannot be used: {error}") from None
    shares = ", its numbers taken as shares of the size" if calibration.size_origin == "relative" else ""
    return replace(calibration, source=f"calibration file {file.name}{calibration.source}{shares}", file=file)


def _read(file: Path, image_size: Size) -> Calibration:
    content = calibration_bytes(file)
    if colmap_model.is_cameras_binary(content):
        return Calibration(colmap_model.only_camera(file), None, "")
    if b"\0" in content:
        raise ValueError("it is binary, not text")
    text = content.decode("utf-8-sig", errors="replace")  # comments may have any encoding
    if (rows := number_rows(text)) is not None:
        return text_formats.of_numbers(rows, image_size)
    if colmap_model.is_cameras_text(text):
        return Calibration(colmap_model.only_camera(file), None, "")
    if (
        fields := text_formats.calibu_fields(text) if "<camera_model" in text else text_formats.stereo_ini_fields(text)
    ) is not None:
        return of_fields(fields, image_size)
    tree = (None if text.lstrip()[:1] in ("{", "[", "<") else named_values(text)) or read_tree(text)
    if not isinstance(tree, Fields):
        raise ValueError(f"it has none of the formats that are read: {_FORMATS}")
    return of_fields(next(iter(tree.inner((_SCARED,))), tree), image_size)


def of_fields(fields: Fields, image_size: Size) -> Calibration:
    """Return the camera of a mapping: OpenCV, ROS, Kalibr, ORB-SLAM, VINS, nerfstudio, OneSLAM; or `ValueError`."""
    cameras = sorted(name for name, _ in fields.pairs if _KALIBR_CAMERA.fullmatch(name))
    chain = fields.inner(cameras)
    levels = [chain[0], fields] if chain else [fields, *fields.inner(_INNER)]
    intrinsics, note = _intrinsics(levels)
    size, size_note = _size_of(levels, intrinsics, image_size)
    pinhole, origin = pinhole_of(intrinsics, size, image_size)
    model, lens_note = model_in(levels), ""
    if "omnidirectional" in model and any(fields.nodes(("polynomial",))):
        camera: CameraModel = _omnidirectional(fields, pinhole)
    else:
        camera, lens_note = lens_of(pinhole, levels, model)
    depth_scale_mm = next((s for level in levels if (s := level.number(("depth_scale",))) is not None), None)
    if depth_scale_mm is not None and depth_scale_mm <= 0:
        raise ValueError(f"depth_scale, mm per unit of the depth files, must be positive, found {depth_scale_mm:g}")
    chain_note = f", {cameras[0]} of {len(chain)} cameras" if len(chain) > 1 else ""
    notes = chain_note + note + size_note + lens_note
    return _read_out(fields, Calibration(camera, depth_scale_mm, notes, origin))


def _intrinsics(levels: Sequence[Fields]) -> tuple[list[float], str]:
    """Return fx fy cx cy, and a note: of a matrix, else by name, else of Kalibr's list."""
    matrix = next((nine for level in levels if (nine := level.numbers(_MATRIX_NAMES, 9)) is not None), None)
    if matrix is not None:
        return text_formats.intrinsics_of(np.reshape(matrix, (3, 3)))
    for level in levels:
        found = {name: level.number(spellings) for name, spellings in _INTRINSICS.items()}
        intrinsics = [value for value in found.values() if value is not None]
        if found["fx"] is None:
            continue
        if len(intrinsics) < 4:
            raise ValueError(f"it has no {', '.join(name for name, value in found.items() if value is None)}")
        if level.number((_NERFSTUDIO,)) is not None and max(intrinsics[2:]) > 1:
            intrinsics[2:] = [value - _CORNER_TO_CENTRE_PX for value in intrinsics[2:]]
            return intrinsics, ", its pixels counted from the corner, as in nerfstudio"
        return intrinsics, ""
    listed = next((four for level in levels if (four := level.numbers(("intrinsics",), 4)) is not None), None)
    if listed is None:
        raise ValueError("it has no 3x3 camera matrix under any usual name (camera_matrix, K), and no fx fy cx cy")
    return listed, ""


def _omnidirectional(fields: Fields, pinhole: PinholeCamera) -> OmnidirectionalCamera:
    """Return Scaramuzza's lens as `write_calibration` writes it."""
    polynomial, stretch = fields.numbers(("polynomial",)) or [], fields.numbers(("stretch",)) or [1.0, 0.0, 0.0]
    if not 0 < len(polynomial) <= MOST_TERMS or len(stretch) != 3:
        raise ValueError(f"expected a 'polynomial' of up to {MOST_TERMS} numbers and a 'stretch' of 3")
    c, d, e = stretch
    centre = (pinhole.cx, pinhole.cy, pinhole.width, pinhole.height)
    return OmnidirectionalCamera(tuple(polynomial), *centre, (c, d, e))


def _size_of(levels: Sequence[Fields], intrinsics: Sequence[float], image_size: Size) -> tuple[Size | None, str]:
    """Return the size (width, height), px, that a tree states, None where it states none, and a note on it.

    Zeros, which ROS writes for an unknown size, are no size. Raises `ValueError` for half a size.
    """
    _, _, cx, cy = intrinsics
    for width, height, is_list in _sizes_in(levels, cx, cy):
        if not width and not height:
            continue
        if not width or not height:
            raise ValueError("it states one of width and height, but not both")
        size = check_size(width, height)
        if is_list and size != image_size and size[::-1] == image_size:
            as_stated, swapped = ((cx - w / 2) ** 2 + (cy - h / 2) ** 2 for w, h in (size, image_size))
            if swapped < as_stated:
                return image_size, f", its size {size[0]}, {size[1]} taken as height, width"
        return size, ""
    return None, ""


def _sizes_in(levels: Sequence[Fields], cx: float, cy: float) -> Iterator[tuple[float | None, float | None, bool]]:
    """Yield width, height, and whether they were in one list."""
    for level in levels:
        if (pair := level.numbers(_SIZES, 2)) is not None:
            yield pair[0], pair[1], True
        for place in (level, *level.inner(_SIZES)):
            for wide, high in (*_SIDES, *_UNSURE_SIDES):
                width, height = place.number((wide,)), place.number((high,))
                # A width that does not contain the principal point is the calibration board's.
                if (wide, high) in _SIDES or ((width or 0) > cx and (height or 0) > cy):
                    yield width, height, False


def _read_out(fields: Fields, calibration: Calibration) -> Calibration:
    """Return the camera of a binned region of a sensor (ROS CameraInfo); `ValueError` where that is no part of it."""
    sensor = calibration.camera
    roi = next(iter(fields.inner(("roi",))), Fields([]))
    x, y, width, height = (_whole(roi, name) for name in ("x_offset", "y_offset", "width", "height"))
    if not width or not height:
        x, y, width, height = 0, 0, sensor.width, sensor.height
    across, down = (max(1, _whole(fields, name)) for name in ("binning_x", "binning_y"))
    if (x, y, width, height, across, down) == (0, 0, sensor.width, sensor.height, 1, 1):
        return calibration
    if calibration.size_origin != "stated":
        raise ValueError("it has a region or a binning, but not the size of the sensor (image_width, image_height)")
    columns, rows = width // across, height // down
    if x + width > sensor.width or y + height > sensor.height or not columns or not rows:
        raise ValueError(f"its region, {width}x{height} px at {x},{y}, is no part of {sensor.width}x{sensor.height} px")
    camera = sensor.cropped(x, y, columns * across, rows * down).resized(columns, rows)
    source = f"{calibration.source}, its region and binning of {sensor.width}x{sensor.height} px taken"
    return replace(calibration, camera=camera, source=source)


def _whole(place: Fields, name: str) -> int:
    value = place.number((name,)) or 0.0
    if value % 1 or not 0 <= value <= LARGEST_SIDE_PX:
        raise ValueError(f"{name} must be a whole number of pixels, found {value:g}")
    return int(value)
