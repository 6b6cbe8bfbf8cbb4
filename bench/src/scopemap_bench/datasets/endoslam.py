"""EndoSLAM: endoscopes and capsules in ex-vivo organs, held by a robot, and the same rendered in Unity.

Real: `Cameras/HighCam/Colon-I/TumorfreeTrajectory_1/{Frames/frame_000060.jpg, Poses/*.xlsx}`, columns `ImageFrame` (the
number in the image's name), `trans_x,y,z` (metres), `quot_x,y,z,w`. Rendered: `UnityCam/Colon/{Frames/image_0000.png,
Pixelwise Depths/aov_image_0000.png, Poses/colon_position_rotation.csv}`, row = image number. Copies repeat folders.
`Calibration/cam.txt` (3x3) is beside a camera's organs. Not documented: the unit of Unity and of rendered depth, frame
and axes of the robot. Ozyoruk et al., arXiv 2006.16670.
"""

from __future__ import annotations

import re
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import InputError, check_bytes, reporting
from scopemap.input.decoding import read_decoded
from scopemap_bench.datasets.layouts import Place, UnityFolder, poses_by_row

UNITY_CAMERA = PinholeCamera(156.0418, 155.7529, 178.5604, 181.8043, 320, 320)
"""UnityCam's `cam.txt` as others quote it, for copies without it."""

RATES_HZ = {"HighCam": 20.0, "LowCam": 20.0, "MiroCam": 3.0, "UnityCam": 30.0, "OlympusCam": 30.0}
"""Frames per s by the data set's table; PillCam's vary from 4 to 35."""

DEPTH_UNIT_MM = 10.0
"""Rendered depth read as cm, as most do; its unit is not documented."""

_DEPTHS = ("Pixelwise Depths/", "Depths/Pixelwise Depths/", "Pixelwise Depths/Pixelwise Depths/")
_POSES = ("Poses", "Poses/Poses")
_POSE_FILES = ("*position_rotation.csv", "*.xlsx")
_TRAJECTORY = re.compile(r"Tumor\w*Trajectory_\d+")
_COLUMNS = ("imageframe", "trans_x", "trans_y", "trans_z", "quot_x", "quot_y", "quot_z", "quot_w")
_MM_PER_METRE = 1000.0
_SAME = 1e-6
# Some hundred thousand cells; in memory they take many times as much.
_MOST_BYTES = 32 << 20
_MOST_CELLS = 4_000_000


