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
from typing import Any, Literal

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import CalibrationError, InputError, reporting
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.camera_files.parsing import Fields, calibration_bytes, read_tree
from scopemap.input.trajectory.poses import rigid
from scopemap.input.trajectory.text import read_numbers
from scopemap_bench.datasets.layouts import LayoutFolder, Place

_MM_PER_M = 1000.0
End = Literal["start", "end"]
_POSE = "curated_camera_pose_{}.txt"


class D4dClip(LayoutFolder):
    """The left view of one clip. Two poses fix no path: they serve to bring the structured light to their frames."""

    name = "d4d"
    places = (Place("left_images_rect"),)
    needs = (("stereo_depth/*.npy", _POSE.format("start")),)
    quality = "stereo"
    remarks = (
        "depth beside the images: stereo matching, m; no poses but those of the first and the last frame, to which "
        "structured light is registered; masks are not used: which value is tissue is not described",
    )

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        depth = sorted(path.glob("stereo_depth/*.npy"))
        by_stem = {file.stem: file for file in depth}
        if len(depth) == self.count:
            self.depth_files = dict(zip(self.numbers, depth, strict=True))
        else:
            self.depth_files = {n: by_stem[file.stem] for n, file in self.file_of.items() if file.stem in by_stem}
            if depth:
                self._warn(f"{path / 'stereo_depth'}: {len(depth)} files for {self.count} images; those of one name")

    def structured_light_mm(self, end: End) -> np.ndarray | None:
        """Return the depth (H, W) float32, mm, of the first frame ("start") or the last ("end") by structured light.

        NaN where no point falls; None without points, pose or camera. Raises `InputError` for what cannot be read.
        """
        session, own = self.path.absolute().parents[1], self.path.absolute().name
        listed, pose = session / "clips.json", self.path / _POSE.format(end)
        with reporting(f"cannot read the points that {listed} names for {own}"):
            clips = json.loads(listed.read_bytes())["clips"] if listed.is_file() else []
            named = next(
                (file for clip in clips if clip["name"] == own and (file := clip.get(f"{end}_geometry"))), None
            )
            if named is None or not pose.is_file() or self.camera is None:
                return None
            import trimesh  # its import takes longer than that of all readers, and each command loads them

            cloud: Any = trimesh.load(session / named, process=False)
            points_m = np.asarray(cloud.vertices, np.float64)
        points = transform(inverse(_read_pose(pose)), points_m[np.isfinite(points_m).all(1)])
        column, row = np.rint(np.nan_to_num(self.camera.project(points), nan=-1.0)).T.astype(int)
        seen = (points[:, 2] > 0) & (row >= 0) & (row < self.height) & (column >= 0) & (column < self.width)
        depth_m = np.full((self.height, self.width), np.inf)
        np.minimum.at(depth_m, (row[seen], column[seen]), points[seen, 2])
        return np.where(np.isfinite(depth_m), depth_m * _MM_PER_M, np.nan).astype(np.float32)

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
    return rigid(table.values[None], [str(file)])[0]


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
