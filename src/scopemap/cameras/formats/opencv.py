"""A camera matrix and distortion by name: OpenCV's FileStorage (YAML, XML, JSON), ROS' camera_info, our own files.

ROS' `binning_x`, `binning_y` and `roi` are what sensor_msgs/CameraInfo defines: the matrix is that of the whole sensor,
of which `roi` is read out, one pixel for each block of `binning`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.distortion import coefficients_in, model_in
from scopemap.cameras.formats.fields import Fields
from scopemap.cameras.formats.lens_models import with_lens
from scopemap.cameras.formats.sizes import size_of
from scopemap.cameras.formats.stated import LARGEST_SIDE_PX, MOST_TERMS, Calibration, Size, intrinsics_of, pinhole_of
from scopemap.cameras.formats.trees import Tree
from scopemap.cameras.lenses import OmnidirectionalCamera

_MATRIX_NAMES = (
    *("camera_matrix", "K", "K1", "M1", "M", "cam_K", "intrinsic_matrix", "KL", "mtx", "camera_matrix_1"),
    *("intrinsics_matrix", "intrinsics", "intrinsic", "camera_intrinsics"),
)
INNER = ("intrinsics", "projection_parameters", "camera_intrinsics", "intrinsic")
"""Names under which some files put what others have at their top."""
_OMNIDIRECTIONAL = ("omnidirectional", "scaramuzza")


def has_matrix(tree: Tree) -> bool:
    """Whether nine numbers stand under a usual name of the camera matrix."""
    return _matrix(Fields(tree)) is not None


def of_matrices(tree: Tree, image_size: Size) -> Calibration:
    """Return the camera of a tree with a camera matrix; `ValueError` where there is none or it cannot be."""
    fields = Fields(tree)
    matrix = _matrix(fields)
    if matrix is None:
        raise ValueError("it has no 3x3 camera matrix under any usual name (camera_matrix, K), and no fx fy cx cy")
    if not any(matrix):
        raise ValueError("its camera matrix is all zero, which ROS writes for a camera that was not calibrated")
    intrinsics, matrix_note = intrinsics_of(np.reshape(matrix, (3, 3)))
    levels = [fields, *fields.inner(INNER)]
    size, size_note = size_of(levels, intrinsics, image_size)
    pinhole, origin = pinhole_of(intrinsics, size, image_size)
    model = model_in(levels)
    if any(word in model for word in _OMNIDIRECTIONAL):
        camera: CameraModel = _omnidirectional(fields, pinhole)
        lens_note = ""
    else:
        camera, lens_note = lens_of(pinhole, levels, model)
    calibration = Calibration(camera, depth_scale_mm(levels), matrix_note + size_note + lens_note, origin)
    return _read_out(fields, calibration)


def lens_of(pinhole: PinholeCamera, levels: list[Fields], model: str) -> tuple[CameraModel, str]:
    """Return the camera with the lens in the levels of a tree, and a note on what was assumed of it."""
    coefficients, is_list = coefficients_in(levels, model)
    camera, note = with_lens(pinhole, model, coefficients)
    if is_list and not model and len(coefficients) == 4 and any(coefficients):
        note = ", its four coefficients taken as k1 k2 p1 p2 (no model is named)"
    return camera, note


def depth_scale_mm(levels: list[Fields]) -> float | None:
    """Return mm per unit of the depth files, None where it is not said; `ValueError` where it is not positive."""
    scale_mm = next((scale for level in levels if (scale := level.number(("depth_scale",))) is not None), None)
    if scale_mm is not None and scale_mm <= 0:
        raise ValueError(f"depth_scale, mm per unit of the depth files, must be positive, found {scale_mm:g}")
    return scale_mm


def _matrix(fields: Fields) -> list[float] | None:
    return fields.numbers(_MATRIX_NAMES, 9)


def _omnidirectional(fields: Fields, pinhole: PinholeCamera) -> OmnidirectionalCamera:
    polynomial, stretch = fields.numbers(("polynomial",)), fields.numbers(("stretch",)) or [1.0, 0.0, 0.0]
    if polynomial is None or len(polynomial) > MOST_TERMS:
        raise ValueError(f"it is omnidirectional but has no 'polynomial' of up to {MOST_TERMS} numbers")
    if len(stretch) != 3:
        raise ValueError(f"its 'stretch' has {len(stretch)} numbers, expected c, d, e")
    c, d, e = stretch
    centre = (pinhole.cx, pinhole.cy, pinhole.width, pinhole.height)
    return OmnidirectionalCamera(tuple(polynomial), *centre, (c, d, e))


def read_out(camera: CameraModel, region: tuple[int, int, int, int], binning: tuple[int, int]) -> CameraModel:
    """Return the camera of the images that ROS publishes of a sensor: a region of it, blocks of pixels put into one.

    `region` is x, y, width, height, px, of the sensor that `camera` sees; no width or height: all of it. `binning` is
    columns and rows of a block; 0 stands for 1. Raises `ValueError` where the region is no part of the sensor.
    """
    x, y, width, height = region if region[2] and region[3] else (0, 0, camera.width, camera.height)
    across, down = (max(1, count) for count in binning)
    columns, rows = width // across, height // down
    if x + width > camera.width or y + height > camera.height or not columns or not rows:
        raise ValueError(f"its region, {width}x{height} px at {x},{y}, is no part of {camera.width}x{camera.height} px")
    if (x, y, width, height, across, down) == (0, 0, camera.width, camera.height, 1, 1):
        return camera
    return camera.cropped(x, y, columns * across, rows * down).resized(columns, rows)


def _read_out(fields: Fields, calibration: Calibration) -> Calibration:
    roi = next(fields.inner(("roi",)), Fields({}))
    region = (_whole(roi, "x_offset"), _whole(roi, "y_offset"), _whole(roi, "width"), _whole(roi, "height"))
    camera = read_out(calibration.camera, region, (_whole(fields, "binning_x"), _whole(fields, "binning_y")))
    if camera is calibration.camera:
        return calibration
    if calibration.size_origin != "stated":
        raise ValueError("it has a region or a binning, but not the size of the sensor (image_width, image_height)")
    sensor = f"{calibration.camera.width}x{calibration.camera.height} px"
    return replace(calibration, camera=camera, source=f"{calibration.source}, its region and binning of {sensor} taken")


def _whole(fields: Fields, name: str) -> int:
    value = fields.number((name,)) or 0.0
    if value % 1 or not 0 <= value <= LARGEST_SIDE_PX:
        raise ValueError(f"{name} must be a whole number of pixels, found {value:g}")
    return int(value)
