"""SimCol3D: rendered colonoscopy with exact poses and depth (github.com/anitarau/simcol).

`SyntheticColon_I/Frames_S1/FrameBuffer_0000.png`, `Depth_0000.png` beside it (16 bit, 65280 = 20 cm). Beside the folder
`SavedPosition_S1.txt` (cm) and `SavedRotationQuaternion_S1.txt` (x y z w), line = image number, from 0, and one
`cam.txt` (3x3) for all trajectories. Rau et al., "SimCol3D", arXiv 2307.11261.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scopemap.cameras.formats.reading import read_calibration
from scopemap.errors import InputError
from scopemap.io.images import ImageFolder, image_files
from scopemap.trajectory.formats.poses import poses_by_row
from scopemap.trajectory.formats.text import read_numbers
from scopemap_bench.datasets.unity import mirrored

DEPTH_RANGE_MM = 200.0
_MM_PER_CM = 10.0
_POSE_NAMES = ("SavedPosition", "SavedRotationQuaternion")
_FRAME_NAME = re.compile(r"FrameBuffer_\d+")
_FOLDER_NAME = re.compile(r"Frames_(\w+)")


class SimColFolder(ImageFolder):
    """The frames of one trajectory; `camera.yaml` beside them replaces `cam.txt`.

    Depth of 8 bit, 255 = 20 cm, as in the older SimColonDepth, is read, too.
    Raises `InputError` where images and poses do not fit together.
    """

    name = "simcol3d"
    quality = "exact"
    depth_code = ((8, DEPTH_RANGE_MM / 255, 255), (16, DEPTH_RANGE_MM / 65280, 65280))

    def __init__(self, path: Path) -> None:
        super().__init__(path, _frame_files(path))
        self._check_numbers()
        depths = {n: file.with_name(file.name.replace("FrameBuffer", "Depth")) for n, file in self.file_of.items()}
        self.depth_files = {number: file for number, file in depths.items() if file.is_file()}
        self._read_poses()
        file = _beside(path, "cam.txt")
        if self.camera is None and file is not None:
            self.camera = read_calibration(file, (self.width, self.height)).camera
            self.camera_source = f"intrinsics of the data set ({file})"
            self.notes.append("cam.txt is taken for pixel centres that count from 0 (it does not state it)")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds `FrameBuffer_*.png`."""
        return bool(_frame_files(path))

    def _read_poses(self) -> None:
        files = _pose_files(self.path)
        if files is None:
            self.warnings.append(f"no pose is known: SavedPosition_*.txt of these frames is not beside {self.path}")
            return
        positions = read_numbers(files[0], missing=True).with_columns(3, files[0].name)
        quaternions = read_numbers(files[1], missing=True).with_columns(4, files[1].name)
        same_lines = np.array_equal(positions.line_numbers, quaternions.line_numbers)
        if not same_lines or self.numbers[-1] >= positions.line_numbers[-1]:
            raise InputError(
                f"reading {self.path}: {files[0].name} holds {len(positions.values)} lines and {files[1].name} "
                f"{len(quaternions.values)}, the last image is {self.files[-1].name} (line = image number, from 0)"
            )
        poses = poses_by_row(np.hstack([positions.values, quaternions.values]), _MM_PER_CM, quaternions.where)
        self.poses = {int(positions.line_numbers[row]) - 1: mirrored(T) for row, T in poses.items()}
        self.notes.append("poses: cm, in Unity's left-handed axes, y mirrored to OpenCV's")


def _frame_files(path: Path) -> list[Path]:
    return [file for file in image_files(path) if _FRAME_NAME.fullmatch(file.stem)]


def _pose_files(path: Path) -> tuple[Path, Path] | None:
    """Return the two files of the folder's trajectory, of which one may be missing; None where both are."""
    match = _FOLDER_NAME.fullmatch(path.absolute().name)
    inside = [file.stem.removeprefix(_POSE_NAMES[0]) for file in path.glob(f"{_POSE_NAMES[0]}*.txt")]
    for ending in ([f"_{match[1]}"] if match else []) + (inside if len(inside) == 1 else []):
        names = [f"{name}{ending}.txt" for name in _POSE_NAMES]
        found = next((file for name in names if (file := _beside(path, name)) is not None), None)
        if found is not None:
            return found.with_name(names[0]), found.with_name(names[1])
    return None


def _beside(path: Path, name: str) -> Path | None:
    """Return the file `name` in the folder, in the one around it, or around that (zips repeat a folder); or None."""
    path = path.absolute()
    return next((file for folder in (path, *path.parents[:2]) if (file := folder / name).is_file()), None)
