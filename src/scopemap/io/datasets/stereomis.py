"""StereoMIS: da Vinci stereo video of porcine abdomens, poses from robot kinematics (Zenodo 8154924).

One folder per recording: one `.mp4` with the left view above the right, `StereoCalibration.ini`, `groundtruth.txt` with
rows `frame tx ty tz qx qy qz qw` (camera-to-world, metres, OpenCV axes), `masks/000001l.png`. Copies without the first
column are read, too; there row = frame. Hayoz et al., "Learning how to robustly estimate camera pose in endoscopic
videos", IJCARS 2023, arXiv 2304.08023.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scopemap.cameras.formats.reading import stated_calibration
from scopemap.errors import InputError
from scopemap.io.datasets.posed_video import PosedVideo
from scopemap.io.datasets.unity import numbers_of, poses_of_rows
from scopemap.trajectory.formats.poses import are_frame_numbers
from scopemap.trajectory.formats.text import fields_of, text_lines

_CALIBRATION = "StereoCalibration.ini"
_POSES = "groundtruth.txt"
_PUBLISHED_ASPECT = 1280 / 1024
_MM_PER_METRE = 1000.0


class StereoMisFolder(PosedVideo):
    """The left view of one recording.

    Attributes
    ----------
    frame_offset : number of a row in groundtruth.txt less that of its frame in the video.
    """

    name = "stereomis"

    def __init__(self, path: Path) -> None:
        file = path / _CALIBRATION
        # The file states its own size.
        camera = stated_calibration(file, (1, 1)).camera if file.is_file() else None
        super().__init__(path, _video_in(path), _PUBLISHED_ASPECT if camera is None else camera.width / camera.height)
        if self.camera is None and camera is not None:
            self._calibrate(camera, file)
        self.frame_offset = 0
        self._take_poses(path / _POSES)
        if (path / "masks").is_dir():
            self.notes.append(
                "masks/ is not used: 0 is where instruments are, the other way round than mask.files has it, and the "
                "numbers count from 1"
            )

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds the stereo calibration and a video."""
        return (path / _CALIBRATION).is_file() and bool(_videos_in(path))

    def _take_poses(self, file: Path) -> None:
        if not file.is_file():
            self.notes.append(f"no pose is known: {_POSES} is not there")
            return
        found = read_groundtruth(file)
        self.poses, self.frame_offset = found.poses, found.frame_offset
        base = f"row {found.frame_offset} is the video's first frame"
        if not found.numbered:
            base = "the rows carry no frame numbers: row = frame, from 0"
        self.notes.append(
            f"truth: robot kinematics, {_POSES} taken as camera-to-world in metres; {base}; no depth is known"
        )
        beyond = sum(self.count is not None and number >= self.count for number in found.poses)
        if beyond or (not found.numbered and self.count is not None and found.rows != self.count):
            self.warnings.append(
                f"{file}: it holds {found.rows} rows, {beyond} of them beyond the {self.count} frames of the video; "
                "poses may belong to other frames"
            )


@dataclass(frozen=True)
class Groundtruth:
    """What `groundtruth.txt` says.

    Attributes
    ----------
    poses : (4, 4) float64 camera-to-world, mm, by frame of the video; a frame without a finite row is not among them.
    frame_offset : number of a row less that of its frame.
    numbered : whether the rows carry frame numbers.
    rows : how many there are.
    """

    poses: dict[int, np.ndarray]
    frame_offset: int
    numbered: bool
    rows: int


def read_groundtruth(file: Path) -> Groundtruth:
    """Return the poses in rows of 8 numbers, the first the frame, or of 7; in any order, by spaces, tabs or commas.

    Numbers that begin at 1 count frames from 1. A row that holds NaN or infinity is a frame without a pose. Raises
    `InputError`, with the line, for what is no such row, and for a frame that comes again.
    """
    lines = [(number, fields_of(line)) for number, line in enumerate(text_lines(file), start=1)]
    rows = [(f"{file}, line {number}", fields) for number, fields in lines if fields]
    if not rows:
        raise InputError(f"reading {file}: it holds no pose")
    where = [place for place, _ in rows]
    columns = len(rows[0][1])
    if columns not in (7, 8):
        raise InputError(f"{where[0]}: found {columns} columns, expected frame tx ty tz qx qy qz qw, or the last 7")
    values = np.array([numbers_of(fields, columns, place) for place, fields in rows])
    numbers = values[:, 0] if columns == 8 else np.arange(len(rows))
    if not are_frame_numbers(numbers) or numbers.min() < 0:
        raise InputError(f"reading {file}: the first column of 8 must be frame numbers, found {numbers.min():g}, ...")
    _, first = np.unique(numbers, return_index=True)
    if len(first) < len(numbers):
        again = min(set(range(len(numbers))) - set(first.tolist()))
        raise InputError(f"{where[again]}: frame {numbers[again]:g} comes again; leave one row out")
    offset = int(numbers.min() == 1)
    known, T = poses_of_rows(values[:, -7:], _MM_PER_METRE, where)
    poses = {int(number) - offset: pose for number, pose in zip(numbers[known], T, strict=True)}
    return Groundtruth(poses, offset, columns == 8, len(rows))


def _videos_in(path: Path) -> list[Path]:
    files = path.iterdir() if path.is_dir() else ()
    return sorted(file for file in files if file.suffix.lower() == ".mp4" and not file.name.startswith("."))


def _video_in(path: Path) -> Path:
    videos = _videos_in(path)
    if len(videos) != 1:
        found = ", ".join(file.name for file in videos[:3]) or "none"
        raise InputError(f"reading {path}: a StereoMIS recording holds one .mp4, found {len(videos)} ({found})")
    return videos[0]
