"""The contract of a reader: frames as they are in a file or a data set, with their camera and truth where known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.calibration import Calibration
from scopemap.cameras.rectification import DepthSensor
from scopemap.errors import InputError, ScopemapError
from scopemap.frame import TruthQuality


@dataclass(frozen=True)
class SourceFrame:
    """One image as it is in the file, not rectified.

    Attributes
    ----------
    index : number of the frame in the input.
    time_s : time stamp, s.
    rgb : (h, w, 3) uint8, sRGB.
    name : the file's own name, or "".
    """

    index: int
    time_s: float
    rgb: np.ndarray
    name: str = ""


@dataclass(frozen=True)
class SourceTruth:
    """What is known to be true of an image, in the geometry of the file.

    Attributes
    ----------
    T_world_camera : (4, 4) float64, mm, or None.
    depth_mm : (h, w) float32 along the optical axis, NaN = unknown, of the image's view or what the source's
        `depth_sensor` sees, at any size; or None.
    quality : how the truth came about.
    """

    T_world_camera: np.ndarray | None
    depth_mm: np.ndarray | None
    quality: TruthQuality


class Source(Protocol):
    """Something that holds frames: a video, a folder of one data set's layout.

    Attributes
    ----------
    name : the data set's name.
    path : the file or folder.
    width, height : size of the images, px.
    count : number of frames, or None where only reading on would tell.
    calibration : what the calibration file beside the frames says, of whatever size; None where there is none.
    camera : the camera of the images, or None where it is unknown; that of `calibration` where there is one.
    camera_source : how the camera is known, one phrase, or "".
    camera_fault : why the data set's own camera cannot be used, None where it can.
    pixel_aspect : width of a pixel over its height.
    stamped : whether its time stamps are its own; False: frame numbers over an assumed rate.
    depth_scale_mm : mm per unit of depth files by the calibration beside the frames, or None.
    depth_sensor : the camera that took the depth files beside the frames, None where they show what the images show.
    masks : folder of the data set's own masks of what is no tissue, as `MaskFiles` reads them, or None.
    notes : what had to be assumed.
    warnings : what was found wrong so far; grows while frames are read.
    """

    name: str
    path: Path
    width: int
    height: int
    count: int | None
    calibration: Calibration | None
    camera: CameraModel | None
    camera_source: str
    camera_fault: ScopemapError | None
    pixel_aspect: float
    stamped: bool
    depth_scale_mm: float | None
    depth_sensor: DepthSensor | None
    masks: Path | None
    notes: list[str]
    warnings: list[str]

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames, decoded one at a time; `selection` counts positions, its step is positive."""

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Return (index, time_s) of each selected frame, no image decoded; None where only reading on would tell."""

    def media(self) -> str | None:
        """Return the name that FFmpeg opens where the frames are those of one video; None elsewhere."""

    def pose(self, index: int) -> np.ndarray | None:
        """Return the true pose (4, 4), camera to world, mm, of the frame with this index, or None; reads no depth."""

    def truth(self, index: int) -> SourceTruth | None:
        """Return what is known of the frame with this `SourceFrame.index`, or None."""


class SourceDefaults:
    """Attributes of a `Source` of which nothing but the frames is known; readers derive from it."""

    pixel_aspect = 1.0
    stamped = False
    calibration: Calibration | None = None
    camera: CameraModel | None = None
    camera_source = ""
    camera_fault: ScopemapError | None = None
    depth_scale_mm: float | None = None
    depth_sensor: DepthSensor | None = None
    masks: Path | None = None
    warnings: list[str]
    width: int
    height: int

    def media(self) -> str | None:
        """Nothing: no video."""
        return None

    def pose(self, index: int) -> np.ndarray | None:
        """No pose is known."""
        return None

    def truth(self, index: int) -> SourceTruth | None:
        """No truth is known."""
        return None

    def _check_size(self, rgb: np.ndarray, what: str) -> None:
        """Raise `InputError` where an image is not of the source's size."""
        height, width = rgb.shape[:2]
        if (width, height) != (self.width, self.height):
            raise InputError(
                f"reading {what} is {width}x{height} px, those before it are {self.width}x{self.height} px; a sequence "
                "needs frames of one size"
            )

    def _warn(self, message: str) -> None:
        if message not in self.warnings:
            self.warnings.append(message)

    def _use_calibration(self, calibration: Calibration) -> None:
        """Use the calibration beside the frames, which comes before a data set's own; opening fits it."""
        self.calibration = replace(calibration, source=f"{calibration.source} beside the frames")
        self.camera, self.camera_source = calibration.camera, self.calibration.source
        self.depth_scale_mm = calibration.depth_scale_mm


def assumed_camera(source: Source, focal_px: float) -> PinholeCamera:
    """Return a pinhole camera with horizontal focal length `focal_px` and its axis through the image's centre."""
    cx, cy = (source.width - 1) / 2, (source.height - 1) / 2
    return PinholeCamera(focal_px, focal_px * source.pixel_aspect, cx, cy, source.width, source.height)
