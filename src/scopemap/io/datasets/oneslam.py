"""OneSLAM's layout: images of any monocular endoscope, with truth where it is known (github.com/arcadelab/OneSLAM).

`images/00000000.jpg`, `calibration.json` (`{"intrinsics": {"fx", "fy", "cx", "cy"}, "FPS"}`); optional `mask.bmp`
(255 = tissue), `poses_gt.txt` (TUM rows, camera-to-world, stamped by frame number), `depths/00000000.png` (uint16, 1000
= one unit of the poses, 0 = unknown). That unit is not part of the layout: mm unless a line `# unit: m` says so.
Teufel et al., "OneSLAM to map them all", IJCARS 2024.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.parsing import calibration_bytes
from scopemap.cameras.formats.reading import read_calibration
from scopemap.errors import CalibrationError, InputError
from scopemap.io.datasets.tum import read_stamped_poses, unlikely_depth
from scopemap.io.decoding import read_decoded
from scopemap.io.images import FOLDER_RATE_HZ, ImageFolder, frame_number, image_files, read_depth16
from scopemap.trajectory.formats.poses import are_frame_numbers

_CALIBRATION, _MASK, _POSES = "calibration.json", "mask.bmp", "poses_gt.txt"
_DEPTHS_PER_UNIT = 1000.0
_TISSUE = 255


class OneSlamFolder(ImageFolder):
    """A folder in OneSLAM's layout; `camera.yaml` beside `images` wins over calibration.json.

    Raises `InputError` for images without a number of their own and for poses, mask and frame rate that cannot be read;
    a calibration that cannot be or does not fit is its `camera_fault`.
    """

    name = "oneslam"

    def __init__(self, path: Path) -> None:
        self._file_of = _numbered(image_files(path / "images") if (path / "images").is_dir() else [])
        super().__init__(path, list(self._file_of.values()))
        stated: dict[str, Any] = {}
        with self._making_camera():
            stated = _read_calibration(path / _CALIBRATION)
            if self.camera is None:
                self.camera = read_calibration(path / _CALIBRATION, (self.width, self.height)).camera
                straight = isinstance(self.camera, PinholeCamera)
                taken = ", taken as of images without distortion" if straight else ""
                self.camera_source = f"{_CALIBRATION} beside the frames{taken}"
        self._rate_hz = _rate_of(stated, path / _CALIBRATION)
        given = "FPS of calibration.json" if stated.get("FPS") is not None else "assumed: calibration.json has no FPS"
        self.notes = [f"time stamps: frame number / {self._rate_hz:g} s ({given})"]
        self._tissue = self._read_mask()
        self._poses, self._mm_per_unit = self._read_poses()
        depths = path / "depths"
        self._depth_of = _numbered(image_files(depths) if depths.is_dir() else [])
        self._depth_is_checked = False
        if self._depth_of and self.depth_scale_mm is None:
            step_mm = self._mm_per_unit / _DEPTHS_PER_UNIT
            self.notes.append(f"depth: {step_mm:g} mm per unit of the files, 1000 to a unit of the scene")
        if self._depth_of or self._poses:
            self.notes.append("how poses and depth came about the layout does not say: taken as registered")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `images` with images, and calibration.json with `intrinsics`."""
        images, file = path / "images", path / _CALIBRATION
        if not (file.is_file() and images.is_dir() and image_files(images)):
            return False
        try:
            return "intrinsics" in _read_calibration(file)
        except CalibrationError:
            return False

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose that is stamped with the frame's number, or None."""
        return self._poses.get(index)

    def _time_s(self, number: int) -> float:
        return number / self._rate_hz

    def _depth_mm(self, index: int) -> np.ndarray | None:
        file = self._depth_of.get(index)
        values = None if file is None else read_depth16(file)
        if values is None:
            return None
        known = values > 0
        if self._tissue is not None:
            if known.shape != self._tissue.shape:
                raise InputError(
                    f"reading {file}: depth of {known.shape[1]}x{known.shape[0]} px beside a {_MASK} of "
                    f"{self._tissue.shape[1]}x{self._tissue.shape[0]} px; they must be of one size"
                )
            known &= self._tissue
        scale_mm = self.depth_scale_mm or self._mm_per_unit / _DEPTHS_PER_UNIT
        depth_mm = np.where(known, values * np.float32(scale_mm), np.nan).astype(np.float32)
        if not self._depth_is_checked:
            self._depth_is_checked = True
            fault = unlikely_depth(depth_mm)
            if fault is not None:
                self._warn(f"{file}: {fault}; a line `# unit: m` in {_POSES} states a scene in metres")
        return depth_mm

    def _read_poses(self) -> tuple[dict[int, np.ndarray], float]:
        """Return the poses by frame number, and how many mm a unit of the scene has."""
        file = self.path / _POSES
        if not file.is_file():
            self.notes.append(f"no pose is known: there is no {_POSES}")
            return {}, 1.0
        poses = read_stamped_poses(file, "mm")
        if not are_frame_numbers(poses.stamps):
            raise InputError(f"reading {file}: its rows are stamped by frame number here, but not all stamps are whole")
        by_number = dict(zip(poses.stamps.astype(int).tolist(), poses.T_world_camera, strict=True))
        found = sum(number in by_number for number in self.numbers)
        self.notes.append(f"poses: of {found} of {self.count} frames, camera-to-world, {poses.unit}")
        if not found:
            self._warn(f"{file}: no row is stamped with the number of an image")
        return by_number, poses.mm_per_unit

    def _read_mask(self) -> np.ndarray | None:
        """Return where mask.bmp shows tissue, (h, w) bool, None where there is no such file."""
        file = self.path / _MASK
        if not file.is_file():
            return None
        level = read_decoded(file, cv2.IMREAD_GRAYSCALE)
        if level is None or level.shape != (self.height, self.width):
            found = "no readable image" if level is None else f"{level.shape[1]}x{level.shape[0]} px"
            raise InputError(f"reading {file}: expected a mask of {self.width}x{self.height} px, found {found}")
        self.notes.append(f"{_MASK} is applied to the true depth only; `mask.files` leaves pixels out of tracking")
        return level == _TISSUE


def _numbered(files: list[Path]) -> dict[int, Path]:
    """Return files by the last number in their names, ascending; `InputError` without one, or with one twice."""
    found: dict[int, Path] = {}
    for file in files:
        number = frame_number(file)
        if number is None:
            raise InputError(f"reading {file}: its name holds no number, which would be the frame's")
        if number in found:
            raise InputError(f"reading {file.parent}: {found[number].name} and {file.name} have one frame's number")
        found[number] = file
    return dict(sorted(found.items()))


def _read_calibration(file: Path) -> dict[str, Any]:
    try:
        stated = json.loads(calibration_bytes(file))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"cannot read the calibration in {file}: {error}") from None
    if not isinstance(stated, dict):
        raise CalibrationError(f'the calibration {file} is no object with "intrinsics"')
    return stated


def _rate_of(stated: dict[str, Any], file: Path) -> float:
    if stated.get("FPS") is None:
        return FOLDER_RATE_HZ
    try:
        rate_hz = float(stated["FPS"])
    except (TypeError, ValueError, OverflowError):
        rate_hz = math.nan
    if not 0 < rate_hz < math.inf:
        raise InputError(f"reading {file}: FPS must be a positive number, found {stated['FPS']!r:.80}")
    return rate_hz
