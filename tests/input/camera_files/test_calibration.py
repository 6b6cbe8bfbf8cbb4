"""Calibration files: what is written reads back; each form, with exact numbers; what the forms leave open."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, FovCamera, OmnidirectionalCamera, OpenCvCamera
from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files.calibration import Calibration
from scopemap.input.camera_files.lens_models import LENS_MODELS
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.camera_files.writing import write_calibration
from tests.support.drawn_calibrations import (
    CAMERAS,
    FISHEYE,
    OCAM,
    OCAM_AFFINE,
    OCAM_CENTRE,
    OCAM_POLYNOMIAL,
    ORB_SLAM3,
    PINHOLE,
    RADTAN,
    RADTAN5,
    ROS,
    SIZE,
    forms,
    kalibr,
)

FORMS = forms()


def read(folder: Path, content: str | bytes, size: tuple[int, int] = SIZE, fit: str = "exact") -> Calibration:
    file = folder / "any.thing"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_calibration(file, size, fit)


def assert_same(found: CameraModel, expected: CameraModel) -> None:
    """The same model with the same numbers, but for the last digit."""
    assert type(found) is type(expected)
    assert (found.width, found.height) == (expected.width, expected.height)
    np.testing.assert_allclose(found.central.matrix, expected.central.matrix, rtol=1e-14)
    for name in ("distortion", "omega", "polynomial", "stretch"):
        np.testing.assert_allclose(getattr(found, name, 0), getattr(expected, name, 0), rtol=1e-14)


# ---- what is written


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: type(c).__name__)
def test_what_is_written_is_read_back_and_by_opencv(camera: CameraModel, tmp_path: Path) -> None:
    write_calibration(camera, tmp_path / "camera.yaml")
    assert read_calibration(tmp_path / "camera.yaml", SIZE).camera == camera
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    plane = getattr(camera, "plane", camera.central)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), plane.matrix)


def test_each_lens_of_the_table_is_drawn() -> None:
    assert {lens.camera for lens in LENS_MODELS} <= {type(camera) for camera in CAMERAS}


NUMBER = st.floats(-1e6, 1e6)
CENTRAL = st.builds(
    lambda w, h, f, g, x, y: PinholeCamera(f * w, f * g * w, x * w, y * h, w, h),
    *(st.integers(8, 10_000), st.integers(8, 10_000), st.floats(0.35, 4.0), st.floats(0.5, 2.0)),
    *(st.floats(0, 0.99).filter(lambda x: x == 0 or x > 0.2), st.floats(0.2, 0.99)),
)


def lens_of(central: PinholeCamera, kind: int, numbers: list[float], small: float) -> CameraModel:
    match kind:
        case 0:
            return OpenCvCamera(central, tuple(numbers[:5])) if any(numbers[:5]) else central
        case 1:
            return OpenCvCamera(central, tuple(numbers)) if any(numbers) else central
        case 2:
            return FisheyeCamera(central, tuple(numbers[:4]))
        case 3:
            return FovCamera(central, 0.6 + abs(small))
        case _:
            size = (central.width, central.height)
            return OmnidirectionalCamera(
                (central.fx, 0.0, *numbers[:3]), central.cx, central.cy, *size, (1 + small, small, -small)
            )


@settings(max_examples=60, deadline=None)
@given(CENTRAL, st.integers(0, 4), st.lists(NUMBER, min_size=8, max_size=8), st.floats(-0.1, 0.1))
def test_any_camera_reads_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, central: PinholeCamera, kind: int, numbers: list[float], small: float
) -> None:
    camera = lens_of(central, kind, numbers, small)
    file = tmp_path_factory.mktemp("any") / "camera.yaml"
    write_calibration(camera, file, depth_scale_mm=0.005)
    found = read_calibration(file, (camera.width, camera.height))
    assert (found.camera, found.depth_scale_mm, found.source) == (camera, 0.005, "calibration file camera.yaml")


# ---- the forms


@pytest.mark.parametrize("form", FORMS)
def test_each_form(form: str, tmp_path: Path) -> None:
    content, expected = FORMS[form]
    found = read(tmp_path, content)
    assert_same(found.camera, expected)
    assert found.depth_scale_mm is None


def test_the_toolbox_of_scaramuzza_row_first_and_backwards(tmp_path: Path) -> None:
    """The toolbox' own way from a pixel to a ray, in its axes (down, right, back), against ours."""
    camera = read(tmp_path, OCAM).camera
    assert isinstance(camera, OmnidirectionalCamera)
    assert (camera.cx, camera.cy) == (OCAM_CENTRE[1], OCAM_CENTRE[0])
    c, d, e = OCAM_AFFINE
    for u, v in [(318.0, 245.0), (100.0, 200.0), (600.0, 30.0), (333.3, 470.1)]:
        down, right = np.linalg.solve([[c, d], [e, 1.0]], [v - OCAM_CENTRE[0], u - OCAM_CENTRE[1]])
        rho = np.hypot(down, right)
        back = np.polynomial.polynomial.polyval(rho, OCAM_POLYNOMIAL)
        ray = np.array([right, down, -back])
        np.testing.assert_allclose(camera.unproject(np.array([u, v])), ray / ray[2], rtol=1e-12, atol=1e-14)


