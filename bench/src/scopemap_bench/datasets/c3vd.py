"""C3VD: phantom colonoscopy with registered truth, and what is written in its layout (github.com/DurrLab/C3VD).

`NNNN_color.png`, `NNNN_depth.tiff`, `pose.txt`; image number = line of `pose.txt`, from 0. Also C3VDv2's `rgb/`,
`depth/`, and EndoGSLAM's undistorted copy of half the size, `color/`, `depth/` of 8 bit. Bobrow et al., arXiv
2206.08903; Golhar et al., arXiv 2506.24074 (v2); Wang et al., arXiv 2403.15124 (EndoGSLAM).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import OmnidirectionalCamera
from scopemap.engine.errors import InputError
from scopemap.input.camera_files.reading import stated_calibration
from scopemap.input.decoding import read_decoded
from scopemap.input.trajectory.text import read_c3vd
from scopemap_bench.datasets.layouts import LayoutFolder, Place

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
_FLAT = ("{}_depth.tiff", "{}_depth.tif", "{}_depth.png")
_SORTED = tuple(f"depth/{name}" for name in (*_FLAT, "{}.tiff", "{}.tif", "{}.png"))


class C3vdFolder(LayoutFolder):
    """One C3VD video, or a folder in its layout; `camera.yaml` beside the frames replaces the published constants."""

    name = "c3vd"
    needs = (("pose.txt",),)
    places = (
        *(Place("", "*_color", _FLAT), Place("color", "*_color", _SORTED, needs="depth")),
        *(Place("color", "*", _SORTED, needs="depth"), Place("rgb", "*", _SORTED)),
    )
    # 0 is outside the lens circle, the largest level was clipped.
    depth_code = ((8, DEPTH_RANGE_MM / 255, 254), (16, DEPTH_RANGE_MM / 65535, 65534))

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        truth = read_c3vd(path / "pose.txt", "mm")
        if not truth.has_indices and len(truth) != len(self.file_of):
            log = f"pose.txt is a log by time, of {len(truth)} poses for {len(self.file_of)} pictures"
            raise InputError(f"reading {path}: {log}; give it one pose a picture, without the time")
        self.poses = dict(zip(truth.indices.tolist(), truth.T_world_camera, strict=True))
        missing = next((file.name for number, file in self.file_of.items() if number not in self.poses), None)
        if missing is not None:
            held = f"which holds {len(self.poses)} poses (line = image number, from 0)"
            raise InputError(f"reading {path}: {missing} has no line in pose.txt, {held}")
        if self.camera is not None:
            # A calibration of its own marks a rendering; C3VD proper was registered to real video.
            self.quality = "exact"
        elif self.place.images == "color" and self._is_reduced():
            self._set_camera(
                UNDISTORTED_CAMERA, "EndoGSLAM's calibration of undistorted C3VD (pinhole)", "shipped for C3VD"
            )
            self.notes.append("depth of 8 bit, in steps of 0.39 mm: images undistorted and reduced by EndoGSLAM")
        elif (config := path / "config.ini").is_file():  # of C3VDv3's renderer
            camera = stated_calibration(config, (self.width, self.height)).camera
            self._set_camera(camera, "C3VD's config.ini beside the frames (Scaramuzza polynomial)", str(config))
        else:
            self._set_camera(CAMERA, "published C3VD calibration (Scaramuzza polynomial)", "shipped for C3VD")

    def _is_reduced(self) -> bool:
        """Return whether depth is of 8 bit, as in EndoGSLAM's copy; 16 bit are C3VD's, only sorted into folders."""
        first = next(iter(self.depth_files.values()), None)
        levels = None if first is None else read_decoded(first)
        return levels is None or levels.dtype == np.uint8
