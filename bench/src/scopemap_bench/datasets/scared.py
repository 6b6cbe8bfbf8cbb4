"""SCARED and SCARED-C: da Vinci stereo video of porcine abdomens, surface from structured light.

A keyframe's folder: `endoscope_calibration.yaml`, `data/rgb.mp4` (left view above the right), `data/frame_data.tar.gz`
(poses from robot kinematics), `data/scene_points.tar.gz` (X, Y, Z per pixel in the camera's frame, mm, left above
right), or these archives unpacked. Frame number = order in the video, from 0. Copies hold the left views as images.
Allan et al., arXiv 2101.01133. SCARED-C: the left images with poses by structure from motion
(github.com/juseonghan/SCARED-C), with `intrinsics_colmap.yaml`, `frame_log.json`, `data/rgb_frames.tar.gz`. Frames
count from 1 and have gaps.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from math import gcd
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.errors import CalibrationError, InputError, reporting
from scopemap.engine.frame import TruthQuality
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.decoding import decoded, frame_number
from scopemap.input.images import ImageFolder, image_files, use_first_calibration
from scopemap.input.source import OWN_CALIBRATION, Source, SourceFrame
from scopemap.input.video import VideoFile
from scopemap_bench.trajectories.numbered import NumberedFiles, find_numbered
from scopemap_bench.trajectories.scared import find_frame_data, read_frame_data, times_of

_CALIBRATIONS = ("endoscope_calibration.yaml", "camera_calibration.yaml")
_VIDEOS = ("data/rgb.mp4", "rgb.mp4")
_IMAGES = ("image_02/data", "left", "data/left", "left_finalpass")
_SCENE_POINTS = ("data/scene_points", "scene_points", "image_02/data/groundtruth")
_INTRINSICS = "intrinsics_colmap.yaml"
_LOG = "frame_log.json"
_BADLY_CALIBRATED = (4, 5)
_STACKED_ASPECT = 1.4
# COLMAP puts the centre of the top-left pixel at (0.5, 0.5).
_COLMAP_CENTRE_PX = 0.5


class ScaredKeyframe(Source):
    """The left view of one keyframe's video, with its true poses and depth; `InputError` without a video."""

    name = "scared"
    quality: TruthQuality = "kinematic"

    def __init__(self, path: Path) -> None:
        super().__init__(_keyframe(path))
        self._pictures = self._find_pictures()
        self.rate_hz = self._pictures.rate_hz
        stacked = self._pictures.height > _STACKED_ASPECT * self._pictures.width
        self.width, self.height = self._pictures.width, self._pictures.height // (2 if stacked else 1)
        self.warnings = self._pictures.warnings
        self.numbers = self._common_numbers(self._read_frame_data())
        self.count = self._pictures.count if self.numbers is None else len(self.numbers)
        self._points = find_numbered(self.path, _SCENE_POINTS, "scene_points", (".tiff", ".tif"))
        self._calibrate()
        times = "those of frame_data" if self.stamped else f"frame number / {self.rate_hz:g} s"
        self.notes += [f"time stamps: {times}", *self._assumptions(stacked)]

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds a calibration of SCARED and `rgb.mp4` (here or in `data`) or left images."""
        path = _keyframe(path)
        has_pictures = any((path / name).is_file() for name in _VIDEOS) or any(image_files(path / n) for n in _IMAGES)
        return has_pictures and any((path / name).is_file() for name in _CALIBRATIONS)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected left views, decoded in order."""
        numbers = self.numbers
        if numbers is not None and isinstance(self._pictures, VideoFile):
            numbers = numbers[selection]
            first, last = (numbers[0], numbers[-1]) if numbers else (0, -1)
            selection = slice(first, last + 1, gcd(*(number - first for number in numbers)) or 1)
        for frame in self._pictures.frames(selection):
            if numbers is None or frame.index in numbers:
                time_s = frame.time_s if numbers is None else self._time_s(frame.index)
                yield replace(frame, time_s=time_s, rgb=np.ascontiguousarray(frame.rgb[: self.height]))

    def _find_pictures(self) -> VideoFile | ImageFolder:
        video = next((file for name in _VIDEOS if (file := self.path / name).is_file()), None)
        if video is not None:
            return VideoFile(video)
        place = next((self.path / name for name in _IMAGES if image_files(self.path / name)), None)
        if place is None:
            raise InputError(f"reading {self.path}: no SCARED keyframe with a video (rgb.mp4); give another keyframe")
        images = ImageFolder(place)
        if images.numbers[0] > 0:
            images.numbers = [number - 1 for number in images.numbers]
            self.notes.append("image number n is taken as frame n - 1: unpacked images count from 1")
        return images

    def _read_frame_data(self) -> list[int]:
        """Read all poses and time stamps, and return the frames' numbers; a file that cannot be used is a warning."""
        files = find_frame_data(self.path)
        frames = [] if files is None else read_frame_data(files)
        self.poses = {frame.index: frame.T_world_camera for frame in frames if frame.T_world_camera is not None}
        self.times_s, _ = times_of(frames)
        self.stamped = bool(self.times_s)
        faults = [frame.fault for frame in frames if frame.fault]
        if faults:
            without = f"files cannot be used, so their frames have no true pose (first: {faults[0]})"
            self._warn(f"{len(faults)} of {len(frames)} {without}")
        if not self.stamped and len({str(frame.stamp) for frame in frames}) > 1:
            self._warn(f"{self.path}: stamps in frame_data do not increase or only count frames; none is used")
        return [frame.index for frame in frames]

    def _common_numbers(self, posed: list[int]) -> list[int] | None:
        """Return the frames that have a picture and, where there is any, frame_data; None for a video without that."""
        pictures = self._pictures
        if isinstance(pictures, VideoFile):
            available = posed if pictures.count is None else list(range(pictures.count))
        else:
            available = pictures.numbers
        if not posed:
            return None if isinstance(pictures, VideoFile) else available
        common = sorted({*posed} & {*available})
        if not common:
            raise InputError(f"reading {self.path}: no picture has the number of a frame_data file")
        if len(common) < max(len(available), len(posed)):
            used = f"the {len(common)} frames that have both are used"
            self._warn(f"{self.path}: {len(available)} pictures, but {len(posed)} frame_data files; {used}")
        if isinstance(pictures, ImageFolder):
            pictures.files, pictures.numbers = [pictures.file_of[number] for number in common], common
        return common

    def _calibrate(self) -> None:
        use_first_calibration(self, *(self.path / name for name in (OWN_CALIBRATION, *_CALIBRATIONS)))

    def _assumptions(self, stacked: bool) -> list[str]:
        numbers = [int(n) for part in self.path.absolute().parts[-3:] for n in re.findall(r"dataset_?(\d+)", part)]
        if numbers and numbers[-1] in _BADLY_CALIBRATED:
            known = "its calibration is known to be inaccurate, and so is what is measured"
            self._warn(f"SCARED dataset {numbers[-1]}: {known}")
        notes = ["the view used: " + ("left, the upper half" if stacked else "the whole image")]
        if not self.poses:
            return [*notes, "no pose is known: frame_data is not there"]
        return [*notes, "truth: scan of the keyframe moved by robot kinematics; its error grows away from the keyframe"]

    def _depth_mm(self, index: int) -> np.ndarray | None:
        """Return the left view's depth (h, w) float32, NaN = unknown; None where the frame has no scene points."""
        if self._points is None or (content := self._points.read(index)) is None:
            return None
        points, where = decoded(content), f"reading {self._points.path}, frame {index}: scene points"
        if points is None or points.dtype != np.float32 or points.shape[2:] != (3,):
            raise InputError(f"{where} are no image of 3 32-bit floats")
        rows, columns = points.shape[:2]
        if rows * self.width not in (self.height * columns, 2 * self.height * columns):
            raise InputError(f"{where} of {columns}x{rows} px do not fit images of {self.width}x{self.height} px")
        # The left view is on top; OpenCV reverses X, Y, Z as it does R, G, B.
        depth_mm = points[: self.height * columns // self.width, :, 0] * np.float32(self.depth_scale_mm or 1.0)
        return np.where(np.isfinite(depth_mm) & (depth_mm > 0), depth_mm, np.float32(np.nan))


class ScaredCKeyframe(ScaredKeyframe):
    """The frames of one keyframe that COLMAP registered, read from their archive one at a time."""

    name = "scared-c"
    quality = "sfm"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds COLMAP's intrinsics and the frames."""
        return (path / _INTRINSICS).is_file() and _find_frames(path) is not None

    def _find_pictures(self) -> VideoFile | ImageFolder:
        files, log = _find_frames(self.path), self.path / _LOG
        if files is None:
            raise InputError(f"reading {self.path}: no SCARED-C keyframe, data/rgb_frames.tar.gz is not there")
        if not log.is_file():
            return _ArchivedImages(files, files.numbers())
        with reporting(f"cannot read included_frames in {log}"):
            included = sorted({int(number) for number in json.loads(log.read_bytes())["included_frames"]})
        if not included:
            raise InputError(f"reading {log}: included_frames names no frame")
        return _ArchivedImages(files, included)

    def _calibrate(self) -> None:
        file = self.path / _INTRINSICS
        if use_first_calibration(self, self.path / OWN_CALIBRATION):
            return
        if not file.is_file():
            missing = f"reading {self.path}: {_INTRINSICS} is not there; give a calibration (--camera)"
            self.camera_fault = CalibrationError(missing)
        else:
            pinhole = read_calibration(file, (self.width, self.height)).camera.central
            self.camera = replace(pinhole, cx=pinhole.cx - _COLMAP_CENTRE_PX, cy=pinhole.cy - _COLMAP_CENTRE_PX)
            self.camera_source = f"{_INTRINSICS}, pixel centres moved by half a pixel"

    def _assumptions(self, stacked: bool) -> list[str]:
        return ["truth: COLMAP's poses, scaled to the scan of the keyframe"]


class _ArchivedImages(ImageFolder):
    """Images in an archive, `frame<number>.png`; one that is missing or damaged is left out."""

    def __init__(self, archive: NumberedFiles, numbers: list[int]) -> None:
        self._archive = archive
        super().__init__(archive.path, [archive.path.parent / f"frame{number:06d}.png" for number in numbers])

    def _image(self, file: Path) -> np.ndarray | None:
        content = self._archive.read(frame_number(file) or 0)
        image = None if content is None else decoded(content, cv2.IMREAD_COLOR)
        return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _keyframe(path: Path) -> Path:
    calibrated = any((path.parent / name).is_file() for name in _CALIBRATIONS)
    return path.parent if path.name == "data" and calibrated else path


def _find_frames(path: Path) -> NumberedFiles | None:
    return find_numbered(path, ("data/rgb_frames", "rgb_frames"), "frame", (".png", ".jpg"))