def test_ros_images_of_a_region_in_blocks(tmp_path: Path) -> None:
    """A pixel of the binned image is the middle of its block in the region of the sensor."""
    text = ROS + "binning_x: 2\nbinning_y: 4\nroi: {x_offset: 40, y_offset: 20, width: 500, height: 400}\n"
    found = read(tmp_path, text, (250, 100))
    assert (found.camera.width, found.camera.height) == (250, 100)
    pixel = np.array([17.0, 60.0])
    on_sensor = np.array([40 + 2 * 17 + 0.5, 20 + 4 * 60 + 1.5])
    np.testing.assert_allclose(found.camera.unproject(pixel), FISHEYE.unproject(on_sensor), rtol=1e-12)
    assert "its region and binning of 640x480 px taken" in found.source
    with pytest.raises(CalibrationError, match="no part of 640x480 px"):
        read(tmp_path, ROS + "roi: {x_offset: 200, y_offset: 0, width: 500, height: 400}\n")
    with pytest.raises(CalibrationError, match="not the size of the sensor"):
        read(tmp_path, ROS.replace("image_width: 640\nimage_height: 480\n", "") + "binning_x: 2\n")


def test_coefficients_of_no_named_model_are_opencvs_and_zeros_matter_not(tmp_path: Path) -> None:
    matrix = "K: [520.5, 0, 318, 0, 525.25, 245, 0, 0, 1]\nimage_size: [640, 480]\n"
    four = f"{matrix}D: [-0.3, 0.1, 0.001, -0.0005]\n"
    assert read(tmp_path, four).camera == RADTAN
    for word in ("distortion_model: fisheye", "fisheye_model: 1", "fisheye: true", "camera_model: kannala-brandt"):
        assert isinstance(read(tmp_path, f"{four}{word}\n").camera, FisheyeCamera)
    assert read(tmp_path, f"{four}fisheye: 0\n").camera == RADTAN
    zeros = ", ".join(["0"] * 6)
    assert read(tmp_path, f"{matrix}D: [-0.3, 0.1, 1e-3, -5e-4, -0.01, 0, 0, 0, {zeros}]\n").camera == OpenCvCamera(
        PINHOLE, (*RADTAN5.distortion, 0.0, 0.0, 0.0)
    )
    assert read(tmp_path, f"{matrix}D: [{zeros}]\ndistortion_model: whatever\n").camera == PINHOLE


def test_bytes_that_are_no_text_do_not_matter_in_comments(tmp_path: Path) -> None:
    assert read(tmp_path, b"# endoscopio n\xba 1\n520.5 525.25 318 245").camera == PINHOLE
    assert read(tmp_path, b"\xef\xbb\xbf520.5 525.25 318 245").camera == PINHOLE


# ---- numbers as typed


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("520.5 525.25 318 245", PINHOLE),
        ("520.5, 525.25, 318, 245, -0.3, 0.1, 0.001, -0.0005", RADTAN),
        ("520.5,525.25,318,245,-0.3,0.1,1e-3,-5e-4,-0.01", RADTAN5),
    ],
)
def test_numbers_instead_of_a_file(typed: str, expected: CameraModel) -> None:
    for camera in (typed, Path(typed)):  # a command line makes a path of it
        found = read_calibration(camera, SIZE)
        assert found.camera == expected
        assert found.source == "camera of the numbers given (--camera)"
    cropped = read_calibration(typed, (400, 300), "crop:150,100").camera.central
    assert (cropped.cx, cropped.cy) == (168.0, 145.0)


def test_numbers_that_are_no_camera() -> None:
    with pytest.raises(CalibrationError, match=r"camera '520 525 318': it holds 3 numbers: expected fx fy cx cy"):
        read_calibration("520 525 318", SIZE)
    with pytest.raises(CalibrationError, match="520 525 318 wide: there is no such file"):
        read_calibration("520 525 318 wide", SIZE)


def test_a_file_whose_name_is_numbers_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("1 2 3 4").write_text("520.5 525.25 318 245")
    assert read_calibration("1 2 3 4", SIZE).camera == PINHOLE


