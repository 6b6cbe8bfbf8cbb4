"""7-Scenes: RGB-D sequences of rooms (Shotton et al., CVPR 2013), for odometry and fusion with measured depth.

`frame-NNNNNN.color.png`, `.depth.png` (uint16 mm, 65535 = unknown), `.pose.txt` (4x4 camera-to-world, metres), optional
`camera-intrinsics.txt` (3x3). Colour and depth come from two cameras of a Kinect, and are not registered in the files;
poses and the published intrinsics are the depth camera's. Here the camera is that of the colour images, with the
Kinect's nominal focal length and distance from the depth camera, and depth and poses are brought to it. (Where depth
jumps in "redkitchen", the gradient of colour is then 2.3 times its mean; in the files as they are, 0.8 times.)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.calibration import rescaled_note
from scopemap.cameras.formats.reading import read_calibration
from scopemap.cameras.rectification import DepthSensor
from scopemap.errors import CalibrationError, InputError
from scopemap.geometry.se3 import inverse, se3
from scopemap.io.images import ImageFolder, image_files, read_depth16
from scopemap.trajectory.formats.poses import rigid

DEPTH_CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, 640, 480)
"""As published."""

COLOUR_CAMERA = PinholeCamera(525.0, 525.0, 320.0, 240.0, 640, 480)
"""Not published; nominal of a Kinect, and what others use."""

T_COLOUR_DEPTH = se3(np.eye(3), np.array([-25.0, 0.0, 0.0]))
"""mm; nominal of a Kinect."""

_UNKNOWN = (0, 65535)
_MM_PER_METRE = 1000.0


class SevenScenesFolder(ImageFolder):
    """One 7-Scenes sequence, or a folder in its layout."""

    name = "7-scenes"

    def __init__(self, path: Path) -> None:
        super().__init__(path, [file for file in image_files(path) if file.stem.endswith(".color")])
        self._file_of = dict(zip(self.numbers, self.files, strict=True))
        if self.camera is None:
            with self._making_camera():
                self._use_camera()

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` holds `frame-*.color.*` and poses beside them."""
        return any(path.glob("frame-*.color.*")) and any(path.glob("frame-*.pose.txt"))

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose in the frame's file; None where tracking lost it (not finite) or there is no file."""
        T_world_camera = _read_pose(self._beside(index, ".pose.txt"))
        if T_world_camera is None or self.depth_sensor is None:
            return T_world_camera
        return T_world_camera @ inverse(self.depth_sensor.T_colour_depth)

    def _beside(self, index: int, ending: str) -> Path:
        return Path(self._file_of[index].as_posix().split(".color.")[0] + ending)

    def _depth_mm(self, index: int) -> np.ndarray | None:
        values = read_depth16(self._beside(index, ".depth.png"))
        if values is None:
            return None
        depth_mm = values * np.float32(self.depth_scale_mm or 1.0)
        return np.where(np.isin(values, _UNKNOWN), np.nan, depth_mm).astype(np.float32)

    def _use_camera(self) -> None:
        file = self.path / "camera-intrinsics.txt"
        stated = read_calibration(file, (self.width, self.height)).camera if file.is_file() else None
        if stated is None or stated == DEPTH_CAMERA.resized(self.width, self.height):
            self._check_aspect()
            self.camera = COLOUR_CAMERA.resized(self.width, self.height)
            self.camera_source = f"a Kinect's nominal colour camera{rescaled_note(COLOUR_CAMERA, self.camera)}"
            self.depth_sensor = DepthSensor(DEPTH_CAMERA, T_COLOUR_DEPTH)
            self.notes.append("depth and poses are the depth camera's: brought to the colour camera beside it")
        else:
            self.camera, self.camera_source = stated, "camera-intrinsics.txt"
            self.notes.append("camera-intrinsics.txt is not a Kinect's: depth is taken as registered to colour")

    def _check_aspect(self) -> None:
        if self.width * COLOUR_CAMERA.height != self.height * COLOUR_CAMERA.width:
            raise CalibrationError(
                f"the 7-Scenes intrinsics are for 640x480 px, but the images are {self.width}x{self.height} px: "
                "give a calibration (--camera)"
            )


def _read_pose(file: Path) -> np.ndarray | None:
    if not file.is_file():
        return None
    try:
        T_world_camera = np.array(file.read_text(encoding="utf-8").split(), dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise InputError(f"reading {file}: expected 4x4 numbers ({error})") from None
    if not np.isfinite(T_world_camera).all():
        return None
    T_world_camera[:3, 3] *= _MM_PER_METRE
    return rigid(T_world_camera[None], [str(file)])[0]
