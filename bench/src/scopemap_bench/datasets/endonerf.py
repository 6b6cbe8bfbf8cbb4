"""EndoNeRF: short clips of robotic surgery with the camera at rest, tissue that is pulled or cut, and stereo depth.

`images/frame-000000.color.png`, `depth/frame-000000.depth.png` (8 or 16 bit, mm, 0 = none), `gt_masks` (instruments),
`masks` (instruments, and holes of the depth), `poses_bounds.npy` (LLFF; `pose_bounds.npy` in the README). Depth is by
stereo matching without instruments. Wang et al., arXiv 2206.15255.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import CalibrationError, InputError, reporting
from scopemap.engine.notices import Notice
from scopemap.input.trajectory.poses import rigid
from scopemap_bench.datasets.layouts import LayoutFolder, Place, numbered_images

_POSES = ("poses_bounds.npy", "pose_bounds.npy")
_MASKS = "gt_masks"
_MASKS_WITH_HOLES = "masks"
_COLUMNS = 17  # a 3x5 matrix [R | t | height, width, focal length] by rows, then near and far
_IDENTITY_TOLERANCE = 1e-2
_REST_TOLERANCE = 1e-6


class EndoNerfFolder(LayoutFolder):
    """One EndoNeRF scene; rows of `poses_bounds.npy` belong to the images in their order."""

    name = "endonerf"
    places = (Place("images", depths=("depth/",)),)
    needs = (_POSES, ("depth", _MASKS))
    quality = "stereo"
    depth_code = ((8, 1.0, 255), (16, 1.0, 65535))
    remarks = ("depth beside the images: stereo matching, no sensor; files are taken as mm",)

    def __init__(self, path: Path) -> None:
        file = next((path / name for name in _POSES if (path / name).is_file()), None)
        if file is None:
            raise InputError(f"reading {path}: no EndoNeRF scene, looked for {' and '.join(_POSES)}")
        super().__init__(path)
        rows = _read_rows(file)
        if self.camera is None:
            with self._making_camera():
                known = f"focal length in {file.name}, principal point at the centre"
                self._set_camera(_camera(rows, file), known, str(file))
        self.poses = self._read_poses(rows, file)
        if numbered_images(path / _MASKS):
            self.masks = path / _MASKS
            self.notes.append(f"masks of instruments are used, from {_MASKS} beside the images")
        elif numbered_images(path / _MASKS_WITH_HOLES):
            self.notes.append(f"{_MASKS_WITH_HOLES} (instruments and holes of the depth) is not used by default")

    def _read_poses(self, rows: np.ndarray, file: Path) -> dict[int, np.ndarray]:
        """Return the poses by frame number, and note by which convention they were read."""
        motions = rows[:, :15].reshape(-1, 3, 5)[..., :4]
        known = np.isfinite(motions).all(axis=(1, 2))
        poses = np.tile(np.eye(4), (int(known.sum()), 1, 1))
        poses[:, :3] = motions[known]
        if not len(poses):
            self._warn(f"{file} holds no finite pose: none is known")
            return {}
        poses = rigid(poses, [f"{file}, row {row}" for row in np.flatnonzero(known)])
        if np.abs(poses[0, :3, :3] - np.eye(3)).max() > _IDENTITY_TOLERANCE:
            poses[:, :3, :3] = np.stack([poses[:, :3, 1], poses[:, :3, 0], -poses[:, :3, 2]], axis=-1)
            self.notes.append(f"poses in {file.name} are taken as LLFF's (columns down, right, back), in mm")
        else:
            self.notes.append(f"poses in {file.name} start at the identity: taken as they are, camera to world, in mm")
        if np.abs(poses - poses[0]).max() < _REST_TOLERANCE:
            self.camera_at_rest = True
            self.notes.append(Notice("camera-at-rest"))
        if len(rows) != len(self.numbers):
            found = f"{len(rows)} rows for {len(self.numbers)} images"
            raise InputError(f"reading {file}: it holds {found}, in their order")
        return dict(zip(np.array(self.numbers)[known].tolist(), poses, strict=True))


def _read_rows(file: Path) -> np.ndarray:
    with reporting(f"reading {file}: no NumPy array of numbers"):
        # Mapped, a header that claims more than the file holds is refused before any memory is taken.
        array = np.load(file, mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive")
    if array.ndim != 2 or array.shape[1] != _COLUMNS or array.dtype.kind not in "fiu":
        found = f"{array.dtype} of shape {array.shape}"
        raise InputError(f"reading {file}: expected LLFF's numbers of shape (images, {_COLUMNS}), found {found}")
    return np.array(array, dtype=np.float64)


def _camera(rows: np.ndarray, file: Path) -> PinholeCamera:
    """Return the camera that all rows agree on, at the size that they state."""
    stated = rows[:, [4, 9, 14]]
    stated = np.unique(np.round(stated[np.isfinite(stated).all(axis=1)], 6), axis=0)
    found = "several cameras" if len(stated) else "none"
    if len(stated) == 1:
        height, width, focal_px = stated[0].tolist()
        if min(height, width) >= 1 and 0.3 * width < focal_px < 5 * width:
            return PinholeCamera(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, round(width), round(height))
        found = f"height {height:g}, width {width:g}, focal length {focal_px:g}"
    raise CalibrationError(
        f"the camera in {file} cannot be used: expected one height, width and focal length, px, in columns 5, 10 and "
        f"15 of all rows, found {found}; put the calibration beside it as camera.yaml"
    )
