"""EndoMapper's simulated colon, rendered with Unity: pictures, depth and poses (doi 10.1038/s41597-023-02564-7).

`rgb/image_NNNN.png`, `depth/aov_image_NNNN.exr` (the depth buffer, in channel R), and `trajectory.csv` with a row
`tX;tY;tZ;rX;rY;rZ;rW;time(s)` per picture, from 0: camera-to-world, decimetres. `calibration.txt` holds the pinhole.

The depth buffer v runs from 1 at 1 mm to 0 at 400 mm: the depth is 1 dm / (0.25 + 99.75 v).
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import InputError, reporting
from scopemap.input.decoding import check_pixels
from scopemap_bench.datasets.layouts import Place, UnityFolder

CAMERA = PinholeCamera(472.64955, 472.64955, 479.5, 359.5, 960, 720)
"""As published with the simulated sequences."""

_TRAJECTORY = "trajectory.csv"
_MM_PER_DM = 100.0
_NEAR_DM = 0.01
_FAR_DM = 4.0
_ASPECT_TOLERANCE = 0.01


class EndoMapperSimFolder(UnityFolder):
    """One simulated sequence; the `depth_scale` of a `camera.yaml` beside it is the mm of a unit (dm)."""

    name = "endomapper-sim"
    places = (Place("rgb", "image_*", ("depth/aov_image_{}.exr",)),)
    needs = (("depth/aov_image_*.exr",), (_TRAJECTORY,))
    intrinsics = (("calibration.txt", 0),)
    remarks = (
        f"poses: {_TRAJECTORY}, row = image number, decimetres, taken as Unity's left-handed axes and converted; "
        "the data set does not state which they are, and others use them unconverted",
        "depth: 1 dm / (0.25 + 99.75 v) of channel R, which other readers take in other ways",
    )

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._read_table(path / _TRAJECTORY, _MM_PER_DM)
        without = sum(number not in self.poses for number in self.numbers)
        if without:
            self._warn(f"{path / _TRAJECTORY}: {without} of {self.count} images have no pose in it")
        if self.depth_files and find_spec("OpenEXR") is None:
            self.depth_files = {}
            self._warn(f"{path}: depth (OpenEXR) is left out; install its reader: pip install -e bench")
        if self.camera is None:
            self._set_camera(CAMERA, "published calibration of the simulated sequences", "shipped for it")

    def _depth_mm(self, index: int) -> np.ndarray | None:
        file = self.depth_files.get(index)
        if file is None:
            return None
        v = read_exr_red(file)
        rows, columns = v.shape
        if abs(columns * self.height / (rows * self.width) - 1) > _ASPECT_TOLERANCE:
            size = f"{self.width}x{self.height} px"
            raise InputError(f"reading {file}: depth of {columns}x{rows} px for images of {size}")
        # A depth buffer holds 0 to 1; NaN compares false.
        v = np.where((v >= 0) & (v <= 1), v, np.float32(np.nan))
        depth_dm = 1 / (1 / _FAR_DM + (1 / _NEAR_DM - 1 / _FAR_DM) * v)
        return (depth_dm * (self.depth_scale_mm or _MM_PER_DM)).astype(np.float32)


def read_exr_red(file: Path) -> np.ndarray:
    """Return the channel R, or Y, as (h, w) float32; `InputError` for a damaged file, or one of too many pixels."""
    import OpenEXR

    with reporting(f"reading {file}: no OpenEXR image with a channel R or Y, or damaged"):
        # Header first: the file's claim is checked before its pixels are decoded.
        corners = OpenEXR.File(str(file), header_only=True).header()["dataWindow"]
        width, height = (np.subtract(*reversed(corners), dtype=np.int64) + 1).tolist()
        check_pixels(width * height, f"reading {file}")
        channels = OpenEXR.File(str(file), separate_channels=True).channels()
        return np.array(channels["R" if "R" in channels else "Y"].pixels, dtype=np.float32)
