"""SERV-CT: sixteen rectified stereo pictures of porcine organs with depth from a CT scan; no video, no camera poses.

`Experiment_1` (001 to 008) and `Experiment_2` each hold `Left_rectified/NNN.png`, `Rectified_calibration/NNN.json` (P1,
P2, Q) and `Ground_truth_CT/{DepthL,OcclusionL,...}/NNN.png`, in copies also `Reference_CT`; depth is uint16, 256 = 1
mm, 0 = none. Edwards et al., arXiv 2012.11779.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.errors import CalibrationError, InputError, reporting
from scopemap.input.camera_files.calibration import check_plausible
from scopemap.input.images import read_image
from scopemap.input.source import SourceFrame
from scopemap_bench.datasets.layouts import LayoutFolder, Place

_CALIBRATION = "Rectified_calibration"
_TRUTHS = ("Ground_truth_CT", "Reference_CT", "Ground_truth_RGB", "Reference_RGB")
_SAME_CAMERA_PX = 0.01
_BLUE = (0, 0, 255)


class ServCtFolder(LayoutFolder):
    """The left pictures of one experiment, with their depth brought to the camera of the first where theirs differ."""

    name = "serv-ct"
    places = (Place("Left_rectified", depths=tuple(f"{truth}/DepthL/{{}}.png" for truth in _TRUTHS)),)
    needs = ((_CALIBRATION, *_TRUTHS),)
    depth_code = ((16, 1 / 256, 65535),)
    remarks = ("stereo pictures, no video: the left ones are used, no pose is known, the scenes differ",)

    def __init__(self, path: Path) -> None:
        self._rectifiers: dict[int, Rectifier] = {}
        super().__init__(path)
        for truth in sorted({file.parents[1].name for file in self.depth_files.values()}):
            scan = "the CT scan" if truth.endswith("_CT") else "a scanner with structured light"
            self.notes.append(f"depth beside the images: {scan}, registered to them ({truth})")

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected left pictures, all as the camera of the first sees them."""
        for frame in super().frames(selection):
            rectifier = self._rectifiers.get(frame.index)
            yield frame if rectifier is None else replace(frame, rgb=rectifier.image(frame.rgb))

    def _depth_mm(self, index: int) -> np.ndarray | None:
        depth_mm = super()._depth_mm(index)
        if depth_mm is None:
            return None
        file = self.depth_files[index].parents[1] / "OcclusionL" / self.depth_files[index].name
        if file.is_file():
            image = read_image(file)
            if image is None or image.shape[:2] != depth_mm.shape:
                raise InputError(f"reading {file}: expected an image of the size of the depth")
            # What the scan does not hold is painted blue.
            depth_mm[(image == _BLUE).all(axis=-1)] = np.nan
        rectifier = self._rectifiers.get(index)
        return depth_mm if rectifier is None else rectifier.nearest(depth_mm)

    def _use_intrinsics(self) -> None:
        files = {n: self.path / _CALIBRATION / f"{file.stem}.json" for n, file in self.file_of.items()}
        cameras = {n: _read_camera(f, (self.width, self.height)) for n, f in files.items() if f.is_file()}
        if not cameras:
            return
        first = next(iter(cameras))
        self.camera, self.camera_source = cameras[first], f"P1 in {files[first].name}"
        self._rectifiers = {
            n: Rectifier(c, self.camera)
            for n, c in cameras.items()
            if not np.allclose(c.matrix, self.camera.matrix, rtol=0, atol=_SAME_CAMERA_PX)
        }
        if self._rectifiers:
            self.notes.append(f"{len(self._rectifiers)} pictures of other cameras are brought to that of the first")
        missing = [number for number in files if number not in cameras]
        if missing:
            self._warn(f"no calibration for picture(s) {', '.join(map(str, missing))}: taken as of {files[first].name}")


def _read_camera(file: Path, size: tuple[int, int]) -> PinholeCamera:
    """Return the left camera: P1 is [K | 0], as a map with `data` or as rows."""
    with reporting(f"cannot read the calibration in {file}: no matrix P1 of 3x4 numbers", kind=CalibrationError):
        entry = json.loads(file.read_bytes())["P1"]
        P1 = np.array(entry["data"] if isinstance(entry, dict) else entry, dtype=np.float64).reshape(3, 4)
    (fx, skew, cx, _), (zero, fy, cy, _) = P1[:2].tolist()
    if not np.allclose([skew, zero, *P1[2]], [0, 0, 0, 0, 1, 0]):
        raise CalibrationError(f"the calibration {file} has a matrix P1 that is not [K | 0]")
    camera = PinholeCamera(fx, fy, cx, cy, *size)
    check_plausible(camera, f"the calibration {file}")
    return camera
