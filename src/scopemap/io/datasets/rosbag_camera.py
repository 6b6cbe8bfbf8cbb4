"""The camera out of a ROS `sensor_msgs/CameraInfo` message."""

from __future__ import annotations

from typing import Any

import numpy as np

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.calibration import Calibration
from scopemap.cameras.formats.lens import model_in, with_lens
from scopemap.cameras.formats.parsing import Fields
from scopemap.cameras.formats.reading import read_out
from scopemap.errors import CalibrationError

_OPENCV_TERMS = (4, 5, 8)


def calibration_of(info: Any, size: tuple[int, int], rectified: bool, topic: str, bag: str) -> Calibration | None:
    """Return what a message says of the camera of images of `size` (width, height), px; None for "not calibrated".

    Its size is the message's own, of which the region of interest and the binning are applied, else that of the images;
    opening fits it. `rectified` : whether the images are already free of distortion; then P holds, else K and D do.
    `topic`, `bag` : where the message stands. Raises `CalibrationError` for a lens that is not known, and for a region
    that is no part of the sensor.
    """
    K = np.asarray(_field(info, "k"), dtype=np.float64).reshape(3, 3)
    if not K.any():
        return None
    if rectified:
        K = np.asarray(_field(info, "p"), dtype=np.float64).reshape(3, 4)[:, :3]
    is_stated = bool(info.width and info.height)
    sensor = (int(info.width), int(info.height)) if is_stated else size
    pinhole = PinholeCamera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *sensor)
    roi = info.roi
    region = (int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height))
    try:
        whole, note = (pinhole, ", P of rectified images") if rectified else _with_lens(info, pinhole)
        camera = read_out(whole, region, (int(info.binning_x), int(info.binning_y)))
        if camera is not whole and not is_stated:
            raise ValueError("it has a region or a binning, but not the size of the sensor (width, height)")
    except ValueError as error:
        raise CalibrationError(
            f"the camera in {bag}, {topic} cannot be used: {error}; give a calibration file (--camera)"
        ) from None
    return Calibration(camera, None, f"{topic} of the bag{note}", "stated" if is_stated else "images")


def _field(info: Any, name: str) -> Any:
    """Return a field that ROS 2 writes with a small letter and ROS 1 with a capital one."""
    return getattr(info, name if hasattr(info, name) else name.upper())


def _with_lens(info: Any, pinhole: PinholeCamera) -> tuple[CameraModel, str]:
    terms = np.trim_zeros(np.asarray(_field(info, "d"), dtype=np.float64), "b").tolist()
    if not np.isfinite(terms).all():
        raise ValueError("its distortion is not finite")
    length = next((length for length in _OPENCV_TERMS if len(terms) <= length), len(terms))
    model = model_in([Fields([("distortion_model", info.distortion_model)])])
    try:
        return with_lens(pinhole, model, [*terms, *[0.0] * (length - len(terms))])
    except ValueError as error:
        raise ValueError(f"lens '{info.distortion_model}' with {len(terms)} coefficients: {error}") from None
