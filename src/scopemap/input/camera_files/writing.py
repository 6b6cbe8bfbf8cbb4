"""Writing a camera down, as OpenCV YAML."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel
from scopemap.engine.cameras.lenses import FisheyeCamera, FovCamera, OmnidirectionalCamera
from scopemap.engine.errors import CalibrationError


def write_calibration(
    camera: CameraModel,
    file: Path | str,
    depth_scale_mm: float | None = None,
    focal_sigma_px: float | None = None,
    rate_hz: float | None = None,
) -> None:
    """Write `camera` as OpenCV YAML that `read_calibration` reads back exactly.

    `depth_scale_mm` is written as `depth_scale`: mm per unit of the depth files beside it; `focal_sigma_px`: the
    standard deviation of fx; `rate_hz` as `fps`. Raises `CalibrationError` where the file cannot be written.
    """
    # In memory: OpenCV takes no names outside of the system's code page on Windows.
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", (camera.plane if isinstance(camera, FovCamera) else camera.central).matrix)
    if isinstance(camera, OmnidirectionalCamera):
        model, terms = "omnidirectional", {"polynomial": camera.polynomial, "stretch": camera.stretch}
    elif isinstance(camera, FovCamera):
        model, terms = "fov", {"distortion_coefficients": (camera.omega,)}
    else:
        model = "fisheye" if isinstance(camera, FisheyeCamera) else "opencv"
        terms = {"distortion_coefficients": getattr(camera, "distortion", (0.0,) * 5)}
    storage.write("camera_model", model)
    for name, values in terms.items():
        storage.write(name, np.array([values]))
    for name, value in (("depth_scale", depth_scale_mm), ("focal_sigma_px", focal_sigma_px), ("fps", rate_hz)):
        if value is not None:
            storage.write(name, float(value))
    try:
        Path(file).write_text(storage.releaseAndGetString(), encoding="utf-8")
    except OSError as error:
        raise CalibrationError(f"cannot write the calibration to {file}: {error.strerror or error}") from None
