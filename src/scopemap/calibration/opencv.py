"""A camera matrix and distortion by name: OpenCV's FileStorage (YAML, XML, JSON), ROS' camera_info, our own files.

ROS' `binning_x`, `binning_y` and `roi` are what sensor_msgs/CameraInfo defines: the matrix is that of the whole sensor,
of which `roi` is read out, one pixel for each block of `binning`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scopemap.calibration.stated import (
    LARGEST_SIDE_PX,
    MOST_TERMS,
    Calibration,
    Size,
    intrinsics_of,
    pinhole_of,
    with_lens,
)
from scopemap.calibration.trees import Tree, number, numbers, words
from scopemap.camera import CameraModel, PinholeCamera
from scopemap.lenses import OmnidirectionalCamera

_MATRIX_NAMES = (
    "camera_matrix", "K", "K1", "M1", "M", "Camera_Matrix", "cameraMatrix", "cam_K", "intrinsic_matrix", "KL", "mtx",
    "k",
)  # fmt: skip
_DISTORTION_NAMES = (
    "distortion_coefficients", "D", "D1", "K_dist", "Distortion_Coefficients", "distCoeffs", "dist", "DL", "d",
)  # fmt: skip
_WIDTH_NAMES = ("image_width", "image_Width", "width", "w", "cols", "Camera.width")
_HEIGHT_NAMES = ("image_height", "image_Height", "height", "h", "rows", "Camera.height")
_SIZE_NAMES = ("image_size", "image_Size", "imageSize", "img_size", "resolution")
_MODEL_NAMES = ("camera_model", "distortion_model", "model", "model_type", "Camera.type")
_OMNIDIRECTIONAL = ("omnidirectional", "scaramuzza")


def of_matrices(tree: Tree, image_size: Size) -> Calibration:
    """Return the camera of a tree with a camera matrix; `ValueError` where there is none or it cannot be."""
    matrix = numbers(tree, _MATRIX_NAMES)
    if matrix is None or len(matrix) != 9:
        raise ValueError("it has no 3x3 camera matrix under any usual name (camera_matrix, K)")
    if not any(matrix):
        raise ValueError("its camera matrix is all zero, which ROS writes for a camera that was not calibrated")
    intrinsics = intrinsics_of(np.reshape(matrix, (3, 3)))
    pinhole, origin = pinhole_of(intrinsics, size_of(tree), image_size)
    coefficients = numbers(tree, _DISTORTION_NAMES) or []
    model = words(tree, _MODEL_NAMES)
    if number(tree, ("fisheye_model", "fisheye")):
        model += " fisheye"
    note = ""
    if any(word in model for word in _OMNIDIRECTIONAL):
        camera: CameraModel = _omnidirectional(tree, pinhole)
    else:
        camera = with_lens(pinhole, model, coefficients)
        if not model and len(coefficients) == 4 and any(coefficients):
            note = ", its four coefficients taken as k1 k2 p1 p2 (no model is named)"
    calibration = Calibration(camera, _depth_scale_mm(tree), note, origin)
    return _read_out(tree, calibration)


def size_of(tree: Tree) -> Size | None:
    """Return the size (width, height), px, that a tree states, None where it states none; `ValueError` for half a size.

    Zeros, which ROS writes for what it does not know, are no size.
    """
    pair = numbers(tree, _SIZE_NAMES)
    width, height = pair if pair and len(pair) == 2 else (number(tree, _WIDTH_NAMES), number(tree, _HEIGHT_NAMES))
    if not width and not height:
        return None
    if not width or not height:
        raise ValueError("it states one of width and height, but not both")
    if not (1 <= width <= LARGEST_SIDE_PX and 1 <= height <= LARGEST_SIDE_PX) or width % 1 or height % 1:
        raise ValueError(f"its size is {width:g}x{height:g} px, which no image has")
    return int(width), int(height)


def _depth_scale_mm(tree: Tree) -> float | None:
    scale_mm = number(tree, ("depth_scale",))
    if scale_mm is not None and scale_mm <= 0:
        raise ValueError(f"depth_scale, mm per unit of the depth files, must be positive, found {scale_mm:g}")
    return scale_mm


def _omnidirectional(tree: Tree, pinhole: PinholeCamera) -> OmnidirectionalCamera:
    polynomial, stretch = numbers(tree, ("polynomial",)), numbers(tree, ("stretch",)) or [1.0, 0.0, 0.0]
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


def _read_out(tree: Tree, calibration: Calibration) -> Calibration:
    roi = tree.get("roi")
    roi = roi if isinstance(roi, dict) else {}
    region = (_whole(roi, "x_offset"), _whole(roi, "y_offset"), _whole(roi, "width"), _whole(roi, "height"))
    camera = read_out(calibration.camera, region, (_whole(tree, "binning_x"), _whole(tree, "binning_y")))
    if camera is calibration.camera:
        return calibration
    if calibration.size_origin != "stated":
        raise ValueError("it has a region or a binning, but not the size of the sensor (image_width, image_height)")
    sensor = f"{calibration.camera.width}x{calibration.camera.height} px"
    return replace(calibration, camera=camera, source=f"{calibration.source}, its region and binning of {sensor} taken")


def _whole(tree: Tree, name: str) -> int:
    value = number(tree, (name,)) or 0.0
    if value % 1 or not 0 <= value <= LARGEST_SIDE_PX:
        raise ValueError(f"{name} must be a whole number of pixels, found {value:g}")
    return int(value)