# ---- what is refused


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5200 5200 318 245", "focal length"),
        ("1000 1000 960 540", "principal point"),
        (ORB_SLAM3 + "Camera1.p1: 0.1\n", "k1 k2 k3 k4 alone"),
        (ORB_SLAM3.replace('Camera.type: "KannalaBrandt8"\n', ""), "it has k4 but no p1, and names no model"),
        ("520 525 318 245\n1e999 0 0 0", "NaN or infinity"),
        ("", "0 numbers"),
        ("hello there", "none of the formats that are read"),
        ("K: [520, 0, 318, 0, 520, 245, 0, 0, 1]\nD: [0.1, 0.2]\n", "expected 4, 5 or 8"),
        ("K: {rows: 3, cols: 3, data: [1, 2]}\n", "K holds 2 numbers, but should be 3x3"),
        ("K: [520, 0, wide, 0, 520, 245, 0, 0, 1]\n", "K must be a finite number, found 'wide'"),
        ("K: [520, 0, 0, 0, 520, 9, 318, 245, 1]\n", "is no camera matrix"),
        ("K: [520, 9, 318, 0, 520, 245, 0, 0, 1]\n", "a skew of 9"),
        ("K: [0, 0, 0, 0, 0, 0, 0, 0, 0]\n", "not calibrated"),
        ("K: [520, 0, 318, 0, 520, 245, 0, 0, 1]\nimage_width: 640\n", "one of width and height"),
        ("K: [520, 0, 318, 0, 520, 245, 0, 0, 1]\nimage_size: [640.5, 480]\n", "640.5x480 px, which no image"),
        ("K: [520, 0, 318, 0, 520, 245, 0, 0, 1]\ndepth_scale: -1\n", "depth_scale"),
        ("K: [520, 0, 318, 0, 520, 245, 0, 0, 1]\nK: [1]\n", "'K' is there twice"),
        (f"K: [520, 0, 318, 0, 520, 245, 0, 0, 1]\nD: {[0.1] * 14}\n", "thin-prism"),
        ("K: [520, 0, 318, 0, 520, 245, 0, 0, 1]\nD: [1, 0, 0, 0]\nmodel: mei\n", "lens model 'mei'"),
        ("fx: 520\nfy: 520\ncx: 318\n", "it has no cy"),
        ('{"intrinsics": {"fx": true, "fy": 1, "cx": 0, "cy": 0}}', "fx must be a finite number, found 'True'"),
        ("520 0 318\n0 520 245\n0 9 1\n", "is no camera matrix"),
        ("<opencv_storage><K>1 2 3</K></opencv_storage>", "no 3x3 camera matrix"),
        ("<opencv_storage><K>1 2 3</opencv_storage>", "it is no XML"),
        (kalibr("radtan", (0.1, 0.2)), "expected 4, 5 or 8 numbers, got 2"),
        (
            kalibr("radtan", RADTAN.distortion).replace("pinhole", "omni"),
            "lens model 'omni radtan' has no counterpart",
        ),
        (kalibr("fov", (4.0,)), "between 0 and pi"),
        ("1 PINHOLE 640 480 520 520 318", "found 3 parameters where the model PINHOLE has 4"),
        ("1 THIN_PRISM_FISHEYE 640 480 1 2 3 4 5 6 7 8 9 1 2 3", "of the model THIN_PRISM_FISHEYE, which is not read"),
        ("1 PINHOLE 640 480 520 520 318 245\n2 PINHOLE 640 480 520 520 318 245", "holds 2 cameras"),
        (OCAM.replace("4 -400.0", "4 400.0"), "its polynomial begins with 400"),
        (OCAM.replace("480 640", "0 640"), "640x0 px, which no image has"),
    ],
)
def test_calibrations_that_cannot_be_are_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=message) as caught:
        read(tmp_path, text)
    assert "any.thing" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_lens_that_the_format_does_not_know_is_refused(tmp_path: Path) -> None:
    class Unknown:
        width, height, central = 640, 480, PINHOLE

    with pytest.raises(CalibrationError, match="Unknown is no lens that the format knows"):
        write_calibration(Unknown(), tmp_path / "c.yaml")
    assert not (tmp_path / "c.yaml").exists()


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"nowhere\.yaml: there is no such file"):
        read_calibration(tmp_path / "nowhere.yaml", (640, 480))
    with pytest.raises(CalibrationError, match="it is no file"):
        read_calibration(tmp_path, (640, 480))
    with pytest.raises(CalibrationError, match="cannot write"):
        write_calibration(PINHOLE, tmp_path / "no folder" / "c.yaml")
