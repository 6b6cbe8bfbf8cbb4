"""Calibration files as people and their tools spell them: nothing that a file says of its lens or size is lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import InputSettings
from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files.calibration import Calibration
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.opening import open_sequence
from tests.support.drawn_bags import IMAGE, Bag
from tests.support.drawn_bags import SIZE as BAG_SIZE
from tests.support.drawn_calibrations import ORB_SLAM, PINHOLE, RADTAN, RADTAN5, SIZE, kalibr
from tests.support.drawn_inputs import picture

K = [[520.5, 0.0, 318.0], [0.0, 525.25, 245.0], [0.0, 0.0, 1.0]]
FX = {"fx": 520.5, "fy": 525.25, "cx": 318.0, "cy": 245.0}
FIVE, FOUR = list(RADTAN5.distortion), list(RADTAN.distortion)
NAMED = {"k1": -0.3, "k2": 0.1, "p1": 1e-3, "p2": -5e-4}
MATRIX = "K: [520.5, 0, 318, 0, 525.25, 245, 0, 0, 1]\n"


def read(folder: Path, content: str | bytes | dict[str, Any], size: tuple[int, int] = SIZE) -> Calibration:
    file = folder / "any.thing"
    content = json.dumps(content) if isinstance(content, dict) else content
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_calibration(file, size)


# ---- the lens


@pytest.mark.parametrize("beside", [{"camera_matrix": K}, FX, {"intrinsics": FX}], ids=["matrix", "names", "inner"])
@pytest.mark.parametrize(
    "name",
    [
        *("dist_coeff", "dist_coeffs", "distCoeff", "distortion", "Distortion", "distortion_coeffs", "dist_coefs"),
        *("distortionCoefficients", "distortion_parameters", "distortion_coefficients", "D", "DIST-COEFFS"),
    ],
)
def test_coefficients_in_a_list_by_any_name(name: str, beside: dict[str, Any], tmp_path: Path) -> None:
    assert read(tmp_path, {**beside, name: [FIVE]}).camera == RADTAN5


@pytest.mark.parametrize(
    "content",
    [
        {"K": K, **NAMED},
        {"K": K, "RadialDistortion": [-0.3, 0.1], "TangentialDistortion": [1e-3, -5e-4]},
        {"K": K, "distortion": NAMED},
        {"intrinsics": FX, "distortion": NAMED},
        {"intrinsics": {**FX, "coeffs": FOUR}},
        {"intrinsics": {**FX, **NAMED}},
        {**FX, "lens_distortion": {"model": "brown conrady", "coefficients": FOUR}},
        {**FX, "D": [0, 0, 0, 0], **NAMED},
    ],
)
def test_coefficients_in_any_form(content: dict[str, Any], tmp_path: Path) -> None:
    assert read(tmp_path, content).camera == RADTAN


@pytest.mark.parametrize(
    ("name", "value"),
    [("my_distortion", FOUR), ("undone_coefs", [0.1]), ("radial", {"a": 0.1}), ("lens", NAMED), ("dist", 0.2)],
)
def test_what_looks_like_coefficients_but_is_not_read_is_refused_by_name(name: str, value: Any, tmp_path: Path) -> None:
    for beside in ({"K": K}, FX):
        with pytest.raises(CalibrationError, match=f"'{name}' in it looks like distortion but is not read"):
            read(tmp_path, {**beside, name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("working_distance_mm", 50), ("distortion_model", "plumb_bob"), ("NumRadialDistortionCoefficients", 2)),
        *(("distortion_coefficients_right", FOUR), ("undistort_alpha", 0.5), ("distortion_coeffs_std", FOUR)),
        *(("my_distortion", [0, 0]), ("distortion", "see below")),
    ],
)
def test_what_is_no_lens_of_the_camera_is_left_alone(name: str, value: Any, tmp_path: Path) -> None:
    assert read(tmp_path, {"K": K, name: value}).camera == PINHOLE


def test_the_scale_of_depth_is_read_in_every_form(tmp_path: Path) -> None:
    assert read(tmp_path, {"intrinsics": FX, "depth_scale": 0.5}).depth_scale_mm == 0.5
    assert read(tmp_path, ORB_SLAM + "depth_scale: 0.5\n").depth_scale_mm == 0.5
    assert read(tmp_path, kalibr("radtan", RADTAN.distortion, "  depth_scale: 0.5\n")).depth_scale_mm == 0.5


@pytest.mark.parametrize(
    "words",
    [
        *("brown_conrady", "Brown-Conrady", "plumb bob", "radial tangential", "rational polynomial", "FULL_OPENCV"),
        *("SIMPLE_RADIAL", "pinhole_radtan", "radtan8", "standard", "distortion.brown_conrady", "Olympus CF-H190"),
    ],
)
@pytest.mark.parametrize("name", ["model", "camera_model", "type"])
def test_words_for_opencvs_lens(name: str, words: str, tmp_path: Path) -> None:
    found = read(tmp_path, {"K": K, name: words, "D": FIVE})
    assert found.camera == RADTAN5
    # The endoscope's name is no lens.
    assert ("its lens taken as OpenCV's ('olympus cf h190' names none)" in found.source) == ("Olympus" in words)


@pytest.mark.parametrize("words", ["omni", "ds", "Double_Sphere", "EUCM", "MEI", "thin-prism", "DIVISION", "inverse"])
def test_other_lenses_are_refused(words: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="has no counterpart here"):
        read(tmp_path, {"K": K, "model": words, "D": FIVE})


# ---- the size


@pytest.mark.parametrize(
    "sides",
    [
        {"imageWidth": 640, "imageHeight": 480},
        {"image_size": {"width": 640, "height": 480}},
        {"resolution": {"w": 640, "h": 480}},
        {"img_width": 640, "img_height": 480},
        {"ImageSize": [640, 480]},
        {"cols": 9, "rows": 6, "image_width": 640, "image_height": 480},
    ],
)
def test_a_size_that_is_spelled_otherwise_holds(sides: dict[str, Any], tmp_path: Path) -> None:
    assert read(tmp_path, {"K": K, **sides}).camera == PINHOLE
    with pytest.raises(CalibrationError, match=r"is for 640x480 px, but the images are 1280x960 px"):
        read(tmp_path, {**FX, **sides}, (1280, 960))


@pytest.mark.parametrize("name", ["imageSize", "image_size", "resolution", "image_shape"])
def test_height_before_width_is_turned_and_it_is_said(name: str, tmp_path: Path) -> None:
    found = read(tmp_path, {"K": K, name: [480, 640]})
    assert found.camera == PINHOLE
    assert "its size 480, 640 taken as height, width" in found.source


# ---- the matrix


@pytest.mark.parametrize(
    "content",
    [
        {"width": 640, "height": 480, "intrinsic_matrix": np.transpose(K).ravel().tolist()},
        "520.5 0 0\n0 525.25 0\n318 245 1\n",
        "520.5 0 0 0 525.25 0 318 245 1",
    ],
)
def test_a_transposed_matrix_is_turned_and_it_is_said(content: str | dict[str, Any], tmp_path: Path) -> None:
    found = read(tmp_path, content)
    assert found.camera == PINHOLE
    assert "its matrix transposed" in found.source


def test_a_small_skew_is_left_out_and_it_is_said(tmp_path: Path) -> None:
    found = read(tmp_path, MATRIX.replace("520.5, 0,", "520.5, 1.2,"))
    assert found.camera == PINHOLE
    assert "its skew of 1.2 px left out" in found.source
    (tmp_path / "K.txt").write_text("520.5 1.2 318 0 525.25 245 0 0 1")
    assert read_calibration(tmp_path / "K.txt", SIZE).camera == PINHOLE


# ---- the text


def test_a_name_that_comes_twice_matters_only_where_it_is_used(tmp_path: Path) -> None:
    assert read(tmp_path, ORB_SLAM + "Camera.fps: 25.0\n").camera == RADTAN5
    assert read(tmp_path, "fx: 520.5\nfy: 525.25\ncx: 318\ncy: 245\nnote: 1\nnote: 2\n").camera == PINHOLE
    for repeated in ("Camera.fx: 1\n", "Camera.k1: 0.2\n", "Camera.width: 3\n", "Camera.type: x\n"):
        with pytest.raises(CalibrationError, match="is there twice"):
            read(tmp_path, ORB_SLAM + repeated)
    with pytest.raises(CalibrationError, match="is there twice"):
        read(tmp_path, "fx: 520.5\nfx: 525.25\nfy: 5\ncx: 318\ncy: 245\n")
    with pytest.raises(CalibrationError, match="'data' is there twice"):
        read(tmp_path, f"{MATRIX}D: {{data: {FOUR}, data: {FOUR}}}\n")
    with pytest.raises(CalibrationError, match="'cam0' is there twice"):
        read(tmp_path, kalibr("radtan", RADTAN.distortion) * 2)


def test_an_alias_is_read(tmp_path: Path) -> None:
    assert read(tmp_path, f"resolution: &id001 [640, 480]\nimage_size: *id001\n{MATRIX}D: {FIVE}\n").camera == RADTAN5
    assert read(tmp_path, "M: &k {data: [520.5, 0, 318, 0, 525.25, 245, 0, 0, 1]}\nK: *k\n").camera == PINHOLE


# ---- other programs


def test_camodocals_parameters(tmp_path: Path) -> None:
    lens = "".join(f"   {name}: {value}\n" for name, value in NAMED.items())
    pinhole = "".join(f"   {name}: {value}\n" for name, value in FX.items())
    text = (
        "%YAML:1.0\n---\nmodel_type: PINHOLE\ncamera_name: camera\nimage_width: 640\nimage_height: 480\n"
        f"distortion_parameters:\n{lens}projection_parameters:\n{pinhole}"
    )
    assert read(tmp_path, text).camera == RADTAN
    with pytest.raises(CalibrationError, match="no counterpart"):
        read(tmp_path, text.replace("PINHOLE", "MEI"))


def test_nerfstudios_pixels_count_from_the_corner(tmp_path: Path) -> None:
    content = {"camera_model": "OPENCV", "fl_x": 520.5, "fl_y": 525.25, "cx": 318.5, "cy": 245.5, "w": 640, "h": 480}
    found = read(tmp_path, {**content, **NAMED})
    assert found.camera == RADTAN
    assert "from the corner" in found.source


# ---- ROS bags, and words that have no effect


def bag(folder: Path, **info: Any) -> Path:
    recording = Bag()
    recording.info(**info)
    for number in range(2):
        recording.image(IMAGE, number, picture(number, BAG_SIZE), "rgb8")
    return recording.write_bag1(folder / "a.bag")


def test_a_bags_camera_of_another_size_obeys_camera_fit(tmp_path: Path) -> None:
    width, height = BAG_SIZE
    file = bag(tmp_path, width=2 * width, height=2 * height, k=np.array([120.0, 0, 62.5, 0, 122, 48.5, 0, 0, 1]))
    with pytest.raises(CalibrationError, match=rf"is for {2 * width}x{2 * height} px.*--camera-fit scale"):
        open_sequence(file)
    scaled = open_sequence(file, settings=InputSettings(camera_fit="scale"))
    assert scaled.rectifier.source == PinholeCamera(60.0, 61.0, 31.0, 24.0, *BAG_SIZE)
    assert f"rescaled from {2 * width}x{2 * height} px" in scaled.camera_source
    cut = open_sequence(file, settings=InputSettings(camera_fit="crop:30,20"))
    assert cut.rectifier.source == PinholeCamera(120.0, 122.0, 32.5, 28.5, *BAG_SIZE)
