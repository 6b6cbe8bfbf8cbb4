"""SCARED and SCARED-C: da Vinci stereo video of porcine abdomens, surface from structured light.

SCARED, a keyframe's folder as it is downloaded: `endoscope_calibration.yaml`, `data/rgb.mp4` (left view above the
right), `data/frame_data.tar.gz` (poses from robot kinematics), `data/scene_points.tar.gz`. Copies that others have
unpacked are read, too. Frame number = order in the video, from 0 = number of the JSON and of the scene points. A scene
point file holds X, Y, Z per pixel in the camera's frame, mm, the left view above the right one. Allan et al., "Stereo
correspondence and reconstruction of endoscopic data challenge", arXiv 2101.01133.

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

from scopemap.cameras.camera import CameraModel
from scopemap.cameras.formats.parsing import Fields
from scopemap.cameras.formats.reading import of_fields, read_calibration, stated_calibration
from scopemap.errors import CalibrationError, InputError
from scopemap.frame import TruthQuality
from scopemap.io.datasets.numbered import NumberedFiles, find_numbered
from scopemap.io.decoding import decoded
from scopemap.io.images import OWN_CALIBRATION, ImageFolder, decoded_image, frame_number, image_files
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth
from scopemap.io.video import VideoFile
from scopemap.trajectory.formats.scared import parse_frame_data, times_of

_CALIBRATIONS = ("endoscope_calibration.yaml", "camera_calibration.yaml")
_VIDEOS = ("data/rgb.mp4", "rgb.mp4")
_IMAGES = ("image_02/data", "left", "data/left", "left_finalpass")
_RECTIFIED = "data/left_finalpass"
_STILL = "Left_Image.png"
# The last place are files that are loose in `data`; an archive of that name is not meant.
_FRAME_DATA = ("data/frame_data", "frame_data", "image_02/data/frame_data", "data/.")
_SCENE_POINTS = ("data/scene_points", "scene_points", "image_02/data/groundtruth")
_INTRINSICS, _LOG = "intrinsics_colmap.yaml", "frame_log.json"
_NAMED = re.compile(r"dataset_?\d+.*keyframe_?\d+")
_BADLY_CALIBRATED = (4, 5)
_STACKED_ASPECT = 1.4
_MOST_OFF_CENTRE = 0.25
# COLMAP puts the centre of the top-left pixel at (0.5, 0.5).
_COLMAP_CENTRE_PX = 0.5


class ScaredKeyframe(SourceDefaults):
    """The left view of one keyframe's video, with its true poses and depth where they are beside it.

    Raises `InputError` for a keyframe that is a single picture, and `CalibrationError` for one that does not fit.
    """

    name = "scared"
    quality: TruthQuality = "kinematic"
    _counts_from_one = False

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
        """Return whether `path` is a keyframe's folder, by its calibration file or its name, with pictures in it."""
        path = _keyframe(path)
        known = any((path / name).is_file() for name in _CALIBRATIONS)
        named = _NAMED.search("/".join(path.absolute().parts[-2:])) is not None
        return (known or named) and any((path / name).exists() for name in (*_VIDEOS, *_IMAGES, _RECTIFIED, _STILL))

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
        for place in _VIDEOS:
            if (self.path / place).is_file():
                return VideoFile(self.path / place)
        for place in _IMAGES:
            if image_files(self.path / place):
                folder = ImageFolder(self.path / place)
                if folder.numbers[0] != 0:
                    folder.numbers = [number - 1 for number in folder.numbers]
                    self._counts_from_one = True
                return folder
        if (self.path / _RECTIFIED).is_dir():
            raise InputError(
                f"reading {self.path}: {_RECTIFIED} holds rectified images, to which neither the calibration nor the "
                "poses belong; give the folder with rgb.mp4"
            )
        if (self.path / _STILL).is_file():
            raise InputError(
                f"reading {self.path}: this SCARED keyframe is a single stereo picture without a video (rgb.mp4), a "
                "sequence needs two frames; give another keyframe"
            )
        raise InputError(f"reading {self.path}: no SCARED keyframe, looked for {', '.join((*_VIDEOS, *_IMAGES))}")

    def _read_frame_data(self) -> None:
        """Read all poses, time stamps and the calibration; a file that cannot be used is a warning."""
        files = find_numbered(self.path, _FRAME_DATA, "frame_data", (".json",))
        frames = [parse_frame_data(name, number, content) for name, number, content in files or []]
        frames.sort(key=lambda frame: frame.index)
        self._posed = [frame.index for frame in frames]
        self._poses = {frame.index: frame.T_world_camera for frame in frames if frame.T_world_camera is not None}
        self._times_s, _ = times_of(frames)
        self._stated = next((frame.calibration for frame in frames if frame.calibration is not None), None)
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
        file = next((self.path / name for name in _CALIBRATIONS if (self.path / name).is_file()), None)
        if own.is_file():
            self._use_calibration(stated_calibration(own, size))
            return
        if file is not None:
            calibration = read_calibration(file, size)
            self.camera, self.depth_scale_mm = calibration.camera, calibration.depth_scale_mm
            self.camera_source = f"{calibration.source} beside the frames"
        elif self._stated is not None:
            try:
                self.camera = of_fields(Fields(self._stated.items()), size).camera
            except ValueError as error:
                raise CalibrationError(
                    f"the calibration in frame_data of {self.path} cannot be used: {error}"
                ) from None
            self.camera_source = "camera-calibration in frame_data"
        if self.camera is not None:
            _check_centred(self.camera, self.path)

    def _assumptions(self, stacked: bool) -> list[str]:
        numbers = [int(n) for part in self.path.absolute().parts[-3:] for n in re.findall(r"dataset_?(\d+)", part)]
        if numbers and numbers[-1] in _BADLY_CALIBRATED:
            self.warnings.append(
                f"SCARED dataset {numbers[-1]}: its calibration is known to be inaccurate, and so is what is measured"
            )
        notes = ["the view used: " + ("left, the upper half" if stacked else "the whole image")]
        if self._counts_from_one:
            notes.append("image number n is taken as frame n - 1: images that a video was unpacked to count from 1")
        if not self._poses:
            return [*notes, "no pose is known: frame_data is not there"]
        return [*notes, "truth: scan of the keyframe moved by robot kinematics; its error grows away from the keyframe"]

    def _time_s(self, index: int) -> float:
        return self._times_s.get(index, index / self._rate_hz)

    def _depth_mm(self, index: int) -> np.ndarray | None:
        """Return the left view's depth (h, w) float32, NaN = unknown; None where the frame has no scene points."""
        content = None if self._points is None else self._points.read(index)
        if content is None or self._points is None:
            return None
        where = f"{self._points.path}, frame {index}"
        points = decoded(content)
        if points is None or points.dtype != np.float32 or points.ndim != 3 or points.shape[2] != 3:
            found = "no readable image" if points is None else f"{points.dtype} of shape {points.shape}"
            raise InputError(f"reading {where}: expected scene points, an image of three 32-bit floats, found {found}")
        rows, columns = points.shape[:2]
        if rows * self.width not in (self.height * columns, 2 * self.height * columns):
            raise InputError(
                f"reading {where}: scene points of {columns}x{rows} px fit neither the left images of "
                f"{self.width}x{self.height} px nor both views above each other"
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
    """Return the keyframe's folder, also where its `data` was named."""
    calibrated = any((path.parent / name).is_file() for name in _CALIBRATIONS)
    return path.parent if path.name == "data" and calibrated else path


def _check_centred(camera: CameraModel, path: Path) -> None:
    central = camera.central
    off = max(abs((central.cx + 0.5) / camera.width - 0.5), abs((central.cy + 0.5) / camera.height - 0.5))
    if off > _MOST_OFF_CENTRE:
        raise CalibrationError(
            f"the calibration of {path} does not fit images of {camera.width}x{camera.height} px: its principal point "
            f"{central.cx:g}, {central.cy:g} is far off their centre; for reduced images put their own "
            f"{OWN_CALIBRATION} there"
        )


def _find_frames(path: Path) -> NumberedFiles | None:
    return find_numbered(path, ("data/rgb_frames", "rgb_frames"), "frame", (".png", ".jpg"))


def _read_log(file: Path) -> list[int]:
    try:
        included = json.loads(file.read_text(encoding="utf-8"))["included_frames"]
        numbers = sorted({int(number) for number in included})
    except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise InputError(f"cannot read included_frames in {file}: {error!r}") from None
    if not numbers:
        raise InputError(f"reading {file}: included_frames names no frame")
    return numbers
