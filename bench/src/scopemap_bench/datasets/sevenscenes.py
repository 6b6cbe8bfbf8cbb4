"""7-Scenes: RGB-D sequences of rooms (Shotton et al., CVPR 2013), for odometry and fusion with measured depth.

`frame-NNNNNN.color.png`, `.depth.png` (uint16 mm, 65535 = unknown), `.pose.txt` (4x4 camera-to-world, metres), optional
`camera-intrinsics.txt` (3x3). Colour and depth come from two cameras of a Kinect, not registered in the files; poses
and published intrinsics are the depth camera's. Here the camera is that of the colour images, by a Kinect's nominal
focal length and distance from the depth camera, and depth and poses are brought to it.
"""

from __future__ import annotations

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import DepthSensor
from scopemap.engine.errors import CalibrationError
from scopemap.engine.geometry.se3 import inverse, se3
from scopemap.input.camera_files.reading import read_calibration
from scopemap_bench.datasets.layouts import LayoutFolder, Place
from scopemap_bench.trajectories.text import read_seven_scenes_pose

DEPTH_CAMERA = PinholeCamera(585.0, 585.0, 320.0, 240.0, 640, 480)
"""As published."""

COLOUR_CAMERA = PinholeCamera(525.0, 525.0, 320.0, 240.0, 640, 480)
"""Not published; nominal of a Kinect, and what others use."""

T_COLOUR_DEPTH = se3(np.eye(3), np.array([-25.0, 0.0, 0.0]))
"""mm; nominal of a Kinect."""


class SevenScenesFolder(LayoutFolder):
    """One 7-Scenes sequence, or a folder in its layout."""

    name = "7-scenes"
    places = (Place("", "frame-*.color", ("frame-{}.depth.png",)),)
    needs = (("frame-*.pose.txt",),)
    depth_code = ((16, 1.0, 65534),)

    def pose(self, index: int) -> np.ndarray | None:
        """Return the pose in the frame's file; None where tracking lost it (not finite) or there is no file."""
        picture = self.file_of.get(index)
        file = None if picture is None else picture.with_name(f"{picture.stem.removesuffix('.color')}.pose.txt")
        T_world_camera = None if file is None or not file.is_file() else read_seven_scenes_pose(file)
        if T_world_camera is None or self.depth_sensor is None:
            return T_world_camera
        return T_world_camera @ inverse(self.depth_sensor.T_colour_depth)

    def _use_intrinsics(self) -> None:
        file = self.path / "camera-intrinsics.txt"
        stated = read_calibration(file, (self.width, self.height)).camera if file.is_file() else None
        if stated is not None and stated != DEPTH_CAMERA.resized(self.width, self.height):
            self.camera, self.camera_source = stated, "camera-intrinsics.txt"
            self.notes.append("camera-intrinsics.txt is not a Kinect's: depth is taken as registered to colour")
            return
        if self.width * COLOUR_CAMERA.height != self.height * COLOUR_CAMERA.width:
            size = f"the images are {self.width}x{self.height} px: give a calibration (--camera)"
            raise CalibrationError(f"the 7-Scenes intrinsics are for 640x480 px, but {size}")
        self._set_camera(COLOUR_CAMERA, "a Kinect's nominal colour camera", "of a Kinect")
        self.depth_sensor = DepthSensor(DEPTH_CAMERA, T_COLOUR_DEPTH)
        self.notes.append("depth and poses are the depth camera's: brought to the colour camera beside it")
