"""Writing a camera down, as OpenCV YAML."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.cameras.camera import CameraModel
from scopemap.cameras.lenses import FisheyeCamera, FovCamera, OmnidirectionalCamera, OpenCvCamera
from scopemap.errors import CalibrationError


def write_calibration(
    camera: CameraModel,
    file: Path | str,
    depth_scale_mm: float | None = None,
    focal_sigma_px: float | None = None,
) -> None:
    """Write `camera` as OpenCV YAML that `read_calibration` reads back exactly.

    `depth_scale_mm` is written as `depth_scale`: mm per unit of the depth files beside it; `focal_sigma_px` under its
    own name: the standard deviation of fx, for people. Raises `CalibrationError` where the file cannot be written.
    """
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
    if not storage.isOpened():
        raise CalibrationError(f"cannot write the calibration to {file}: is its folder there and writable?")
    plane = camera.plane if isinstance(camera, FovCamera) else camera.central
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", plane.matrix)
    if isinstance(camera, OmnidirectionalCamera):
        storage.write("camera_model", "omnidirectional")
        storage.write("polynomial", np.array([camera.polynomial]))
        storage.write("stretch", np.array([camera.stretch]))
    else:
        model, distortion = _lens(camera)
        storage.write("camera_model", model)
        storage.write("distortion_coefficients", np.array([distortion]))
    if depth_scale_mm is not None:
        storage.write("depth_scale", float(depth_scale_mm))
    if focal_sigma_px is not None:
        storage.write("focal_sigma_px", float(focal_sigma_px))
    storage.release()


def _lens(camera: CameraModel) -> tuple[str, tuple[float, ...]]:
    if isinstance(camera, FovCamera):
        return "fov", (camera.omega,)
    if isinstance(camera, FisheyeCamera):
        return "fisheye", camera.distortion
    return "opencv", camera.distortion if isinstance(camera, OpenCvCamera) else (0.0,) * 5
