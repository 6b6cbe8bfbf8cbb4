"""OneSLAM's layout: images of any monocular endoscope, with truth where it is known (github.com/arcadelab/OneSLAM).

`images/00000000.jpg`, `calibration.json` (`{"intrinsics": {"fx", "fy", "cx", "cy"}, "FPS"}`); optional `mask.bmp`
(255 = tissue), `poses_gt.txt` (TUM rows, camera-to-world, stamped by frame number), `depths/00000000.png` (uint16, 1000
= one unit of the poses, 0 = unknown). That unit is not part of the layout: mm unless a line `# unit: m` states it.
Teufel et al., "OneSLAM to map them all", IJCARS 2024.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import CalibrationError, InputError, reporting
from scopemap.input.camera_files.parsing import calibration_bytes
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.decoding import by_number, read_decoded
from scopemap.input.images import image_files
from scopemap.input.trajectory.columns import are_frame_numbers
from scopemap.input.trajectory.text import tum_poses
from scopemap_bench.datasets.layouts import LayoutFolder, Place
from scopemap_bench.datasets.tum import read_stamped

_CALIBRATION = "calibration.json"
_MASK = "mask.bmp"
_POSES = "poses_gt.txt"
_DEPTHS_PER_UNIT = 1000.0
_TISSUE = 255


class OneSlamFolder(LayoutFolder):
    """A folder in OneSLAM's layout; `InputError` for poses, mask and frame rate that cannot be read."""

    name = "oneslam"
    places = (Place("images"),)
    needs = ((_CALIBRATION,),)
    numbered = True

    def __init__(self, path: Path) -> None:
        self._stated: dict[str, Any] = {}
        super().__init__(path)
        rate = self._stated.get("FPS")
        if rate is not None:
            fault = f"reading {path / _CALIBRATION}: FPS must be a positive number, found {rate!r:.80}"
            with reporting(fault):
                self.rate_hz = float(rate)
                if not 0 < self.rate_hz < float("inf"):
                    raise ValueError("out of range")
        given = "assumed: calibration.json has no FPS" if rate is None else "FPS of calibration.json"
        self.notes[0] = f"time stamps: frame number / {self.rate_hz:g} s ({given})"
        self._tissue = self._read_mask()
        mm_per_unit = self._read_poses()
        self.depth_files = by_number(image_files(path / "depths"))
        step_mm = mm_per_unit / _DEPTHS_PER_UNIT
        self.depth_code = ((16, step_mm, 65535),)
        if self.depth_files and self.depth_scale_mm is None:
            self.notes.append(f"depth: {step_mm:g} mm per unit of the files, 1000 to a unit of the scene")
        if self.depth_files or self.poses:
            self.notes.append("the layout does not state how poses and depth came about: taken as registered")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether `path` is of the layout, and its calibration.json holds `intrinsics`."""
        with suppress(CalibrationError):
            return super().recognises(path) and "intrinsics" in _read_json(path / _CALIBRATION)
        return False

    def _use_intrinsics(self) -> None:
        self._stated = _read_json(self.path / _CALIBRATION)
        self.camera = read_calibration(self.path / _CALIBRATION, (self.width, self.height)).camera
        straight = ", taken as of images without distortion" * isinstance(self.camera, PinholeCamera)
        self.camera_source = f"{_CALIBRATION} beside the frames{straight}"

    def _depth_mm(self, index: int) -> np.ndarray | None:
        depth_mm = super()._depth_mm(index)
        if depth_mm is None or self._tissue is None:
            return depth_mm
        if depth_mm.shape != self._tissue.shape:
            sizes = f"{depth_mm.shape[1]}x{depth_mm.shape[0]} px, {_MASK} {self.width}x{self.height} px"
            raise InputError(f"reading {self.depth_files[index]}: depth is {sizes}; they must be of one size")
        return np.where(self._tissue, depth_mm, np.float32(np.nan))

    def _read_poses(self) -> float:
        """Read the poses by frame number, and return the mm per unit of the scene."""
        file = self.path / _POSES
        if not file.is_file():
            self.notes.append(f"no pose is known: there is no {_POSES}")
            return 1.0
        table = read_stamped(file)
        if not are_frame_numbers(table.values[:, 0]):
            raise InputError(f"reading {file}: its rows are stamped by frame number here, but not all stamps are whole")
        T, unit = tum_poses(table, "mm")
        self.poses = dict(zip(table.values[:, 0].astype(int).tolist(), T, strict=True))
        found = sum(number in self.poses for number in self.numbers)
        self.notes.append(f"poses: of {found} of {self.count} frames, camera-to-world, {unit}")
        if not found:
            self._warn(f"{file}: no row is stamped with the number of an image")
        return table.unit("mm")[0]

    def _read_mask(self) -> np.ndarray | None:
        file = self.path / _MASK
        if not file.is_file():
            return None
        level = read_decoded(file, cv2.IMREAD_GRAYSCALE)
        if level is None or level.shape != (self.height, self.width):
            found = "no readable image" if level is None else f"{level.shape[1]}x{level.shape[0]} px"
            raise InputError(f"reading {file}: expected a mask of {self.width}x{self.height} px, found {found}")
        self.notes.append(f"{_MASK} is applied to the true depth only; `mask.files` leaves pixels out of tracking")
        return level == _TISSUE


def _read_json(file: Path) -> dict[str, Any]:
    with reporting(f"cannot read the calibration in {file}", kind=CalibrationError):
        stated = json.loads(calibration_bytes(file))
        if not isinstance(stated, dict):
            raise ValueError('it is no object with "intrinsics"')
        return stated
