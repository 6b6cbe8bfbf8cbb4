"""C3VD: phantom colonoscopy with registered truth, and what is written in its layout (github.com/DurrLab/C3VD).

One folder per video: `NNNN_color.png`, `NNNN_depth.tiff`, `pose.txt`; image number = line of `pose.txt`, from 0.
Bobrow et al., "Colonoscopy 3D video dataset with paired depth from 2D-3D registration", arXiv 2206.08903.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.calibration import fitted_to
from scopemap.datasets.images import ImageFolder, image_files
from scopemap.datasets.sequence import SourceTruth
from scopemap.errors import InputError
from scopemap.frame import TruthQuality
from scopemap.lenses import OmnidirectionalCamera
from scopemap.trajectory import read_poses

CAMERA = OmnidirectionalCamera(
    polynomial=(769.243600037458, 0.0, -0.000812770624150226, 6.25674244578925e-07, -1.19662182144280e-09),
    cx=678.544839263292,
    cy=542.975887548343,
    width=1350,
    height=1080,
    stretch=(0.999986882249990, 0.00288273829525059, -0.00296316513429569),
)
"""Olympus CF-HQ190L as published with the data set, for pixel centres that count from 0."""

DEPTH_RANGE_MM = 100.0
_DEPTH_SUFFIXES = (".tiff", ".tif", ".png")
_LARGEST = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}


class C3vdFolder(ImageFolder):
    """One C3VD video, or a folder in its layout; `camera.yaml` beside the frames wins over the published constants."""

    name = "c3vd"

    def __init__(self, path: Path) -> None:
        super().__init__(path, [file for file in image_files(path) if file.stem.endswith("_color")])
        self.poses = read_poses(path / "pose.txt")
        missing = [f for number, f in zip(self.numbers, self.files, strict=True) if number >= len(self.poses)]
        if missing:
            raise InputError(
                f"reading {path}: {missing[0].name} has no line in pose.txt, which holds {len(self.poses)} poses "
                "(line = image number, from 0)"
            )
        self._file_of = dict(zip(self.numbers, self.files, strict=True))
        # A calibration of its own marks a rendering; C3VD proper was registered to real video.
        self._quality: TruthQuality = "registered" if self.camera is None else "exact"
        if self.camera is None:
            self.camera = fitted_to(CAMERA, (self.width, self.height), "shipped for C3VD")
            self.camera_source = "published C3VD calibration (Scaramuzza polynomial)"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `pose.txt` and `*_color.*` images."""
        return (path / "pose.txt").is_file() and any(path.glob("*_color.*"))

    def truth(self, index: int) -> SourceTruth | None:
        """Return pose and, where its file lies beside the image, depth."""
        return SourceTruth(self.poses[index], self._depth_mm(index), self._quality)

    def _depth_mm(self, index: int) -> np.ndarray | None:
        stem = self._file_of[index].with_suffix("").as_posix().removesuffix("_color") + "_depth"
        file = next((Path(stem + s) for s in _DEPTH_SUFFIXES if Path(stem + s).is_file()), None)
        if file is None:
            return None
        values = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if values is None or values.ndim != 2 or values.dtype not in _LARGEST:
            raise InputError(f"reading {file}: expected a depth image of one 8- or 16-bit channel")
        largest = _LARGEST[values.dtype]
        scale_mm = self.depth_scale_mm or DEPTH_RANGE_MM / largest
        # 0 lies outside the lens circle, the largest value was clipped.
        known = (values > 0) & (values < largest)
        return np.where(known, values * np.float32(scale_mm), np.nan).astype(np.float32)
