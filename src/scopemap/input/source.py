"""The contract of a reader: frames as they are in a file or a data set, with their camera and truth where known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.rectification import DepthSensor
from scopemap.engine.errors import InputError, ScopemapError
from scopemap.engine.frame import TruthQuality
from scopemap.engine.notices import Notice
from scopemap.input.camera_files.calibration import Calibration, fitted
from scopemap.input.sampling import SampledPair, pairs_in_order

ASSUMED_RATE_HZ = 30.0
"""Frames per s of inputs that state none."""

OWN_CALIBRATION = "camera.yaml"
"""Calibration file beside the frames, which comes before a data set's own."""

# Of the width or height: cropping tools leave pictures a pixel apart.
_MOST_CHANGE = 0.01


@dataclass(frozen=True)
class SourceFrame:
    """One image as it is in the file, not rectified.

    index : number of the frame in the input. time_s : time stamp, s. rgb : (h, w, 3) uint8, sRGB. name : the file's
    own name, or "". second : the right view where both views of a stereo pair are used, as `rgb`; or None.
    """

    index: int
    time_s: float
    rgb: np.ndarray
    name: str = ""
    second: np.ndarray | None = None


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that was read and not used: its index, time and name, and why, in one word and as a phrase."""

    index: int
    time_s: float
    name: str
    kind: Literal["repeated", "thinned", "size"]
    reason: str


@dataclass(frozen=True)
class SourceTruth:
    """What is known to be true of an image, in the geometry of the file.

    T_world_camera : (4, 4) float64, mm, or None. depth_mm : (h, w) float32 along the optical axis, NaN = unknown, of
    the image's view or what the source's `depth_sensor` sees, at any size; or None. quality : how the truth came about.
    """

    T_world_camera: np.ndarray | None
    depth_mm: np.ndarray | None
    quality: TruthQuality


class Source:
    """Frames of a video, a folder or a data set, as they are in the files. Readers derive from it.

    Attributes
    ----------
    name : the data set's name. path : the file or folder.
    width, height : size of the images, px. pixel_aspect : width of a pixel over its height.
    count : number of frames. numbers : the frames' numbers. Both are None where only reading on tells.
    stamped : whether its time stamps are its own; False: frame numbers over an assumed rate.
    times_s : time stamps, s, by frame number; a frame without one has its number / `rate_hz`.
    calibration : content of the calibration file beside the frames, of whatever size; None where there is none.
    camera : the camera of the images, or None where it is unknown; that of `calibration` where there is one.
    camera_source : how the camera is known, one phrase, or "".
    camera_fault : why the data set's own camera cannot be used, None where it can.
    poses : true poses, camera to world, (4, 4) float64, mm, by frame number. quality : how poses and depth came about.
    depth_scale_mm : mm per unit of depth files by the calibration beside the frames, or None.
    depth_sensor : the camera that took the depth files beside the frames, None where they show what the images show.
    frame_limit_s : longest time that a frame may take to read, s, and a second for each that is passed over; None: any.
    camera_at_rest : whether the data set states that the camera does not move.
    masks : folder of the data set's own masks of what is no tissue, as `MaskFiles` reads them, or None.
    notes : what had to be assumed.
    warnings : what was found wrong so far; grows while frames are read.
    left_out, resized : pictures of another size so far, by frame number: those that are not used, and the names of
        those that differ by at most 1 % and were cut.
    """

    name: str
    width: int
    height: int
    pixel_aspect = 1.0
    count: int | None = None
    numbers: Sequence[int] | None = None
    stamped = False
    rate_hz = ASSUMED_RATE_HZ
    frame_limit_s: float | None = 120.0
    calibration: Calibration | None = None
    camera: CameraModel | None = None
    camera_source = ""
    camera_fault: ScopemapError | None = None
    quality: TruthQuality = "registered"
    depth_scale_mm: float | None = None
    depth_sensor: DepthSensor | None = None
    camera_at_rest = False
    masks: Path | None = None
    warnings: list[str | Notice]
    left_out: dict[int, SkippedFrame]
    resized: dict[int, str]

    def __init__(self, path: Path) -> None:
        self.path = path
        self.poses: dict[int, np.ndarray] = {}
        self.times_s: dict[int, float] = {}
        self.notes: list[str | Notice] = []
        self.warnings = []
        self.left_out, self.resized = {}, {}

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` is of this kind."""
        return False

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames, decoded one at a time; `selection` counts positions, its step is positive."""
        return iter(())

    def entry(self, number: int) -> int:
        """Return the position of the picture from which on the input is read for the one at a position; 0: from all."""
        return 0

    def begin_at(self, selection: slice) -> None:
        """Take what may change within the input, such as the pictures' size, as it is at the first selected frame."""

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Return (index, time_s) of each selected frame, no image decoded; None where only reading on would tell."""
        return None if self.numbers is None else [(number, self._time_s(number)) for number in self.numbers[selection]]

    def sample_pairs(self, count: int) -> list[SampledPair]:
        """Return about `count` pictures from all parts of the input, or of its begin, each with the next other one."""
        return pairs_in_order(self.frames(slice(None)), count, lambda frame: frame.rgb)

    def media(self) -> str | None:
        """Return the name that FFmpeg opens where the frames are those of one video; None elsewhere."""
        return None

    def picture_files(self) -> dict[int, Path]:
        """Return the files of the frames by number; none where they are no pictures in a folder."""
        return {}

    def pose(self, index: int) -> np.ndarray | None:
        """Return the true pose (4, 4), camera to world, mm, of the frame with this index, or None; reads no depth."""
        return self.poses.get(index)

    def truth(self, index: int) -> SourceTruth | None:
        """Return pose and depth of the frame with this `SourceFrame.index`; None where neither is known."""
        pose, depth_mm = self.pose(index), self._depth_mm(index)
        return None if pose is None and depth_mm is None else SourceTruth(pose, depth_mm, self.quality)

    def _depth_mm(self, index: int) -> np.ndarray | None:
        return None

    def _time_s(self, number: int) -> float:
        return self.times_s.get(number, number / self.rate_hz)

    def _of_one_size(self, frame: SourceFrame) -> SourceFrame | None:
        """Return a frame with a picture of the source's size, or None where its size differs by more than 1 %.

        One that differs by less is cut at the right and the bottom, or its last pixels there are repeated, so that
        every pixel stays where it is.
        """
        height, width = frame.rgb.shape[:2]
        if (width, height) == (self.width, self.height):
            return frame
        sides = ((width, self.width), (height, self.height))
        if all(abs(found - usual) <= max(1.0, _MOST_CHANGE * usual) for found, usual in sides):
            self.resized[frame.index] = frame.name or f"frame {frame.index}"
            missing = max(self.height - height, 0), max(self.width - width, 0)
            rgb = frame.rgb[: self.height, : self.width]
            return replace(frame, rgb=cv2.copyMakeBorder(rgb, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE))
        reason = f"{width}x{height} px, others are {self.width}x{self.height} px"
        self.left_out[frame.index] = SkippedFrame(frame.index, frame.time_s, frame.name, "size", reason)
        return None

    def check_sizes(self, used: int) -> None:
        """Raise `InputError` where more pictures were left out for their size than used."""
        if len(self.left_out) > used:
            first = self.left_out[min(self.left_out)]
            differ = f"{len(self.left_out)} of {len(self.left_out) + used} pictures have another size"
            such = f"such as {first.name or f'frame {first.index}'}, {first.reason}"
            choose = f"choose those of one size, such as --frames {self._longest_left_out()}"
            raise InputError(f"reading {self.path}: {differ}, {such}; {choose}")

    def _longest_left_out(self) -> str:
        """Return the longest part of the input, A:B, in which all pictures that were left out have one size."""
        places = {number: place for place, number in enumerate(self.numbers or ())}
        parts, last = list[list[int]](), ("", -1)
        for index, frame in sorted(self.left_out.items()):
            place = places.get(index, index)
            if last == (frame.reason, place - 1) and parts:
                parts[-1].append(place)
            else:
                parts.append([place])
            last = (frame.reason, place)
        longest = max(parts, key=len)
        return f"{longest[0]}:{longest[-1] + 1}"

    @property
    def size_notices(self) -> list[Notice]:
        """What was done so far with pictures of other sizes."""
        usual, found = f"{self.width}x{self.height}", list[Notice]()
        if self.resized:
            first = self.resized[min(self.resized)]
            found.append(Notice("input-resized", {"frames": len(self.resized), "size": usual, "first": first}))
        if self.left_out:
            out = self.left_out[min(self.left_out)]
            named = {"first": out.name or f"frame {out.index}", "reason": out.reason}
            found.append(Notice("input-other-size", {"frames": len(self.left_out)} | named))
        return found

    def _warn(self, message: str | Notice) -> None:
        if message not in self.warnings:
            self.warnings.append(message)

    def _set_camera(self, camera: CameraModel, source: str, name: str) -> None:
        """Take the data set's `camera`, resized to the images; `source` is a phrase, `name` how errors call it."""
        calibration = fitted(Calibration(camera, None, source, file=name), (self.width, self.height), "scale")
        self.camera, self.camera_source = calibration.camera, calibration.source


def assumed_camera(source: Source, focal_px: float) -> PinholeCamera:
    """Return a pinhole camera with horizontal focal length `focal_px` and its axis through the image's centre."""
    cx, cy = (source.width - 1) / 2, (source.height - 1) / 2
    return PinholeCamera(focal_px, focal_px * source.pixel_aspect, cx, cy, source.width, source.height)
