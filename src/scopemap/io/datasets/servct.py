"""SERV-CT: sixteen rectified stereo pictures of porcine organs with depth from a CT scan; no video, no camera poses.

`Experiment_1` (001 to 008) and `Experiment_2` (009 to 016) each hold `Left_rectified/NNN.png`, `Right_rectified`,
`Rectified_calibration/NNN.json` (P1, P2, Q) and `Ground_truth_CT/{DepthL,OcclusionL,...}/NNN.png`, in copies also
`Reference_CT`; depth is uint16, 256 = 1 mm, 0 = none. Edwards et al., "SERV-CT: A disparity dataset from CT for
validation of endoscopic 3D reconstruction", arXiv 2012.11779.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.rectification import Rectifier
from scopemap.errors import CalibrationError, InputError
from scopemap.io.images import ImageFolder, image_files, read_depth16, read_image
from scopemap.io.source import SourceFrame, SourceTruth

_LEFT = "Left_rectified"
_CALIBRATION = "Rectified_calibration"
_TRUTHS = ("Ground_truth_CT", "Reference_CT", "Ground_truth_RGB", "Reference_RGB")
_DEPTH_SCALE_MM = 1 / 256
_SAME_CAMERA_PX = 0.01
_BLUE = (0, 0, 255)


class ServCtFolder(ImageFolder):
    """The left pictures of one experiment; a `camera.yaml` beside `Left_rectified` wins over the calibration files.

    Each picture has a calibration of its own. Where these differ, pictures and depth are brought to the camera of the
    first. Raises `InputError` for pictures that cannot be used; a calibration that cannot is its `camera_fault`.
    """

    name = "serv-ct"

    def __init__(self, path: Path) -> None:
        left = path / _LEFT
        super().__init__(path, image_files(left) if left.is_dir() else [])
        self._stem_of = {number: file.stem for number, file in zip(self.numbers, self.files, strict=True)}
        self._truth = next((path / name for name in _TRUTHS if (path / name / "DepthL").is_dir()), None)
        self._rectifiers: dict[int, Rectifier] = {}
        if self.camera is None:
            with self._making_camera():
                self._calibrate()
        self.notes.append("stereo pictures, no video: the left ones are used, no pose is known, what they show differs")
        if self._truth is not None:
            scan = "the CT scan" if self._truth.name.endswith("_CT") else "a scanner with structured light"
            self.notes.append(f"depth beside the images: {scan}, registered to them ({self._truth.name})")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `Left_rectified` with images, and beside it calibration or truth of SERV-CT."""
        known = any((path / name).is_dir() for name in (_CALIBRATION, *_TRUTHS))
        return known and (path / _LEFT).is_dir() and bool(image_files(path / _LEFT))

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected left pictures, all as the camera of the first sees them."""
        for frame in super().frames(selection):
            rectifier = self._rectifiers.get(frame.index)
            yield frame if rectifier is None else replace(frame, rgb=rectifier.image(frame.rgb))

    def truth(self, index: int) -> SourceTruth | None:
        """Return the depth by the scan, without a pose; None where there is none."""
        if self._truth is None:
            return None
        name = f"{self._stem_of[index]}.png"
        values = read_depth16(self._truth / "DepthL" / name)
        if values is None:
            return None
        known = (values > 0) & ~_outside_scan(self._truth / "OcclusionL" / name, values.shape)
        depth_mm = np.where(known, values * np.float32(self.depth_scale_mm or _DEPTH_SCALE_MM), np.nan)
        rectifier = self._rectifiers.get(index)
        depth_mm = depth_mm.astype(np.float32) if rectifier is None else rectifier.nearest(depth_mm.astype(np.float32))
        return SourceTruth(None, depth_mm, "registered")

    def _calibrate(self) -> None:
        files = {number: self.path / _CALIBRATION / f"{stem}.json" for number, stem in self._stem_of.items()}
        cameras = {n: _read_camera(f, (self.width, self.height)) for n, f in files.items() if f.is_file()}
        if not cameras:
            return
        first = next(iter(cameras))
        self.camera, self.camera_source = cameras[first], f"P1 in {files[first].name}"
        self._rectifiers = {n: Rectifier(c, self.camera) for n, c in cameras.items() if not _same(c, self.camera)}
        if self._rectifiers:
            self.notes.append(f"{len(self._rectifiers)} pictures of other cameras are brought to that of the first")
        missing = [number for number in files if number not in cameras]
        if missing:
            self._warn(f"no calibration for picture(s) {', '.join(map(str, missing))}: taken as of {files[first].name}")


def _read_camera(file: Path, size: tuple[int, int]) -> PinholeCamera:
    """Return the left camera: P1 is [K | 0], as a map with `data` or as rows."""
    try:
        entry = json.loads(file.read_text(encoding="utf-8"))["P1"]
        P1 = np.array(entry["data"] if isinstance(entry, dict) else entry, dtype=np.float64).reshape(3, 4)
    except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise CalibrationError(
            f"cannot read the calibration in {file}: no matrix P1 of 3x4 numbers ({error})"
        ) from None
    (fx, skew, cx, _), (zero, fy, cy, _) = P1[:2].tolist()
    width, height = size
    upright = np.allclose([skew, zero, *P1[2]], [0, 0, 0, 0, 1, 0])
    plausible = 0.3 * width < fx < 5 * width and 0.2 < fy / fx < 5
    if not (upright and plausible and 0 <= cx < width and 0 <= cy < height):
        raise CalibrationError(
            f"the calibration {file} is not that of images of {width}x{height} px: found focal length {fx:g}, {fy:g} "
            f"and principal point {cx:g}, {cy:g} px"
        )
    return PinholeCamera(fx, fy, cx, cy, width, height)


def _same(a: PinholeCamera, b: PinholeCamera) -> bool:
    return bool(np.abs(a.matrix - b.matrix).max() < _SAME_CAMERA_PX)


def _outside_scan(file: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Return where the scan holds nothing, which the data set paints blue, (h, w) bool; nowhere without a file."""
    if not file.is_file():
        return np.zeros(shape, dtype=bool)
    image = read_image(file)
    if image is None or image.shape[:2] != shape:
        raise InputError(f"reading {file}: expected an image of {shape[1]}x{shape[0]} px, the size of the depth")
    return (image == _BLUE).all(axis=-1)
