"""D4D: da Vinci stereo of porcine tissue that is deformed, with structured light before and after (arXiv 2603.02985).

A clip: `left_images_rect/*.png`, `stereo_depth/*.npy` (m), `curated_camera_pose_start.txt` and `_end.txt` (4x4, camera
to world, m), `camera_info/left_rect*.yaml`, else `camera_info/left.yaml` of its session, two folders above. There
`clips.json` names its point clouds, in the world and the unit of the poses: `{"clips": [{"name", "start_geometry",
"end_geometry"}]}`. Layout and units are those of github.com/reubendocea/d4d.

Not read, since what they hold is not described: `pose_bounds.npy` (LLFF, its unit), masks (which value is tissue).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.parsing import Fields, calibration_bytes, read_tree
from scopemap.errors import CalibrationError, InputError, reporting
from scopemap.trajectory.formats.poses import rigid
from scopemap.trajectory.formats.text import read_numbers
from scopemap_bench.datasets.layouts import LayoutFolder, Place

_MM_PER_M = 1000.0
_ENDS = ("start", "end")
_POSE = "curated_camera_pose_{}.txt"


class D4dClip(LayoutFolder):
    """The left view of one clip; poses are of its first and last frame."""

    name = "d4d"
    places = (Place("left_images_rect"),)
    needs = (("stereo_depth/*.npy", _POSE.format("start")),)
    quality = "registered"
    remarks = (
        "depth beside the images: stereo matching, m; poses: of the first and the last frame, where structured light "
        "is registered to them; masks are not used: which value is tissue is not described",
    )

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        ends = zip(_ENDS, (self.numbers[0], self.numbers[-1]), strict=True)
        self.poses = {n: _read_pose(file) for end, n in ends if (file := path / _POSE.format(end)).is_file()}
        depth = sorted(path.glob("stereo_depth/*.npy"))
        by_stem = {file.stem: file for file in depth}
        if len(depth) == self.count:
            self.depth_files = dict(zip(self.numbers, depth, strict=True))
        else:
            self.depth_files = {n: by_stem[file.stem] for n, file in self.file_of.items() if file.stem in by_stem}
            if depth:
                self._warn(f"{path / 'stereo_depth'}: {len(depth)} files for {self.count} images; those of one name")

    def geometry_mm(self, end: str) -> np.ndarray | None:
        """Return the structured light's points (N, 3), world mm, at the "start" or the "end"; None without any.

        Raises `InputError` where they cannot be read.
        """
        session = self.path.absolute().parents[1]
        listed = session / "clips.json"
        with reporting(f"cannot read the points that {listed} names for {self.path.name}"):
            clips = json.loads(listed.read_bytes())["clips"] if listed.is_file() else []
            named = [clip.get(f"{end}_geometry") for clip in clips if clip["name"] == self.path.absolute().name]
            if not any(named):
                return None
            cloud: Any = trimesh.load(session / named[0], process=False)
            points = np.asarray(cloud.vertices, np.float64)
        return points[np.isfinite(points).all(1)] * _MM_PER_M

    def _use_intrinsics(self) -> None:
        own = sorted(self.path.glob("camera_info/left_rect*.yaml")) + sorted(self.path.glob("camera_info/left.yaml"))
        file = next(iter([*own, self.path.absolute().parents[1] / "camera_info/left.yaml"]))
        if file.is_file():
            self._set_camera(
                _read_camera(file, (self.width, self.height)), f"projection matrix of {file.name}", str(file)
            )

    def _depth_mm(self, index: int) -> np.ndarray | None:
        file = self.depth_files.get(index)
        if file is None:
            return None
        with reporting(f"reading {file}: no NumPy array of depth"):
            # Mapped, a header that claims more than the file holds is refused before any memory is taken.
            depth_m = np.load(file, mmap_mode="r", allow_pickle=False)
            if depth_m.shape != (self.height, self.width) or depth_m.dtype.kind != "f":
                size = f"{self.height}x{self.width} floats"
                raise InputError(f"reading {file}: expected {size}, found {depth_m.dtype} of shape {depth_m.shape}")
        depth_mm = np.array(depth_m, np.float32) * np.float32(self.depth_scale_mm or _MM_PER_M)
        return np.where(np.isfinite(depth_mm) & (depth_mm > 0), depth_mm, np.float32(np.nan))


def _read_pose(file: Path) -> np.ndarray:
    table = read_numbers(file)
    if table.values.shape != (4, 4):
        raise InputError(f"reading {file}: expected 4 rows of 4 numbers")
    T_world_camera = rigid(table.values[None], [str(file)])[0]
    T_world_camera[:3, 3] *= _MM_PER_M
    return T_world_camera


def _read_camera(file: Path, size: tuple[int, int]) -> PinholeCamera:
    """Return the camera of rectified images, which ROS has in the projection matrix, at the file's size or `size`."""
    with reporting(
        f"cannot read the calibration in {file}: no projection matrix of 3x4 numbers", kind=CalibrationError
    ):
        fields = read_tree(calibration_bytes(file).decode())
        assert isinstance(fields, Fields)
        P = np.reshape(fields.numbers(("P", "projection_matrix"), 12) or [], (3, 4))
        stated = [fields.number((side, f"image_{side}")) for side in ("width", "height")]
        width, height = (int(one or other) for one, other in zip(stated, size, strict=True))
        return PinholeCamera(P[0, 0], P[1, 1], P[0, 2], P[1, 2], width, height)
