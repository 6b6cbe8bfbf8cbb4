"""Calibration of a camera with a checkerboard or a ChArUco board: find, select, fit, judge, draw."""

from scopemap.calibration.calibrating import BoardCalibration, calibrate, save_calibration
from scopemap.calibration.targets import Board, CharucoBoard, Checkerboard
from scopemap.calibration.views import Search, find_views, picture_of

__all__ = [
    "Board",
    "BoardCalibration",
    "CharucoBoard",
    "Checkerboard",
    "Search",
    "calibrate",
    "find_views",
    "picture_of",
    "save_calibration",
]
