"""SimCol3D: rendered colonoscopy with exact poses and depth (github.com/anitarau/simcol).

`SyntheticColon_I/Frames_S1/FrameBuffer_0000.png`, `Depth_0000.png` beside it (16 bit, 65280 = 20 cm). Beside the folder
`SavedPosition_S1.txt` (cm) and `SavedRotationQuaternion_S1.txt` (x y z w), line = image number, from 0, and one
`cam.txt` (3x3) for all trajectories. Rau et al., "SimCol3D", arXiv 2307.11261.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.input.trajectory.text import read_numbers
from scopemap_bench.datasets.layouts import LayoutFolder, Place, mirrored, poses_by_row

DEPTH_RANGE_MM = 200.0
_MM_PER_CM = 10.0
_POSITION = "SavedPosition"
_ROTATION = "SavedRotationQuaternion"


class SimColFolder(LayoutFolder):
    """The frames of one trajectory; depth of 8 bit, 255 = 20 cm, as in the older SimColonDepth, is read, too."""

    name = "simcol3d"
    places = (Place("", "FrameBuffer_*", ("Depth_{}.png",)),)
    numbered = True
    intrinsics = (("cam.txt", 2),)
    quality = "exact"
    depth_code = ((8, DEPTH_RANGE_MM / 255, 255), (16, DEPTH_RANGE_MM / 65280, 65280))

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        files = _pose_files(path)
        if files is None:
            self.warnings.append(f"no pose is known: SavedPosition_*.txt of these frames is not beside {path}")
            return
        positions = read_numbers(files[0], missing=True).with_columns(3, files[0].name)
        quaternions = read_numbers(files[1], missing=True).with_columns(4, files[1].name)
        same_lines = np.array_equal(positions.line_numbers, quaternions.line_numbers)
        if not same_lines or self.numbers[-1] >= positions.line_numbers[-1]:
            raise InputError(
                f"reading {path}: {files[0].name} holds {len(positions.values)} lines and {files[1].name} "
                f"{len(quaternions.values)}, the last image is {self.files[-1].name} (line = image number, from 0)"
            )
        poses = poses_by_row(np.hstack([positions.values, quaternions.values]), _MM_PER_CM, quaternions.where)
        self.poses = {int(positions.line_numbers[row]) - 1: mirrored(T) for row, T in poses.items()}
        self.notes.append("poses: cm, in Unity's left-handed axes, y mirrored to OpenCV's")


def _pose_files(path: Path) -> tuple[Path, Path] | None:
    """Return the files of the folder's trajectory, of which one may be missing; None where both are.

    They are named as `Frames_NAME`, or are the only ones in the folder; beside them, or up to two folders above.
    """
    own = path.absolute()
    inside = [file.stem.removeprefix(_POSITION) for file in path.glob(f"{_POSITION}*.txt")]
    endings = [f"_{own.name.removeprefix('Frames_')}"] if own.name.startswith("Frames_") else []
    for ending in endings + (inside if len(inside) == 1 else []):
        for folder in (own, *own.parents[:2]):
            files = (folder / f"{_POSITION}{ending}.txt", folder / f"{_ROTATION}{ending}.txt")
            if any(file.is_file() for file in files):
                return files
    return None
