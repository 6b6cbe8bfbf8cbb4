"""`StereoCalibration.ini`, in which da Vinci recordings such as StereoMIS come; the left camera is read."""

from __future__ import annotations

import configparser
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.contents import calibration_text
from scopemap.cameras.formats.stated import LARGEST_SIDE_PX
from scopemap.cameras.lenses import OpenCvCamera
from scopemap.errors import CalibrationError

_LEFT = "StereoLeft"
_MOST_LENS_TERMS = 8


def is_stereo_ini(text: str) -> bool:
    """Whether a text has the section of the left camera."""
    return any(line.strip() == f"[{_LEFT}]" for line in text.splitlines())


def read_left_camera(file: Path) -> CameraModel:
    """Return the left camera of a `StereoCalibration.ini`, at the size that it was calibrated at.

    `[StereoLeft]` holds res_x, res_y, fc_x, fc_y, cc_x, cc_y and the lens kc_0 ... in OpenCV's order. Raises
    `CalibrationError` where one of them is missing or no number.
    """
    try:
        return of_stereo_ini(calibration_text(file))
    except ValueError as error:
        raise CalibrationError(f"cannot read the calibration in {file}: {error}") from None


def of_stereo_ini(text: str) -> CameraModel:
    """Return the left camera of the file's text; `ValueError` where a number of it is missing or none."""
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(text)
        left = parser[_LEFT]
        size = [float(left[key]) for key in ("res_x", "res_y")]
        fx, fy, cx, cy = (float(left[key]) for key in ("fc_x", "fc_y", "cc_x", "cc_y"))
        lens = tuple(float(left[key]) for i in range(_MOST_LENS_TERMS) if (key := f"kc_{i}") in left)
    except KeyError as error:
        raise ValueError(f"{error} is missing") from None
    except configparser.Error as error:
        raise ValueError(str(error).partition("\n")[0]) from None
    if not np.isfinite([*size, fx, fy, cx, cy, *lens]).all() or min(size) < 1 or max(size) > LARGEST_SIDE_PX:
        raise ValueError(f"[{_LEFT}] holds NaN, infinity or a size that is none")
    pinhole = PinholeCamera(fx, fy, cx, cy, round(size[0]), round(size[1]))
    return OpenCvCamera(pinhole, lens) if any(lens) else pinhole
