"""EndoSLAM: endoscopes and capsules in ex-vivo organs, held by a robot, and the same rendered in Unity.

Real: `Cameras/HighCam/Colon-I/TumorfreeTrajectory_1/{Frames/frame_000060.jpg, Poses/*.xlsx}`. Rendered:
`UnityCam/Colon/{Frames/image_0000.png, Pixelwise Depths/aov_image_0000.png, Poses/colon_position_rotation.csv}`; copies
repeat folders (`Frames/Frames`, `Depths/Pixelwise Depths`). `Calibration/cam.txt` (3x3) lies beside a camera's organs.
Ozyoruk et al., "EndoSLAM dataset and an unsupervised monocular visual odometry and depth estimation approach for
endoscopic videos", arXiv 2006.16670.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.reading import read_calibration
from scopemap.errors import InputError
from scopemap.io.datasets.endoslam_poses import POSE_FILES, CameraPath, find_poses, read_camera_path
from scopemap.io.decoding import read_decoded
from scopemap.io.images import FOLDER_RATE_HZ, ImageFolder, frame_number, image_files

UNITY_CAMERA = PinholeCamera(156.0418, 155.7529, 178.5604, 181.8043, 320, 320)
"""UnityCam's `cam.txt` as others quote it, for copies without it."""

RATES_HZ = {"HighCam": 20.0, "LowCam": 20.0, "MiroCam": 3.0, "UnityCam": 30.0, "OlympusCam": 30.0}
"""Frames per s by the data set's table; PillCam's vary from 4 to 35."""

DEPTH_UNIT_MM = 10.0
"""Rendered depth read as cm, as most do; its unit is not documented."""

_FRAMES = ("Frames", "Frames/Frames")
_POSES = ("Poses", "Poses/Poses")
_DEPTHS = ("Pixelwise Depths", "Depths/Pixelwise Depths", "Pixelwise Depths/Pixelwise Depths")
_TRAJECTORY = re.compile(r"Tumor\w*Trajectory_\d+")
_CLIPPED = 255


class EndoSlamFolder(ImageFolder):
    """The frames of one trajectory; `camera.yaml` beside `Frames` wins over `cam.txt`.

    Raises `InputError` where images and poses do not fit together.
    """

    name = "endoslam"

    def __init__(self, path: Path) -> None:
        super().__init__(path, _frame_files(path))
        if self.numbers != [frame_number(file) for file in self.files]:
            raise InputError(f"reading {path}: several images carry the same number, or one carries none")
        file = _pose_file(path)
        self._track: CameraPath | None = None if file is None else read_camera_path(file)
        depths = next((path / name for name in _DEPTHS if (path / name).is_dir()), None)
        self._depth_of = {frame_number(f): f for f in image_files(depths)} if depths is not None else {}
        rendered = bool(self._depth_of) or (file is not None and file.suffix.lower() == ".csv")
        self.quality = "exact" if self._track is None else self._track.quality
        self._rate_hz, rate_source = _rate_hz(path, "UnityCam" if rendered else "HighCam" if file else "")
        stated = self._track is not None and self._track.times_s is not None
        self.stamped = stated
        times = "those of the poses" if stated else f"image number / {self._rate_hz:g} s ({rate_source})"
        self.notes = [f"time stamps: {times}"]
        self._check_track(file)
        if self._depth_of:
            self.notes.append("depth: 8 bit, unit not documented, read as cm; compare after aligning scale")
        if self.camera is None:
            self._calibrate(rendered)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `Frames` with images, and `Poses` or depth beside it or the name of a trajectory."""
        named = _TRAJECTORY.fullmatch(path.absolute().name) is not None
        known = named or any((path / name).is_dir() for name in (_POSES[0], *_DEPTHS))
        return known and bool(_frame_files(path))

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose of the image's row; None where it has none."""
        return None if self._track is None else self._track.poses.get(index)

    def _time_s(self, number: int) -> float:
        times_s = None if self._track is None else self._track.times_s
        if times_s is None:
            return number / self._rate_hz
        last = len(times_s) - 1
        return float(times_s[min(number, last)] + max(number - last, 0) / self._rate_hz)

    def _check_track(self, file: Path | None) -> None:
        if self._track is None or file is None:
            self.warnings.append(
                f"no pose is known: looked for {' and '.join(POSE_FILES)} in Poses (.txt is not documented)"
            )
            return
        self.notes += self._track.notes
        self.warnings += self._track.warnings
        without = sum(number not in self._track.poses for number in self.numbers)
        if without == len(self.numbers):
            raise InputError(
                f"reading {self.path}: no image has a pose in {file} ({self._track.count} rows; images "
                f"{self.numbers[0]} to {self.numbers[-1]}); do they belong together?"
            )
        if without or self._track.count != len(self.numbers):
            self.warnings.append(
                f"{file.name} holds {self._track.count} rows for {len(self.numbers)} images; "
                f"{without} images have no pose"
            )

    def _calibrate(self, rendered: bool) -> None:
        size = (self.width, self.height)
        around = (self.path.absolute(), *self.path.absolute().parents[:3])
        file = next((f for folder in around if (f := folder / "Calibration" / "cam.txt").is_file()), None)
        if file is not None:
            self.camera, self.camera_source = (
                read_calibration(file, size).camera,
                f"intrinsics of the data set ({file})",
            )
            self.notes.append("cam.txt is used as it stands: pixel centres that count from 0, no distortion")
        elif rendered and size == (UNITY_CAMERA.width, UNITY_CAMERA.height):
            self.camera, self.camera_source = UNITY_CAMERA, "published UnityCam intrinsics"

    def _depth_mm(self, index: int) -> np.ndarray | None:
        file = self._depth_of.get(index)
        if file is None:
            return None
        values = read_decoded(file)
        if values is None or values.dtype != np.uint8:
            raise InputError(f"reading {file}: expected a depth image of 8 bit")
        # Depth is the red channel; OpenCV turns the channels round.
        values = values if values.ndim == 2 else values[..., 2]
        known = (values > 0) & (values < _CLIPPED)
        return np.where(known, values * (self.depth_scale_mm or DEPTH_UNIT_MM), np.nan).astype(np.float32)


def _frame_files(path: Path) -> list[Path]:
    folders = (path / name for name in _FRAMES)
    return next((files for folder in folders if folder.is_dir() and (files := image_files(folder))), [])


def _pose_file(path: Path) -> Path | None:
    return next((file for name in _POSES if (file := find_poses(path / name)) is not None), None)


def _rate_hz(path: Path, camera: str) -> tuple[float, str]:
    """Return the rate of the camera that the path names, else that of `camera`, and whose it is."""
    named = next((part for part in reversed(path.absolute().parts) if part in RATES_HZ), camera)
    return (RATES_HZ[named], f"published rate of {named}") if named in RATES_HZ else (FOLDER_RATE_HZ, "assumed")
