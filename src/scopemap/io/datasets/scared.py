"""SCARED and SCARED-C: da Vinci stereo video of porcine abdomens, surface from structured light.

SCARED, a keyframe's folder as it is downloaded: `endoscope_calibration.yaml`, `data/rgb.mp4` (left view above the
right), `data/frame_data.tar.gz` (poses from robot kinematics), `data/scene_points.tar.gz`, or these archives unpacked.
Frame number = order in the video, from 0 = number of the JSON and of the scene points. A scene point file holds X, Y, Z
per pixel in the camera's frame, mm, the left view above the right one. Allan et al., "Stereo correspondence and
reconstruction of endoscopic data challenge", arXiv 2101.01133.

SCARED-C: SCARED's left images with poses by structure from motion (github.com/juseonghan/SCARED-C): also
`intrinsics_colmap.yaml`, `frame_log.json` and `data/rgb_frames.tar.gz`. Frames count from 1 and have gaps, where COLMAP
registered none.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from math import gcd
from pathlib import Path

import numpy as np

from scopemap.cameras.formats.reading import read_calibration, stated_calibration
from scopemap.errors import CalibrationError, InputError
from scopemap.frame import TruthQuality
from scopemap.io.datasets.numbered import NumberedFiles, find_numbered
from scopemap.io.decoding import decoded, reporting
from scopemap.io.images import OWN_CALIBRATION, ImageFolder, decoded_image, frame_number
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth
from scopemap.io.video import VideoFile
from scopemap.trajectory.formats.scared import parse_frame_data, times_of

_CALIBRATION = "endoscope_calibration.yaml"
_VIDEOS = ("data/rgb.mp4", "rgb.mp4")
_FRAME_DATA = ("data/frame_data", "frame_data")
_SCENE_POINTS = ("data/scene_points", "scene_points")
_INTRINSICS, _LOG = "intrinsics_colmap.yaml", "frame_log.json"
_BADLY_CALIBRATED = (4, 5)
_STACKED_ASPECT = 1.4
# COLMAP puts the centre of the top-left pixel at (0.5, 0.5).
_COLMAP_CENTRE_PX = 0.5


class ScaredKeyframe(SourceDefaults):
    """The left view of one keyframe's video, with its true poses and depth where they are beside it.

    Raises `InputError` for a keyframe without a video, and `CalibrationError` for a calibration that does not fit.
    """

    name = "scared"
    quality: TruthQuality = "kinematic"

    def __init__(self, path: Path) -> None:
        self.path = _keyframe(path)
        self._pictures = self._find_pictures()
        self._rate_hz = self._pictures.rate_hz
        stacked = self._pictures.height > _STACKED_ASPECT * self._pictures.width
        self.width, self.height = self._pictures.width, self._pictures.height // (2 if stacked else 1)
        self.notes: list[str] = []
        self.warnings = self._pictures.warnings
        self._read_frame_data()
        self._numbers = self._common_numbers()
        self.count: int | None = self._pictures.count if self._numbers is None else len(self._numbers)
        self._points = find_numbered(self.path, _SCENE_POINTS, "scene_points", (".tiff", ".tif"))
        self._calibrate()
        times = "those of frame_data" if self.stamped else f"frame number / {self._rate_hz:g} s"
        self.notes += [f"time stamps: {times}", *self._assumptions(stacked)]

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds `endoscope_calibration.yaml` and `rgb.mp4`, here or in `data`."""
        path = _keyframe(path)
        return (path / _CALIBRATION).is_file() and any((path / name).is_file() for name in _VIDEOS)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected left views, decoded in order."""
        for frame in self._selected(selection):
            time_s = frame.time_s if self._numbers is None else self._time_s(frame.index)
            yield replace(frame, time_s=time_s, rgb=np.ascontiguousarray(frame.rgb[: self.height]))

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Return number and time of the selected frames; None for a video without frame_data."""
        return None if self._numbers is None else [(n, self._time_s(n)) for n in self._numbers[selection]]

    def pose(self, index: int) -> np.ndarray | None:
        """Return the camera-to-world pose (4, 4), mm, or None."""
        return self._poses.get(index)

    def truth(self, index: int) -> SourceTruth | None:
        """Return pose and depth: the keyframe's scan, seen from that pose. None where neither is known."""
        pose, depth_mm = self.pose(index), self._depth_mm(index)
        return None if pose is None and depth_mm is None else SourceTruth(pose, depth_mm, self.quality)

    def _find_pictures(self) -> VideoFile | ImageFolder:
        video = next((file for name in _VIDEOS if (file := self.path / name).is_file()), None)
        if video is None:
            raise InputError(f"reading {self.path}: no SCARED keyframe with a video (rgb.mp4); give another keyframe")
        return VideoFile(video)

    def _read_frame_data(self) -> None:
        """Read all poses and time stamps; a file that cannot be used is a warning."""
        files = find_numbered(self.path, _FRAME_DATA, "frame_data", (".json",))
        frames = []
        for number in files.numbers() if files is not None else []:
            content = files.read(number) if files is not None else None
            frames.append(parse_frame_data(f"frame_data{number:06d}.json", number, content or b""))
        self._posed = [frame.index for frame in frames]
        self._poses = {frame.index: frame.T_world_camera for frame in frames if frame.T_world_camera is not None}
        self._times_s, _ = times_of(frames)
        self.stamped = bool(self._times_s)
        faults = [frame.fault for frame in frames if frame.fault]
        if faults and files is not None:
            self.warnings.append(
                f"{files.path}: {len(faults)} of {len(frames)} files cannot be used, so their frames have no true pose "
                f"(first: {faults[0]})"
            )
        stamps = [frame.stamp for frame in frames]
        if files is not None and frames and not self.stamped and len({str(stamp) for stamp in stamps}) > 1:
            self.warnings.append(f"{files.path}: its time stamps do not increase or only count frames; none is used")

    def _common_numbers(self) -> list[int] | None:
        """Return the numbers of frames that have a picture and, where there is frame_data, a JSON of it.

        None for a video without frame_data.
        """
        pictures = self._pictures
        is_video = isinstance(pictures, VideoFile)
        if not self._posed or (is_video and pictures.count is None):
            return pictures.numbers if isinstance(pictures, ImageFolder) else self._posed or None
        available = set(pictures.numbers) if isinstance(pictures, ImageFolder) else range(pictures.count or 0)
        common = [number for number in self._posed if number in available]
        if not common:
            raise InputError(f"reading {self.path}: no picture has the number of a frame_data file")
        if len(common) < max(len(available), len(self._posed)):
            self.warnings.append(
                f"{self.path}: {len(available)} pictures, but {len(self._posed)} frame_data files; the {len(common)} "
                "frames that have both are used"
            )
        if isinstance(pictures, ImageFolder):
            pictures.files, pictures.numbers = [pictures.file_of[number] for number in common], common
        return common

    def _selected(self, selection: slice) -> Iterator[SourceFrame]:
        if self._numbers is None or isinstance(self._pictures, ImageFolder):
            yield from self._pictures.frames(selection)
            return
        numbers = self._numbers[selection]
        if numbers:
            step = gcd(*(number - numbers[0] for number in numbers)) or 1
            frames = self._pictures.frames(slice(numbers[0], numbers[-1] + 1, step))
            yield from (frame for frame in frames if frame.index in set(numbers))

    def _calibrate(self) -> None:
        size = (self.width, self.height)
        own = self.path / OWN_CALIBRATION
        if own.is_file():
            self._use_calibration(stated_calibration(own, size))
        elif (self.path / _CALIBRATION).is_file():
            calibration = read_calibration(self.path / _CALIBRATION, size)
            self.camera, self.depth_scale_mm = calibration.camera, calibration.depth_scale_mm
            self.camera_source = f"{calibration.source} beside the frames"

    def _assumptions(self, stacked: bool) -> list[str]:
        numbers = [int(n) for part in self.path.absolute().parts[-3:] for n in re.findall(r"dataset_?(\d+)", part)]
        if numbers and numbers[-1] in _BADLY_CALIBRATED:
            self.warnings.append(
                f"SCARED dataset {numbers[-1]}: its calibration is known to be inaccurate, and so is what is measured"
            )
        notes = ["the view used: " + ("left, the upper half" if stacked else "the whole image")]
        if not self._poses:
            return [*notes, "no pose is known: frame_data is not there"]
        return [*notes, "truth: scan of the keyframe moved by robot kinematics; its error grows away from the keyframe"]

    def _time_s(self, index: int) -> float:
        return self._times_s.get(index, index / self._rate_hz)

    def _depth_mm(self, index: int) -> np.ndarray | None:
        """Return the left view's depth (h, w) float32, NaN = unknown; None where the frame has no scene points."""
        if self._points is None or (content := self._points.read(index)) is None:
            return None
        points = decoded(content)
        if points is None or points.dtype != np.float32 or points.shape[2:] != (3,):
            raise InputError(
                f"reading {self._points.path}, frame {index}: scene points are no image of 3 32-bit floats"
            )
        rows, columns = points.shape[:2]
        if rows * self.width not in (self.height * columns, 2 * self.height * columns):
            raise InputError(
                f"reading {self._points.path}, frame {index}: scene points of {columns}x{rows} px do not fit images of "
                f"{self.width}x{self.height} px"
            )
        # The left view is on top; OpenCV reverses X, Y, Z as it does R, G, B.
        depth_mm = points[: self.height * columns // self.width, :, 0] * np.float32(self.depth_scale_mm or 1.0)
        return np.where(np.isfinite(depth_mm) & (depth_mm > 0), depth_mm, np.float32(np.nan))


class ScaredCKeyframe(ScaredKeyframe):
    """The frames of one keyframe that COLMAP registered, read out of their archive one at a time.

    Raises `InputError` where there are no frames, and `CalibrationError` for intrinsics that do not fit.
    """

    name = "scared-c"
    quality: TruthQuality = "sfm"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds COLMAP's intrinsics and the frames."""
        return (path / _INTRINSICS).is_file() and _find_frames(path) is not None

    def _find_pictures(self) -> VideoFile | ImageFolder:
        files = _find_frames(self.path)
        if files is None:
            raise InputError(f"reading {self.path}: no SCARED-C keyframe, data/rgb_frames.tar.gz is not there")
        log = self.path / _LOG
        return _ArchivedImages(files, _read_log(log) if log.is_file() else files.numbers())

    def _calibrate(self) -> None:
        size = (self.width, self.height)
        own, file = self.path / OWN_CALIBRATION, self.path / _INTRINSICS
        if own.is_file():
            self._use_calibration(stated_calibration(own, size))
        elif not file.is_file():
            missing = f"reading {self.path}: {_INTRINSICS} is not there; give a calibration (--camera)"
            self.camera_fault = CalibrationError(missing)
        else:
            pinhole = read_calibration(file, size).camera.central
            self.camera = replace(pinhole, cx=pinhole.cx - _COLMAP_CENTRE_PX, cy=pinhole.cy - _COLMAP_CENTRE_PX)
            self.camera_source = f"{_INTRINSICS}, pixel centres moved by half a pixel"

    def _assumptions(self, stacked: bool) -> list[str]:
        return ["truth: COLMAP's poses, scaled to the scan of the keyframe"]


class _ArchivedImages(ImageFolder):
    """Images in an archive, `frame<number>.png`; one that is missing or damaged is left out with a warning."""

    def __init__(self, archive: NumberedFiles, numbers: list[int]) -> None:
        self._archive = archive
        super().__init__(archive.path, [archive.path.parent / f"frame{number:06d}.png" for number in numbers])

    def _image(self, file: Path) -> np.ndarray | None:
        content = self._archive.read(frame_number(file) or 0)
        return None if content is None else decoded_image(content)


def _keyframe(path: Path) -> Path:
    return path.parent if path.name == "data" and (path.parent / _CALIBRATION).is_file() else path


def _find_frames(path: Path) -> NumberedFiles | None:
    return find_numbered(path, ("data/rgb_frames", "rgb_frames"), "frame", (".png", ".jpg"))


def _read_log(file: Path) -> list[int]:
    with reporting(f"cannot read included_frames in {file}"):
        numbers = sorted({int(number) for number in json.loads(file.read_bytes())["included_frames"]})
    if not numbers:
        raise InputError(f"reading {file}: included_frames names no frame")
    return numbers
