"""Calibu's XML, in which EndoMapper's calibrations come: `rig` > `camera` > `camera_model type="calibu_..."`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.contents import calibration_text
from scopemap.cameras.formats.stated import LARGEST_SIDE_PX
from scopemap.cameras.formats.trees import xml_root
from scopemap.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.errors import CalibrationError

_PINHOLE = "calibu_fu_fv_u0_v0"
_PARAMETERS = {_PINHOLE: 4, f"{_PINHOLE}_k1_k2": 6, f"{_PINHOLE}_kb4": 8}


def read_calibu(file: Path) -> CameraModel:
    """Return the camera of a Calibu XML file, at the size that it was calibrated at.

    `calibu_fu_fv_u0_v0` is a pinhole, `..._k1_k2` has OpenCV's two radial terms, `..._kb4` is Kannala-Brandt's fisheye.
    Raises `CalibrationError` where the file holds none of them.
    """
    try:
        return of_calibu(calibration_text(file))
    except ValueError as error:
        raise CalibrationError(f"cannot read the calibration in {file}: {error}") from None


def of_calibu(text: str) -> CameraModel:
    """Return the camera of a Calibu XML text; `ValueError` where it holds none."""
    model = xml_root(text.lstrip()).find(".//camera_model")
    if model is None:
        raise ValueError("it has no camera_model")
    kind = model.get("type", "")
    if kind not in _PARAMETERS:
        raise ValueError(f"the type {kind[:40]!r} is not known ({', '.join(_PARAMETERS)})")
    width, height = (int(model.findtext(side, "")) for side in ("width", "height"))
    values = [float(value) for value in re.findall(r"[^\s\[\];,]+", model.findtext("params", ""))]
    is_size = 0 < width <= LARGEST_SIDE_PX and 0 < height <= LARGEST_SIDE_PX
    if len(values) != _PARAMETERS[kind] or not np.isfinite(values).all() or not is_size:
        raise ValueError(
            f"it holds {len(values)} parameters for {width}x{height} px, expected {_PARAMETERS[kind]} finite ones for "
            f"{kind}"
        )
    fx, fy, cx, cy, *lens = values
    pinhole = PinholeCamera(fx, fy, cx, cy, width, height)
    if not any(lens):
        return pinhole
    return FisheyeCamera(pinhole, tuple(lens)) if len(lens) == 4 else OpenCvCamera(pinhole, (*lens, 0.0, 0.0))
