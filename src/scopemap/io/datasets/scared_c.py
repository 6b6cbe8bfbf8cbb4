"""SCARED-C: SCARED's left images with poses by structure from motion (github.com/juseonghan/SCARED-C).

A keyframe's folder as it is downloaded: `intrinsics_colmap.yaml`, `frame_log.json`, and in `data` the archives
`rgb_frames.tar.gz`, `frame_data.tar.gz` and `scene_points.tar.gz`. Frames count from 1 and have gaps, where COLMAP
registered none; picture, JSON and scene points of a frame carry the same number.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap.cameras.formats.reading import read_calibration, stated_calibration
from scopemap.errors import CalibrationError, InputError
from scopemap.io.datasets.numbered import NumberedFiles, find_numbered
from scopemap.io.datasets.scared import OWN_CALIBRATION
from scopemap.io.datasets.scared_files import KeyframeTruth, read_frame_data
from scopemap.io.images import FOLDER_RATE_HZ, decoded_image
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth

_INTRINSICS = "intrinsics_colmap.yaml"
_LOG = "frame_log.json"
# COLMAP puts the centre of the top-left pixel at (0.5, 0.5).
_COLMAP_CENTRE_PX = 0.5


class ScaredCKeyframe(SourceDefaults):
    """The frames of one keyframe that COLMAP registered, read out of their archive one at a time.

    Raises `InputError` where there are no frames, and `CalibrationError` for intrinsics that do not fit.
    """

    name = "scared-c"

    def __init__(self, path: Path) -> None:
        self.path = path
        files = _find_frames(path)
        if files is None:
            raise InputError(f"reading {path}: no SCARED-C keyframe, data/rgb_frames.tar.gz is not there")
        self._files: NumberedFiles = files
        self._data = read_frame_data(path)
        self.warnings = list(self._data.faults)
        self._numbers = self._included()
        self.count: int | None = len(self._numbers)
        self.stamped = bool(self._data.times_s)
        times = "those of frame_data" if self._data.times_s else f"frame number / {FOLDER_RATE_HZ:g} s"
        self.notes = [f"time stamps: {times}", "truth: COLMAP's poses, scaled to the scan of the keyframe"]
        self.height, self.width = self._size()
        self._calibrate()
        scale_mm = self.depth_scale_mm or 1.0
        self._truth = KeyframeTruth(path, self._data, (self.width, self.height), "sfm", scale_mm)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds COLMAP's intrinsics and the frames."""
        return (path / _INTRINSICS).is_file() and _find_frames(path) is not None

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; one that is missing or damaged is left out with a warning."""
        for number in self._numbers[selection]:
            rgb = self._image(number)
            if rgb is None:
                self._warn(f"{self._files.path}: frame {number} is missing or cannot be read, and was left out")
            elif rgb.shape[:2] != (self.height, self.width):
                raise InputError(
                    f"reading {self._files.path}: frame {number} is {rgb.shape[1]}x{rgb.shape[0]} px, those before it "
                    f"are {self.width}x{self.height} px"
                )
            else:
                yield SourceFrame(number, self._time_s(number), rgb, f"frame{number:06d}.png")

    def stamps(self, selection: slice) -> list[tuple[int, float]]:
        """Return number and time of the selected frames."""
        return [(number, self._time_s(number)) for number in self._numbers[selection]]

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose by structure from motion."""
        return self._truth.pose(index)

    def truth(self, index: int) -> SourceTruth | None:
        """Return pose and depth: the keyframe's scan seen from that pose."""
        return self._truth.of_frame(index)

    def _included(self) -> list[int]:
        """Return the frames that the log names and frame_data has, else those of whichever there is."""
        log = self.path / _LOG
        included = _read_log(log) if log.is_file() else (self._data.numbers or self._files.numbers())
        common = sorted(set(included) & set(self._data.numbers)) if self._data.numbers else included
        if not common:
            raise InputError(f"reading {self.path}: {_LOG} and frame_data name no frame in common")
        if len(common) < max(len(included), len(self._data.numbers)):
            self._warn(
                f"{self.path}: {_LOG} names {len(included)} frames, but there are {len(self._data.numbers)} frame_data "
                f"files; the {len(common)} frames in both are used"
            )
        return common

    def _image(self, number: int) -> np.ndarray | None:
        content = self._files.read(number)
        return None if content is None else decoded_image(content)

    def _size(self) -> tuple[int, int]:
        for number in self._numbers:
            image = self._image(number)
            if image is not None:
                return image.shape[0], image.shape[1]
        raise InputError(f"reading {self._files.path}: none of its {len(self._numbers)} frames can be read")

    def _time_s(self, number: int) -> float:
        return self._data.times_s.get(number, number / FOLDER_RATE_HZ)

    def _calibrate(self) -> None:
        size = (self.width, self.height)
        own = self.path / OWN_CALIBRATION
        if own.is_file():
            self._use_calibration(stated_calibration(own, size))
            return
        if not (self.path / _INTRINSICS).is_file():
            missing = f"reading {self.path}: {_INTRINSICS} is not there; give a calibration (--camera)"
            self.camera_fault = CalibrationError(missing)
            return
        pinhole = read_calibration(self.path / _INTRINSICS, size).camera.central
        self.camera = replace(pinhole, cx=pinhole.cx - _COLMAP_CENTRE_PX, cy=pinhole.cy - _COLMAP_CENTRE_PX)
        self.camera_source = f"{_INTRINSICS}, pixel centres moved by half a pixel"

    def _warn(self, message: str) -> None:
        if message not in self.warnings:
            self.warnings.append(message)


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
