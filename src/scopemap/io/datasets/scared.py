"""SCARED: da Vinci stereo video of porcine abdomens, poses from robot kinematics, surface from structured light.

A keyframe's folder as it is downloaded, nothing unpacked: `endoscope_calibration.yaml`, `data/rgb.mp4` (left view above
the right), `data/frame_data.tar.gz`, `data/scene_points.tar.gz`. Copies that others have unpacked are read, too. Frame
number = order in the video, from 0 = number of the JSON and of the scene points. Allan et al., arXiv 2101.01133.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import gcd
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import CameraModel
from scopemap.cameras.formats.reading import read_calibration, stated_calibration
from scopemap.errors import CalibrationError, InputError
from scopemap.io.datasets.scared_files import KeyframeTruth, calibration_camera, read_frame_data
from scopemap.io.images import FOLDER_RATE_HZ, ImageFolder, image_files
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth
from scopemap.io.video import VideoFile

OWN_CALIBRATION = "camera.yaml"
_CALIBRATIONS = ("endoscope_calibration.yaml", "camera_calibration.yaml")
_VIDEOS = ("data/rgb.mp4", "rgb.mp4")
_IMAGES = ("image_02/data", "left", "data/left", "left_finalpass")
_RECTIFIED = "data/left_finalpass"
_STILL = "Left_Image.png"
_NAMED = re.compile(r"dataset_?\d+.*keyframe_?\d+")
_BADLY_CALIBRATED = (4, 5)
_STACKED_ASPECT = 1.4
_MOST_OFF_CENTRE = 0.25


class ScaredKeyframe(SourceDefaults):
    """The left view of one keyframe's video, with its true poses and depth where they lie beside it.

    Raises `InputError` for a keyframe that is a single picture, and `CalibrationError` for one that does not fit.
    """

    name = "scared"

    def __init__(self, path: Path) -> None:
        self.path = _keyframe(path)
        self._pictures, self._shift = _pictures(self.path)
        stacked = self._pictures.height > _STACKED_ASPECT * self._pictures.width
        self.width, self.height = self._pictures.width, self._pictures.height // (2 if stacked else 1)
        self._data = read_frame_data(self.path)
        self.notes, self.warnings = self._found_notes(stacked), self._pictures.warnings
        self.warnings += _faults_of(self.path) + self._data.faults
        self._numbers = self._common_numbers()
        self.count: int | None = self._pictures.count if self._numbers is None else len(self._numbers)
        self._calibrate()
        scale_mm = self.depth_scale_mm or 1.0
        self._truth = KeyframeTruth(self.path, self._data, (self.width, self.height), "kinematic", scale_mm)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a keyframe's folder, by its calibration file or its name, with pictures in it."""
        path = _keyframe(path)
        known = any((path / name).is_file() for name in _CALIBRATIONS)
        named = _NAMED.search("/".join(path.absolute().parts[-2:])) is not None
        return (known or named) and any((path / name).exists() for name in (*_VIDEOS, *_IMAGES, _RECTIFIED, _STILL))

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected left views, decoded in order."""
        for frame in self._chosen(selection):
            index = frame.index - self._shift
            time_s = frame.time_s if self._numbers is None else self._time_s(index)
            yield SourceFrame(index, time_s, np.ascontiguousarray(frame.rgb[: self.height]), frame.name)

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Return number and time of the selected frames; None for a video without frame_data."""
        return None if self._numbers is None else [(n, self._time_s(n)) for n in self._numbers[selection]]

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose by the robot's kinematics."""
        return self._truth.pose(index)

    def truth(self, index: int) -> SourceTruth | None:
        """Return pose and depth: the keyframe's scan, moved by the robot's kinematics."""
        return self._truth.of_frame(index)

    def _chosen(self, selection: slice) -> Iterator[SourceFrame]:
        if self._numbers is None or not isinstance(self._pictures, VideoFile):
            yield from self._pictures.frames(selection)
            return
        numbers = self._numbers[selection]
        if numbers:
            wanted = set(numbers)
            step = gcd(*(number - numbers[0] for number in numbers)) or 1
            frames = self._pictures.frames(slice(numbers[0], numbers[-1] + 1, step))
            yield from (frame for frame in frames if frame.index in wanted)

    def _common_numbers(self) -> list[int] | None:
        """Return the numbers of frames that have a picture and, where there is frame_data, a JSON of it."""
        pictures, posed = self._pictures, self._data.numbers
        if isinstance(pictures, VideoFile):
            if not posed:
                return None
            common = [n for n in posed if pictures.count is None or n < pictures.count]
            available = pictures.count or len(common)
        else:
            numbers = [number - self._shift for number in pictures.numbers]
            common = sorted(set(numbers) & set(posed)) if posed else numbers
            available = len(numbers)
        if not common:
            raise InputError(f"reading {self.path}: no picture has the number of a frame_data file")
        if len(common) < max(available, len(posed)):
            self.warnings.append(
                f"{self.path}: {available} pictures, but {len(posed)} frame_data files; the {len(common)} frames that "
                "have both are used"
            )
            self._keep(set(common))
        return common

    def _keep(self, wanted: set[int]) -> None:
        """Forget the images of other frames; a video passes over them."""
        pictures = self._pictures
        if isinstance(pictures, ImageFolder):
            kept = [f for n, f in zip(pictures.numbers, pictures.files, strict=True) if n - self._shift in wanted]
            self._pictures = ImageFolder(pictures.path, kept)
            self._pictures.warnings = self.warnings

    def _time_s(self, index: int) -> float:
        return self._data.times_s.get(index, index / self._rate_hz)

    @property
    def _rate_hz(self) -> float:
        return self._pictures.rate_hz if isinstance(self._pictures, VideoFile) else FOLDER_RATE_HZ

    def _calibrate(self) -> None:
        size = (self.width, self.height)
        file = next((self.path / n for n in (OWN_CALIBRATION, *_CALIBRATIONS) if (self.path / n).is_file()), None)
        if file is not None and file.name == OWN_CALIBRATION:
            self._use_calibration(stated_calibration(file, size))
        elif file is not None:
            calibration = read_calibration(file, size)
            self.camera, self.depth_scale_mm = calibration.camera, calibration.depth_scale_mm
            self.camera_source = f"{calibration.source} beside the frames"
        elif self._data.calibration is not None:
            self.camera = calibration_camera(self._data.calibration, size, f"frame_data of {self.path}")
            self.camera_source = "camera-calibration in frame_data"
        if self.camera is not None and (file is None or file.name != OWN_CALIBRATION):
            _check_centred(self.camera, self.path)

    def _found_notes(self, stacked: bool) -> list[str]:
        self.stamped = bool(self._data.times_s)
        times = "those of frame_data" if self.stamped else f"frame number / {self._rate_hz:g} s"
        notes = [
            f"time stamps: {times}",
            "the view used: " + ("left, the upper half" if stacked else "the whole image"),
        ]
        if self._shift:
            notes.append("image number n is taken as frame n - 1: images that a video was unpacked to count from 1")
        if not self._data.poses:
            return [*notes, "no pose is known: frame_data is not there"]
        return [*notes, "truth: scan of the keyframe moved by robot kinematics; its error grows away from the keyframe"]


