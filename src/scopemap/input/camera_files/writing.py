"""Writing a camera down, as OpenCV YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import OmnidirectionalCamera
from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files.lens_models import LENS_MODELS, OPENCV


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
    model, plane, terms = _lens(camera)
    # In memory: OpenCV takes no names outside of the system's code page on Windows.
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", plane.matrix)
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


def _lens(camera: CameraModel) -> tuple[str, PinholeCamera, dict[str, Any]]:
    """Return the name of a camera's lens, the camera that takes its plane to pixels, and its own terms by name.

    Raises `CalibrationError` for a lens without a name here.
    """
    if isinstance(camera, OmnidirectionalCamera):
        return "omnidirectional", camera.central, {"polynomial": camera.polynomial, "stretch": camera.stretch}
    if isinstance(camera, PinholeCamera):
        return OPENCV.name, camera, {"distortion_coefficients": (0.0,) * 5}
    for lens in LENS_MODELS:
        if isinstance(camera, lens.camera):
            return lens.name, camera.plane, {"distortion_coefficients": lens.coefficients(camera)}
    raise CalibrationError(f"cannot write the calibration: {type(camera).__name__} is no lens that the format knows")
