"""Focal length of an unknown camera, by bundle adjustment of short windows of frames."""

from scopemap.calibration.focal_length.adjustment import WindowFit, adjust_window
from scopemap.calibration.focal_length.choice import with_focal_from_motion
from scopemap.calibration.focal_length.estimate import FocalEstimate, combine, focal_from_motion
from scopemap.calibration.focal_length.windows import Window, windows_of

__all__ = [
    "FocalEstimate",
    "Window",
    "WindowFit",
    "adjust_window",
    "combine",
    "focal_from_motion",
    "windows_of",
    "with_focal_from_motion",
]
