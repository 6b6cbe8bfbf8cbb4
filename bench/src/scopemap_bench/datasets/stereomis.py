"""StereoMIS: da Vinci stereo video of porcine abdomens, poses from robot kinematics (Zenodo 8154924).

One folder per recording: one `.mp4` with the left view above the right, `StereoCalibration.ini`, `groundtruth.txt` with
rows `frame tx ty tz qx qy qz qw` (camera-to-world, metres, OpenCV axes), `masks/000001l.png`. Hayoz et al.,
"Learning how to robustly estimate camera pose in endoscopic videos", IJCARS 2023, arXiv 2304.08023.
"""

from __future__ import annotations

from pathlib import Path

from scopemap.engine.errors import InputError
from scopemap.input.camera_files.reading import stated_calibration
from scopemap.input.trajectory.columns import are_frame_numbers
from scopemap.input.trajectory.text import read_numbers
from scopemap_bench.datasets.layouts import poses_by_row
from scopemap_bench.datasets.posed_video import PosedVideo, videos_in

_CALIBRATION = "StereoCalibration.ini"
_POSES = "groundtruth.txt"
_PUBLISHED_ASPECT = 1280 / 1024
_MM_PER_METRE = 1000.0


class StereoMisFolder(PosedVideo):
    """The left view of one recording."""

    name = "stereomis"

    def __init__(self, path: Path) -> None:
        file = path / _CALIBRATION
        # The file states its own size.
        camera = stated_calibration(file, (1, 1)).camera if file.is_file() else None
        super().__init__(
            path, videos_in(path, ".mp4"), _PUBLISHED_ASPECT if camera is None else camera.width / camera.height
        )
        if self.camera is None and camera is not None:
            self._set_camera(camera, f"calibration of the data set, {file.name}", str(file))
        if (path / _POSES).is_file():
            self._read_poses(path / _POSES)
        else:
            self.notes.append(f"no pose is known: {_POSES} is not there")
        if (path / "masks").is_dir():
            self.notes.append(
                "masks/ is not used: it marks instruments by 0, unlike mask.files, and counts frames from 1"
            )

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` holds the stereo calibration and a video."""
        return (path / _CALIBRATION).is_file() and bool(videos_in(path, ".mp4"))

    def _read_poses(self, file: Path) -> None:
        """Read rows of 8 numbers, the first the frame, in any order; numbers from 1 count frames from 1.

        A row that holds NaN or infinity is a frame without a pose. Raises `InputError`, with the line, for what is no
        such row, and for a frame that is repeated.
        """
        table = read_numbers(file, missing=True).as_tum("frame tx ty tz qx qy qz qw").sorted_by_stamp()
        numbers = table.values[:, 0]
        if not are_frame_numbers(numbers) or numbers[0] < 0:
            raise InputError(f"reading {file}: the first column of 8 must be frame numbers, found {numbers[0]:g}")
        offset = int(numbers[0] == 1)
        poses = poses_by_row(table.values[:, -7:], _MM_PER_METRE, table.where)
        self.poses = {int(numbers[row]) - offset: pose for row, pose in poses.items()}
        self.notes += [
            f"the truth is robot kinematics: {_POSES} is read as camera-to-world in metres",
            f"row {offset} of the truth is the video's first frame; no depth is known",
        ]
        self._warn_of_poses_beyond(file)