def _keyframe(path: Path) -> Path:
    """Return the keyframe's folder, also where its `data` was named."""
    calibrated = any((path.parent / name).is_file() for name in _CALIBRATIONS)
    return path.parent if path.name == "data" and calibrated else path


def _pictures(path: Path) -> tuple[VideoFile | ImageFolder, int]:
    """Return what holds the pictures, and what is to be taken from their numbers to count frames from 0."""
    for place in _VIDEOS:
        if (path / place).is_file():
            return VideoFile(path / place), 0
    for place in _IMAGES:
        if (path / place).is_dir() and image_files(path / place):
            folder = ImageFolder(path / place)
            return folder, 0 if folder.numbers[0] == 0 else 1
    if (path / _RECTIFIED).is_dir():
        raise InputError(
            f"reading {path}: {_RECTIFIED} holds rectified images, to which neither the calibration nor the poses "
            "belong; give the folder with rgb.mp4"
        )
    if (path / _STILL).is_file():
        raise InputError(
            f"reading {path}: this SCARED keyframe is a single stereo picture without a video (rgb.mp4), a sequence "
            "needs two frames; give another keyframe"
        )
    raise InputError(f"reading {path}: no SCARED keyframe, looked for {', '.join((*_VIDEOS, *_IMAGES))}")


def _faults_of(path: Path) -> list[str]:
    parts = path.absolute().parts[-3:]
    numbers = [int(match[1]) for part in reversed(parts) if (match := re.search(r"dataset_?(\d+)", part))]
    if not numbers or numbers[0] not in _BADLY_CALIBRATED:
        return []
    return [f"SCARED dataset {numbers[0]}: its calibration is known to be inaccurate; figures measured on it mislead"]


def _check_centred(camera: CameraModel, path: Path) -> None:
    central = camera.central
    off = max(abs((central.cx + 0.5) / camera.width - 0.5), abs((central.cy + 0.5) / camera.height - 0.5))
    if off > _MOST_OFF_CENTRE:
        raise CalibrationError(
            f"the calibration of {path} does not fit images of {camera.width}x{camera.height} px: its principal point "
            f"{central.cx:g}, {central.cy:g} lies far off their middle; for reduced images put their own "
            f"{OWN_CALIBRATION} there"
        )
