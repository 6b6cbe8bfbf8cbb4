"""The camera out of a ROS `sensor_msgs/CameraInfo` message."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from scopemap.calibration import fitted_to
from scopemap.camera import CameraModel, PinholeCamera
from scopemap.errors import CalibrationError
from scopemap.lenses import FisheyeCamera, OpenCvCamera

_OPENCV = ("plumb_bob", "rational_polynomial")
_FISHEYE = ("equidistant", "fisheye")
_OPENCV_TERMS = (4, 5, 8)
_FOCAL_WIDTHS = (0.3, 5.0)


def camera_of(info: Any, size: tuple[int, int], rectified: bool, where: str) -> CameraModel | None:
    """Return the camera of images of `size` (width, height), px; None where the message says "not calibrated".

    `rectified` : whether the images are already free of distortion; then P holds, else K and D do. `where` : what to
    call the message. The region of interest and the binning that it states are applied. Raises `CalibrationError` for a
    lens that is not known and for a camera that cannot be that of these images.
    """
    K = np.asarray(_field(info, "k"), dtype=np.float64).reshape(3, 3)
    if not K.any():
        return None
    if rectified:
        K = np.asarray(_field(info, "p"), dtype=np.float64).reshape(3, 4)[:, :3]
    width, height = int(info.width) or size[0], int(info.height) or size[1]
    pinhole = PinholeCamera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)
    camera = _seen_part(pinhole if rectified else _with_lens(info, pinhole, where), info, where)
    _check(camera.central, where)
    return fitted_to(camera, size, where)


def _field(info: Any, name: str) -> Any:
    """Return a field that ROS 2 writes with a small letter and ROS 1 with a capital one."""
    return getattr(info, name if hasattr(info, name) else name.upper())


def _with_lens(info: Any, pinhole: PinholeCamera, where: str) -> CameraModel:
    model = info.distortion_model
    terms = np.trim_zeros(np.asarray(_field(info, "d"), dtype=np.float64), "b").tolist()
    if not np.isfinite(terms).all():
        raise CalibrationError(f"the camera in {where} cannot be used: its distortion is not finite")
    if model in _FISHEYE and len(terms) <= 4:
        return FisheyeCamera(pinhole, (*terms, *[0.0] * (4 - len(terms))))
    if not terms:
        return pinhole
    length = next((length for length in _OPENCV_TERMS if len(terms) <= length), None)
    if (model and model not in _OPENCV) or length is None:
        known = ", ".join((*_OPENCV, *_FISHEYE))
        raise CalibrationError(
            f"the camera in {where} cannot be used: lens '{model}' with {len(terms)} coefficients (known are {known}); "
            "give a calibration file (--camera)"
        )
    return OpenCvCamera(pinhole, (*terms, *[0.0] * (length - len(terms))))


def _seen_part(camera: CameraModel, info: Any, where: str) -> CameraModel:
    """Return the camera of what was read out of the sensor: a region of it, several pixels binned into one."""
    roi, binning = info.roi, (max(int(info.binning_x), 1), max(int(info.binning_y), 1))
    width, height = int(roi.width) or camera.width, int(roi.height) or camera.height
    x, y = (int(roi.x_offset), int(roi.y_offset)) if roi.width and roi.height else (0, 0)
    if x + width > camera.width or y + height > camera.height:
        raise CalibrationError(f"the camera in {where} cannot be used: its region of interest lies outside the image")
    if (width, height) != (camera.width, camera.height):
        central = camera.central
        part = replace(central, cx=central.cx - x, cy=central.cy - y, width=width, height=height)
        camera = replace(camera, central=part) if isinstance(camera, FisheyeCamera | OpenCvCamera) else part
    if binning != (1, 1):
        camera = camera.resized(max(width // binning[0], 1), max(height // binning[1], 1))
    return camera


def _check(camera: PinholeCamera, where: str) -> None:
    least, most = (share * camera.width for share in _FOCAL_WIDTHS)
    plausible = least < camera.fx < most and 0.2 < camera.fy / camera.fx < 5
    if not (plausible and 0 <= camera.cx < camera.width and 0 <= camera.cy < camera.height):
        raise CalibrationError(
            f"the camera in {where} cannot be that of images of {camera.width}x{camera.height} px: focal length "
            f"{camera.fx:g}, {camera.fy:g} px, principal point {camera.cx:g}, {camera.cy:g} px"
        )
