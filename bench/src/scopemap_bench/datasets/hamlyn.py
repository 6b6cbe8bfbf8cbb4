"""Hamlyn: rectified stereo laparoscopy with depth by stereo matching, and the trackers' test sequences.

`rectifiedNN/image01/0000000000.jpg` (left), `depth01/0000000000.png` (uint16 mm, 0 = none); the intrinsics are in a
tree of their own, `calibration/rectifiedNN/intrinsics.txt`. `hamlyn_tracking_test_data/testN/{color,depth}` and
`intrinsics.txt`: cropped images with predicted depth. Neither has camera poses.
Recasens et al., "Endo-Depth-and-Motion", arXiv 2103.16525.
"""

from __future__ import annotations

import re
from pathlib import Path

from scopemap.cameras.formats.reading import read_calibration
from scopemap.frame import TruthQuality
from scopemap.io.images import ImageFolder, image_files

_INTRINSICS = "intrinsics.txt"
_FRAME_NAME = re.compile(r"\d{10}")


class HamlynFolder(ImageFolder):
    """The left images of a rectified sequence; a `camera.yaml` beside `image01` replaces the published intrinsics."""

    name = "hamlyn"
    _images, _depths = "image01", "depth01"
    quality: TruthQuality = "stereo"
    _origin = "stereo matching, no sensor"

    def __init__(self, path: Path) -> None:
        super().__init__(path, image_files(path / self._images))
        depths = {number: path / self._depths / f"{file.stem}.png" for number, file in self.file_of.items()}
        self.depth_files = {number: file for number, file in depths.items() if file.is_file()}
        self.notes += [f"depth beside the images: {self._origin}", "no pose is known: the data set has none"]
        path, places = path.absolute(), [path / _INTRINSICS]
        for parent in path.parents[:3]:  # zips repeat a folder
            places += [parent / "calibration" / path.name / _INTRINSICS, parent / f"intrinsics_{path.name}.txt"]
        file = next((file for file in places if file.is_file()), None)
        if self.camera is None and file is not None:
            self.camera = read_calibration(file, (self.width, self.height)).camera
            self.camera_source = f"published intrinsics ({file})"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds `image01` with images."""
        return bool(image_files(path / "image01"))


class HamlynTrackingFolder(HamlynFolder):
    """A sequence of `hamlyn_tracking_test_data`: images a bit smaller than the rectified, depth by a network."""

    name = "hamlyn-tracking"
    _images, _depths = "color", "depth"
    quality = "predicted"
    _origin = "predicted by Endo-Depth, cut at 300 mm"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds `color` with 10-digit names, `depth` and `intrinsics.txt`."""
        files = image_files(path / "color")
        named = bool(files) and _FRAME_NAME.fullmatch(files[0].stem) is not None
        return named and (path / "depth").is_dir() and (path / _INTRINSICS).is_file()