class EndoSlamFolder(UnityFolder):
    """The frames of one trajectory. Raises `InputError` where images and poses do not fit together."""

    name = "endoslam"
    places = (Place("Frames", depths=_DEPTHS), Place("Frames/Frames", depths=_DEPTHS))
    needs = (("Poses", *_DEPTHS),)
    intrinsics = (("Calibration/cam.txt", 3),)
    depth_code = ((8, DEPTH_UNIT_MM, 254),)  # 255 was clipped

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        found = (file for name in _POSES for pattern in _POSE_FILES for file in sorted((path / name).glob(pattern)))
        # Excel leaves "~$" locks behind, zips made on a Mac "._" files.
        file = next((file for file in found if file.is_file() and not file.name.startswith((".", "~"))), None)
        rendered = bool(self.depth_files) or (file is not None and file.suffix.lower() == ".csv")
        usual = "UnityCam" if rendered else "HighCam" if file else ""
        camera = next((part for part in reversed(path.absolute().parts) if part in RATES_HZ), usual)
        self.rate_hz = RATES_HZ.get(camera, self.rate_hz)
        rate_source = f"published rate of {camera}" if camera else "assumed"
        self.notes[0] = f"time stamps: image number / {self.rate_hz:g} s ({rate_source})"
        if self.depth_files:
            self.notes.append("depth: 8 bit, unit not documented, read as cm; compare after aligning scale")
        if file is None:
            self.warnings.append(f"no pose is known: looked for {' and '.join(_POSE_FILES)} in Poses")
        elif file.suffix.lower() == ".csv":
            self._check_poses(file, self._read_rendered(file))
        else:
            self._check_poses(file, self._read_robot(file))
        if self.camera is None and rendered and (self.width, self.height) == (UNITY_CAMERA.width, UNITY_CAMERA.height):
            self.camera, self.camera_source = UNITY_CAMERA, "published UnityCam intrinsics"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether `path` is of the layout, or holds pictures of it under the name of a trajectory."""
        named = _TRAJECTORY.fullmatch(path.absolute().name) is not None
        return super().recognises(path) or (named and any(place.pictures(path) for place in cls.places))

    def _read_rendered(self, file: Path) -> int:
        """Read Unity's table and return the number of its rows."""
        count = self._read_table(file, _MM_PER_METRE)
        rotations = np.array([T[:3, :3] for T in self.poses.values()])
        if len(rotations) > 1 and np.ptp(rotations, axis=0).max() < _SAME:
            self.warnings.append(f"{file.name}: all rotations are the same; errors of rotation against it mislead")
        self.notes += [
            "poses: their unit is not documented, read as metres; compare after aligning scale",
            "poses: Unity's left-handed axes, y mirrored to OpenCV's (EndoGSLAM mirrors z; neither is documented)",
            f"poses: row of {file.name} = image number, from 0 (it does not state it)",
        ]
        return count

    def _read_robot(self, file: Path) -> int:
        """Read the robot's spreadsheet and return the number of its rows."""
        self.quality = "kinematic"
        rows, where = _sheet_rows(file)
        for row, T in poses_by_row(rows[:, 1:], _MM_PER_METRE, where).items():
            image = rows[row, 0]
            if not (np.isfinite(image) and image >= 0 and image == int(image)):
                raise InputError(f"{where[row]}: ImageFrame must be the number of an image, found {image:g}")
            self.poses[int(image)] = T
        self.notes += [
            "poses: metres, as in the file; whether of camera or robot hand, and in which axes, is not documented",
            "poses: joined by ImageFrame = number in the image's name",
        ]
        return len(rows)

    def _check_poses(self, file: Path, count: int) -> None:
        without = sum(number not in self.poses for number in self.numbers)
        if without == len(self.numbers):
            raise InputError(
                f"reading {self.path}: no image has a pose in {file} ({count} rows; images {self.numbers[0]} to "
                f"{self.numbers[-1]}); do they belong together?"
            )
        if without or count != len(self.numbers):
            found = f"{count} rows for {len(self.numbers)} images; {without} images have no pose"
            self.warnings.append(f"{file.name} holds {found}")

    def _depth_levels(self, file: Path) -> np.ndarray | None:
        levels = read_decoded(file)
        # Depth is the red channel, the last in OpenCV's order.
        return levels[..., 2] if levels is not None and levels.ndim == 3 else levels


def _sheet_rows(file: Path) -> tuple[np.ndarray, list[str]]:
    """Return the columns `_COLUMNS` of the first sheet, (N, 8), NaN for empty cells, and the place of each row."""
    sheet = read_sheet(file)
    names = [name.lower().replace("quat_", "quot_") for name in sheet[0][1]] if sheet else []
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        found = ", ".join(filter(None, names)) or "-"
        raise InputError(f"{file}: the first sheet has no column {', '.join(missing)}, found {found}")
    wanted = [names.index(name) for name in _COLUMNS]
    filled = [(f"{file}, row {number}", cells) for number, cells in sheet[1:] if any(cells[c] for c in wanted)]
    rows = []
    for place, cells in filled:
        with reporting(f"{place}: expected {len(wanted)} numbers"):
            rows.append([float(cells[column] or "nan") for column in wanted])
    if not rows:
        raise InputError(f"reading {file}: it holds no pose")
    return np.array(rows), [place for place, _ in filled]


def read_sheet(file: Path) -> list[tuple[int, list[str]]]:
    """Return number, from 1, and cells ("" if empty) of the first sheet's rows that hold anything.

    Raises `InputError` for any other file, for one that unpacks to more than 32 MB, and without `openpyxl`.
    """
    if find_spec("openpyxl") is None:
        raise InputError(f"reading {file}: it is a spreadsheet; install its reader: pip install -e bench")
    import openpyxl

    with reporting(f"reading {file}: no Excel workbook, or damaged; download it again"):
        with zipfile.ZipFile(file) as archive:
            check_bytes(str(file), sum(member.file_size for member in archive.infolist()), _MOST_BYTES)
        sheet = openpyxl.load_workbook(file, data_only=True).worksheets[0]
        if sheet.max_row * sheet.max_column > _MOST_CELLS:
            raise InputError(f"reading {file}: its first sheet claims {sheet.max_row}x{sheet.max_column} cells")
        rows = [["" if cell is None else str(cell).strip() for cell in row] for row in sheet.values]
    return [(number, row) for number, row in enumerate(rows, start=1) if any(row)]
