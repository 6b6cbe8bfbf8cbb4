"""The focal length of an unknown camera, from how tissue moves through its picture: windows of frames are adjusted."""

from scopemap.calibration.focal_length.adjustment import WindowFit, adjusted
from scopemap.calibration.focal_length.choice import with_focal_from_motion
from scopemap.calibration.focal_length.estimate import FocalEstimate, focal_from_motion, together
from scopemap.calibration.focal_length.windows import Window, windows_of

__all__ = [
    "FocalEstimate",
    "Window",
    "WindowFit",
    "adjusted",
    "focal_from_motion",
    "together",
    "windows_of",
    "with_focal_from_motion",
]
