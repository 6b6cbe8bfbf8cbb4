"""Writing a camera down, as OpenCV YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, FovCamera, OmnidirectionalCamera, OpenCvCamera
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
    standard deviation of fx; `rate_hz` as `fps`. Raises `CalibrationError` for a lens that the format does not know
    and where the file cannot be written.
    """
    model, terms = _lens(camera)
    # In memory: OpenCV takes no names outside of the system's code page on Windows.
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", (camera.plane if isinstance(camera, FovCamera) else camera.central).matrix)
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


def _lens(camera: CameraModel) -> tuple[str, dict[str, Any]]:
    """Return the name of a camera's lens, and its own terms by name; `CalibrationError` for one without a name here."""
    if isinstance(camera, OmnidirectionalCamera):
        return "omnidirectional", {"polynomial": camera.polynomial, "stretch": camera.stretch}
    if isinstance(camera, FovCamera):
        return "fov", {"distortion_coefficients": (camera.omega,)}
    if isinstance(camera, FisheyeCamera | OpenCvCamera):
        model = "fisheye" if isinstance(camera, FisheyeCamera) else "opencv"
        return model, {"distortion_coefficients": camera.distortion}
    if isinstance(camera, PinholeCamera):
        return "opencv", {"distortion_coefficients": (0.0,) * 5}
    raise CalibrationError(f"cannot write the calibration: {type(camera).__name__} is no lens that the format knows")
