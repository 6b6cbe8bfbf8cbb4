"""C3VD: phantom colonoscopy with registered truth, and what is written in its layout (github.com/DurrLab/C3VD).

One folder per video: `NNNN_color.png`, `NNNN_depth.tiff`, `pose.txt`; image number = line of `pose.txt`, from 0. Also
C3VDv2's `rgb/NNNN.png`, `depth/NNNN_depth.tiff`, and EndoGSLAM's copy of C3VD, `color/`, `depth/`: undistorted, half
the size, depth of 8 bit. Bobrow et al., "Colonoscopy 3D video dataset with paired depth from 2D-3D registration",
arXiv 2206.08903; Golhar et al., arXiv 2506.24074 (v2); Wang et al., arXiv 2403.15124 (EndoGSLAM).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.calibration import fitted_to, rescaled_note
from scopemap.cameras.lenses import OmnidirectionalCamera
from scopemap.errors import InputError
from scopemap.io.decoding import read_decoded
from scopemap.io.images import ImageFolder, image_files
from scopemap.trajectory.formats.text import read_poses

CAMERA = OmnidirectionalCamera(
    polynomial=(769.243600037458, 0.0, -0.000812770624150226, 6.25674244578925e-07, -1.19662182144280e-09),
    cx=678.544839263292,
    cy=542.975887548343,
    width=1350,
    height=1080,
    stretch=(0.999986882249990, 0.00288273829525059, -0.00296316513429569),
)
"""Olympus CF-HQ190L as published with the data set, for pixel centres that count from 0."""

UNDISTORTED_CAMERA = PinholeCamera(802.319, 801.885, 668.286, 547.733, 1350, 1080)
"""The pinhole that EndoGSLAM undistorted C3VD to, at full size (its configuration halves the principal point plainly,
a quarter of a pixel off what halving the images does)."""

DEPTH_RANGE_MM = 100.0
_DEPTH_SUFFIXES = (".tiff", ".tif", ".png")
_LARGEST = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}


class C3vdFolder(ImageFolder):
    """One C3VD video, or a folder in its layout; `camera.yaml` beside the frames wins over the published constants."""

    name = "c3vd"

    def __init__(self, path: Path) -> None:
        files, self._depth_folder, folder = _layout(path)
        super().__init__(path, files)
        self.poses = read_poses(path / "pose.txt")
        missing = [f for number, f in zip(self.numbers, self.files, strict=True) if number >= len(self.poses)]
        if missing:
            raise InputError(
                f"reading {path}: {missing[0].name} has no line in pose.txt, which holds {len(self.poses)} poses "
                "(line = image number, from 0)"
            )
        self._file_of = dict(zip(self.numbers, self.files, strict=True))
        # A calibration of its own marks a rendering; C3VD proper was registered to real video.
        self.quality = "registered" if self.camera is None else "exact"
        if self.camera is None:
            self._use_published(undistorted=folder == "color" and self._is_reduced())

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `pose.txt` and images in one of the layouts."""
        return (path / "pose.txt").is_file() and bool(_layout(path)[0])

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose of the image's line in pose.txt."""
        return self.poses[index]

    def _use_published(self, undistorted: bool) -> None:
        camera: CameraModel = UNDISTORTED_CAMERA if undistorted else CAMERA
        self.camera = fitted_to(camera, (self.width, self.height), "shipped for C3VD")
        self.camera_source = "published C3VD calibration (Scaramuzza polynomial)"
        if undistorted:
            self.camera_source = "EndoGSLAM's calibration of undistorted C3VD (pinhole)"
            self.notes.append("depth of 8 bit, in steps of 0.39 mm: images undistorted and reduced by EndoGSLAM")
        self.camera_source += rescaled_note(camera, self.camera)

    def _is_reduced(self) -> bool:
        """Whether the first depth is of 8 bit, as in EndoGSLAM's copy; 16 bit are C3VD's, only sorted into folders."""
        found = (file for number in self.numbers if (file := self._depth_file(number)) is not None)
        first = next(found, None)
        return first is None or _read_depth(first).dtype == np.uint8

    def _depth_file(self, index: int) -> Path | None:
        stem = self._file_of[index].stem.removesuffix("_color")
        names = [f"{stem}_depth{suffix}" for suffix in _DEPTH_SUFFIXES]
        if self._depth_folder != self.path:
            names += [f"{stem}{suffix}" for suffix in _DEPTH_SUFFIXES]
        return next((self._depth_folder / name for name in names if (self._depth_folder / name).is_file()), None)

    def _depth_mm(self, index: int) -> np.ndarray | None:
        file = self._depth_file(index)
        if file is None:
            return None
        values = _read_depth(file)
        largest = _LARGEST[values.dtype]
        scale_mm = self.depth_scale_mm or DEPTH_RANGE_MM / largest
        # 0 lies outside the lens circle, the largest value was clipped.
        known = (values > 0) & (values < largest)
        return np.where(known, values * np.float32(scale_mm), np.nan).astype(np.float32)


def _layout(path: Path) -> tuple[list[Path], Path, str]:
    """Return the colour images, the folder of the depth files, and the folder that holds the images, "" for flat."""
    flat = [file for file in image_files(path) if file.stem.endswith("_color")] if path.is_dir() else []
    if flat:
        return flat, path, ""
    for name, needs_depth in (("color", True), ("rgb", False)):
        if (path / name).is_dir() and ((path / "depth").is_dir() or not needs_depth):
            return image_files(path / name), path / "depth", name
    return [], path, ""


def _read_depth(file: Path) -> np.ndarray:
    values = read_decoded(file)
    if values is None or values.ndim != 2 or values.dtype not in _LARGEST:
        raise InputError(f"reading {file}: expected a depth image of one 8- or 16-bit channel")
    return values
