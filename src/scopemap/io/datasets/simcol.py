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
from scopemap.io.datasets.unity import mirrored, numbers_of, poses_of_rows
from scopemap.io.decoding import read_decoded
from scopemap.io.images import ImageFolder, frame_number, image_files
from scopemap.trajectory.formats.text import fields_of, text_lines

DEPTH_RANGE_MM = 200.0
_LARGEST = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65280}
_MM_PER_CM = 10.0
_POSE_NAMES = ("SavedPosition", "SavedRotationQuaternion")
_FRAME_NAME = re.compile(r"FrameBuffer_\d+")
_FOLDER_NAME = re.compile(r"Frames_(\w+)")


class SimColFolder(ImageFolder):
    """The frames of one trajectory; `camera.yaml` beside them wins over `cam.txt`.

    Depth of 8 bit, 255 = 20 cm, as in the older SimColonDepth, is read, too.
    Raises `InputError` where images and poses do not fit together.
    """

    name = "simcol3d"
    quality = "exact"

    def __init__(self, path: Path) -> None:
        super().__init__(path, _frame_files(path))
        if self.numbers != [frame_number(file) for file in self.files]:
            raise InputError(f"reading {path}: several images carry the same number; leave one of each")
        self._file_of = dict(zip(self.numbers, self.files, strict=True))
        self._poses = self._read_poses()
        file = _beside(path, "cam.txt")
        if self.camera is None and file is not None:
            self.camera = read_calibration(file, (self.width, self.height)).camera
            self.camera_source = f"intrinsics of the data set ({file})"
            self.notes.append("cam.txt is used as it stands, for pixel centres that count from 0 (it does not say)")

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `FrameBuffer_*.png`."""
        return path.is_dir() and bool(_frame_files(path))

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose of the image's line; None where it holds NaN, and where the poses are not there."""
        return self._poses.get(index)

    def _read_poses(self) -> dict[int, np.ndarray]:
        files = _pose_files(self.path)
        if files is None:
            self.warnings.append(f"no pose is known: SavedPosition_*.txt of these frames is not beside {self.path}")
            return {}
        for file in files:
            if not file.is_file():
                raise InputError(f"reading {self.path}: {file} is missing, poses need {' and '.join(_POSE_NAMES)}")
        positions, quaternions = _read_table(files[0], 3), _read_table(files[1], 4)
        if len(positions) != len(quaternions) or self.numbers[-1] >= len(positions):
            raise InputError(
                f"reading {self.path}: {files[0].name} holds {len(positions)} lines and {files[1].name} "
                f"{len(quaternions)}, the last image is {self.files[-1].name} (line = image number, from 0)"
            )
        where = [f"{files[1]}, line {number}" for number in range(1, len(quaternions) + 1)]
        known, T = poses_of_rows(np.hstack([positions, quaternions]), _MM_PER_CM, where)
        self.notes.append("poses: cm, in Unity's left-handed axes, y mirrored to OpenCV's")
        return dict(zip(np.flatnonzero(known).tolist(), mirrored(T), strict=True))

    def _depth_mm(self, index: int) -> np.ndarray | None:
        file = self._file_of[index]
        file = file.with_name(file.name.replace("FrameBuffer", "Depth"))
        if not file.is_file():
            return None
        values = read_decoded(file)
        if values is None or values.ndim != 2 or values.dtype not in _LARGEST:
            raise InputError(f"reading {file}: expected a depth image of one 8- or 16-bit channel")
        largest = _LARGEST[values.dtype]
        scale_mm = self.depth_scale_mm or DEPTH_RANGE_MM / largest
        known = (values > 0) & (values <= largest)
        return np.where(known, values * scale_mm, np.nan).astype(np.float32)


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


def _read_table(file: Path, columns: int) -> np.ndarray:
    # Empty lines at the end say nothing; one in between would shift the lines after it, and is refused.
    lines = "\n".join(text_lines(file)).rstrip().splitlines()
    rows = [numbers_of(fields_of(line), columns, f"{file}, line {n}") for n, line in enumerate(lines, start=1)]
    return np.array(rows, dtype=np.float64).reshape(-1, columns)
