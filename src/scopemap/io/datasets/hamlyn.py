"""Hamlyn: rectified stereo laparoscopy with depth by stereo matching, and the trackers' test sequences.

`rectifiedNN/image01/0000000000.jpg` (left), `depth01/0000000000.png` (uint16 mm, 0 = none); the intrinsics lie in a
tree of their own, `calibration/rectifiedNN/intrinsics.txt`. `hamlyn_tracking_test_data/testN/{color,depth}` and
`intrinsics.txt`: cropped images with predicted depth. No camera pose is known in either.
Recasens et al., "Endo-Depth-and-Motion", arXiv 2103.16525.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scopemap.cameras.formats.reading import read_calibration
from scopemap.frame import TruthQuality
from scopemap.io.images import ImageFolder, image_files, read_depth16

_INTRINSICS = "intrinsics.txt"
_FRAME_NAME = re.compile(r"\d{10}")


class HamlynFolder(ImageFolder):
    """The left images of a rectified sequence; a `camera.yaml` beside `image01` wins over the published intrinsics."""

    name = "hamlyn"
    _images, _depths = "image01", "depth01"
    quality: TruthQuality = "stereo"
    _origin = "stereo matching, no sensor"

    def __init__(self, path: Path) -> None:
        images = path / self._images
        super().__init__(path, image_files(images) if images.is_dir() else [])
        self._file_of = dict(zip(self.numbers, self.files, strict=True))
        self.notes += [f"depth beside the images: {self._origin}", "no pose is known: the data set has none"]
        file = self._intrinsics_file()
        if self.camera is None and file is not None:
            self.camera = read_calibration(file, (self.width, self.height)).camera
            self.camera_source = f"published intrinsics ({file})"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `image01` with images."""
        images = path / "image01"
        return images.is_dir() and bool(image_files(images))

    def _depth_mm(self, index: int) -> np.ndarray | None:
        values = read_depth16(self.path / self._depths / f"{self._file_of[index].stem}.png")
        if values is None:
            return None
        depth_mm = values * np.float32(self.depth_scale_mm or 1.0)
        return np.where(values > 0, depth_mm, np.nan).astype(np.float32)

    def _intrinsics_file(self) -> Path | None:
        sequence = self.path.absolute()
        parent, name = sequence.parent, sequence.name
        places = (
            sequence / _INTRINSICS,
            parent / "calibration" / name / _INTRINSICS,
            parent.parent / "calibration" / name / _INTRINSICS,
            parent / f"intrinsics_{name}.txt",
        )
        return next((file for file in places if file.is_file()), None)


class HamlynTrackingFolder(HamlynFolder):
    """A sequence of `hamlyn_tracking_test_data`: images a bit smaller than the rectified, depth by a network."""

    name = "hamlyn-tracking"
    _images, _depths = "color", "depth"
    quality: TruthQuality = "predicted"
    _origin = "predicted by Endo-Depth, cut at 300 mm"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `color` with 10-digit names, `depth` and `intrinsics.txt`."""
        if not ((path / "color").is_dir() and (path / "depth").is_dir() and (path / _INTRINSICS).is_file()):
            return False
        files = image_files(path / "color")
        return bool(files) and _FRAME_NAME.fullmatch(files[0].stem) is not None
