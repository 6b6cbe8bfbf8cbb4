"""Calibration files: what is written reads back; usual forms of others; files that do not fit are refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.calibration import read_calibration, write_calibration
from scopemap.camera import CameraModel, PinholeCamera
from scopemap.errors import CalibrationError
from scopemap.lenses import FisheyeCamera, OmnidirectionalCamera, OpenCvCamera

PINHOLE = PinholeCamera(520.5, 525.25, 318.0, 245.0, 640, 480)
CAMERAS = [
    PINHOLE,
    OpenCvCamera(PINHOLE, (-0.3, 0.1, 1e-3, -5e-4, -0.01)),
    OpenCvCamera(PINHOLE, (0.6, -0.1, -3e-4, 2e-4, 0.02, 0.9, 0.05, 0.01)),
    FisheyeCamera(PINHOLE, (-0.13, -3e-4, 1.5e-3, -1e-4)),
    OmnidirectionalCamera((400.0, 0.0, -8e-4, 6e-7), 318.0, 245.0, 640, 480, (0.9999, 0.003, -0.003)),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: type(c).__name__)
def test_what_is_written_reads_back(camera: CameraModel, tmp_path: Path) -> None:
    write_calibration(camera, tmp_path / "camera.yaml", depth_scale_mm=0.005)
    found = read_calibration(tmp_path / "camera.yaml", (640, 480))
    assert found.camera == camera
    assert found.depth_scale_mm == 0.005
    assert found.source == "calibration file camera.yaml"


@pytest.mark.parametrize(
    "form", ["520.5 525.25 318 245", "520.5,525.25,318,245\n", "# mine\n520.5 525.25 318 245 0 0 0 0 0"]
)
def test_a_line_of_text_is_a_pinhole(form: str, tmp_path: Path) -> None:
    (tmp_path / "k.txt").write_text(form)
    found = read_calibration(tmp_path / "k.txt", (640, 480))
    assert found.camera == PINHOLE
    assert found.depth_scale_mm is None


def test_a_line_of_text_with_distortion(tmp_path: Path) -> None:
    (tmp_path / "k.txt").write_text("520.5 525.25 318 245 -0.3 0.1 0.001 -0.0005 -0.01")
    assert read_calibration(tmp_path / "k.txt", (640, 480)).camera == CAMERAS[1]


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
@pytest.mark.parametrize("names", [("K", "D"), ("M1", "D1"), ("camera_matrix", "distortion_coefficients")])
def test_files_by_opencv(suffix: str, names: tuple[str, str], tmp_path: Path) -> None:
    file = tmp_path / f"c.{suffix}"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write(names[0], PINHOLE.matrix)
    storage.write(names[1], np.array([[-0.3, 0.1, 1e-3, -5e-4, -0.01]]))
    storage.release()
    assert read_calibration(file, (640, 480)).camera == CAMERAS[1]


ROS = """image_width: 640
image_height: 480
camera_name: scope
camera_matrix:
  rows: 3
  cols: 3
  data: [520.5, 0., 318., 0., 525.25, 245., 0., 0., 1.]
distortion_model: equidistant
distortion_coefficients:
  rows: 1
  cols: 4
  data: [-0.13, -0.0003, 0.0015, -0.0001]
"""


@pytest.mark.parametrize("header", ["", "%YAML:1.0\n---\n"])
def test_a_ros_file(header: str, tmp_path: Path) -> None:
    (tmp_path / "ros.yaml").write_text(header + ROS)
    assert read_calibration(tmp_path / "ros.yaml", (640, 480)).camera == CAMERAS[3]


def test_a_calibration_of_the_same_aspect_is_rescaled_and_says_so(tmp_path: Path) -> None:
    write_calibration(PINHOLE, tmp_path / "camera.yaml")
    found = read_calibration(tmp_path / "camera.yaml", (320, 240))
    assert found.camera == PINHOLE.resized(320, 240)
    assert found.source.endswith("rescaled from 640x480 px")


def test_a_calibration_of_another_aspect_is_refused_with_both_sizes(tmp_path: Path) -> None:
    write_calibration(PINHOLE, tmp_path / "camera.yaml")
    with pytest.raises(CalibrationError, match=r"640x480 px.*images are 640x360 px"):
        read_calibration(tmp_path / "camera.yaml", (640, 360))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("52.0 52.0 318 245", "focal length"),
        ("5200 5200 318 245", "focal length"),
        ("1000 1000 960 540", "principal point"),
        ("1 2 3", "3 numbers"),
        ("", "0 numbers"),
        ("hello there", "neither"),
        ("%YAML:1.0\n---\na: 1\n", "no 3x3 camera matrix"),
        ("%YAML:1.0\n---\nK: [520, 0, 318, 0, 520, 245, 0, 0, 1]\nD: [0.1, 0.2]\n", "expected 4, 5 or 8"),
    ],
)
def test_calibrations_that_cannot_be_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "c.txt").write_text(text)
    with pytest.raises(CalibrationError, match=message):
        read_calibration(tmp_path / "c.txt", (640, 480))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"nowhere\.yaml"):
        read_calibration(tmp_path / "nowhere.yaml", (640, 480))
    with pytest.raises(CalibrationError, match="cannot write"):
        write_calibration(PINHOLE, tmp_path / "no folder" / "c.yaml")
