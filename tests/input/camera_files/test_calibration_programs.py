"""Calibrations as other programs arrange them: the right lens and size, or a sentence that names the program."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files.reading import read_calibration

SIZE = (1440, 1080)
K = [[726.8, 0.0, 742.7], [0.0, 727.8, 542.1], [0.0, 0.0, 1.0]]
FOUR = [-0.1289, -0.00605, 0.00166, -0.000078]
FISHEYE = FisheyeCamera(PinholeCamera(726.8, 727.8, 742.7, 542.1, *SIZE), tuple(FOUR))
COLUMN = [[value] for value in FOUR]


def read(folder: Path, content: Any, size: tuple[int, int] = SIZE) -> Any:
    file = folder / "a.calibration"
    if not isinstance(content, str | bytes):
        content = json.dumps(content)
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_calibration(file, size).camera


def refusal(folder: Path, content: Any, size: tuple[int, int] = SIZE) -> str:
    with pytest.raises(CalibrationError) as caught:
        read(folder, content, size)
    message = str(caught.value)
    assert not any(words in message for words in ("object at", "<scopemap", "Fields", "expected <", "while parsing"))
    return message


def npz(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


# ---- fisheyes


@pytest.mark.parametrize(
    "content",
    [
        npz(K=np.array(K), D=np.array(COLUMN), DIM=np.array(SIZE)),
        {"K": K, "D": COLUMN, "DIM": list(SIZE)},
        {"K": K, "D": FOUR, "DIM": list(SIZE), "model": "fisheye"},
        {
            "lens_model": "wide",
            "calib_dimension": {"w": 1440, "h": 1080},
            "fisheye_params": {"camera_matrix": K, "distortion_coeffs": FOUR},
        },
        "cameras:\n - {T_SC: [1, 0, 0, 0], image_dimension: [1440, 1080], distortion_type: equidistant,\n"
        f"    distortion_coefficients: {FOUR}, focal_length: [726.8, 727.8], principal_point: [742.7, 542.1]}}\n",
    ],
    ids=["npz", "json", "stated", "gyroflow", "okvis"],
)
def test_fisheyes_are_told_by_shape_and_names(content: Any, tmp_path: Path) -> None:
    assert read(tmp_path, content) == FISHEYE


def test_a_stated_model_is_stronger_than_a_column(tmp_path: Path) -> None:
    assert isinstance(read(tmp_path, {"K": K, "D": COLUMN, "DIM": list(SIZE), "model": "opencv"}), OpenCvCamera)


def test_the_size_of_a_fisheye_is_not_ignored(tmp_path: Path) -> None:
    assert "is for 1440x1080 px" in refusal(
        tmp_path, npz(K=np.array(K), D=np.array(COLUMN), DIM=np.array(SIZE)), (720, 540)
    )


@pytest.mark.parametrize(
    "content",
    [
        {"K": K, "D": FOUR, "DIM": list(SIZE)},
        f"%YAML:1.0\nK: {np.ravel(K).tolist()}\nD: !!opencv-matrix\n  rows: 4\n  cols: 1\n  dt: d\n  data: {FOUR}\n",
    ],
)
def test_four_coefficients_of_no_model_are_refused_with_both_options(content: Any, tmp_path: Path) -> None:
    message = refusal(tmp_path, content)
    assert "`model: opencv`" in message
    assert "`model: fisheye`" in message


# ---- other arrangements


def test_endovis_names_the_left_camera_by_letters(tmp_path: Path) -> None:
    text = (
        "Camera-0-F: 1084.21 1084.05   // left camera x,y focal dist in pixels\n"
        "Camera-0-C: 580.02 506.79     // left camera x,y center in pixels\n"
        "Camera-0-K: -0.1 0.02 0.001 0.002 0.003\n"
        "Camera-1-F: 1 1\nCamera-1-C: 2 2\nCamera-1-K: 0 0 0 0 0\n"
        "Extrinsic-T: -4.2 0.0 0.0\nWidth: 1280\nHeight: 1024\n"
    )
    found = read(tmp_path, text, (1280, 1024))
    assert found == OpenCvCamera(
        PinholeCamera(1084.21, 1084.05, 580.02, 506.79, 1280, 1024), (-0.1, 0.02, 0.001, 0.002, 0.003)
    )


@pytest.mark.parametrize("lens", [[], [-0.4, 0.1, 3e-4, -2e-4], [-0.4, 0.1, 3e-4, -2e-4, 0.01]])
def test_a_list_called_calibration(lens: list[float], tmp_path: Path) -> None:
    text = f"width: 1440\nheight: 1080\ncalibration: {[726.8, 727.8, 742.7, 542.1, *lens]}\n"
    plane = PinholeCamera(726.8, 727.8, 742.7, 542.1, *SIZE)
    assert read(tmp_path, text) == (OpenCvCamera(plane, tuple(lens)) if lens else plane)


def opensfm(kind: str, **values: float | str) -> dict[str, Any]:
    return {"v2 x": {"projection_type": kind, "width": 1350, "height": 1080, **values}}


def test_opensfm_counts_in_shares_of_the_longer_side_from_the_middle(tmp_path: Path) -> None:
    lens = {"k1": -0.13, "k2": -0.006, "k3": 0.0017, "k4": -0.0001}
    content = opensfm("fisheye_opencv", focal_x=0.569, focal_y=0.5688, c_x=0.12, c_y=0.11, **lens)
    found = read(tmp_path, content, (1350, 1080))
    assert isinstance(found, FisheyeCamera)
    assert found.distortion == tuple(lens.values())
    plane = found.plane
    assert [plane.fx, plane.fy, plane.cx, plane.cy] == pytest.approx([768.15, 767.88, 836.5, 688.0])
    brown = {"k1": -0.1, "k2": 0.02, "k3": 0.003, "p1": 1e-3, "p2": 2e-3}
    found = read(tmp_path, opensfm("brown", focal_x=0.6, focal_y=0.6, c_x=0.0, c_y=0.0, **brown), (1350, 1080))
    assert found.distortion == (-0.1, 0.02, 1e-3, 2e-3, 0.003)
    assert read(tmp_path, opensfm("perspective", focal=0.6, k1=0.0, k2=0.0), (1350, 1080)).central.fx == 810
    assert "'dual'" in refusal(tmp_path, opensfm("dual", focal=0.6), (1350, 1080))
    assert "k1 must be a finite number" in refusal(tmp_path, opensfm("perspective", focal=0.6, k1=""), (1350, 1080))


def meshroom(**values: Any) -> dict[str, Any]:
    intrinsic = {
        **{"width": "1350", "height": "1080", "sensorWidth": "4.8", "focalLength": "2.8527", "pixelRatio": "1"},
        **{"type": "radial3", "principalPoint": ["12.5", "8.25"], "distortionParams": ["-0.42", "0.106", "0.01"]},
    }
    return {"version": ["1", "2", "6"], "intrinsics": [intrinsic | values], "poses": []}


def test_meshroom_counts_in_mm_of_the_sensor(tmp_path: Path) -> None:
    found = read(tmp_path, meshroom(), (1350, 1080))
    assert found.distortion == (-0.42, 0.106, 0.0, 0.0, 0.01)
    assert found.plane.fx == pytest.approx(2.8527 * 1350 / 4.8)
    assert (found.plane.cx, found.plane.cy) == (674.5 + 12.5, 539.5 + 8.25)
    fisheye = read(tmp_path, meshroom(type="fisheye4", distortionParams=list(map(str, FOUR))), (1350, 1080))
    assert isinstance(fisheye, FisheyeCamera)
    assert fisheye.distortion == tuple(FOUR)
    assert "'3deanamorphic4'" in refusal(tmp_path, meshroom(type="3deanamorphic4"), (1350, 1080))
    newer = meshroom(type="pinhole", distortionType="radialk3", distortionParams=["0.1", "0.05", "-0.001"])
    assert read(tmp_path, newer, (1350, 1080)).distortion == (0.1, 0.05, 0.0, 0.0, -0.001)
    assert "has 0 coefficients (none), found 3" in refusal(tmp_path, meshroom(type="pinhole"), (1350, 1080))
    assert "'equidistant'" in refusal(tmp_path, meshroom(type="equidistant"), (1350, 1080))
    assert "pixelRatio" in refusal(tmp_path, meshroom(pixelRatio="1.2"), (1350, 1080))
    both = meshroom()
    both["intrinsics"] *= 2
    assert "2 cameras" in refusal(tmp_path, both, (1350, 1080))


def test_gyroflow_states_its_lens(tmp_path: Path) -> None:
    profile = {"calib_dimension": {"w": 1440, "h": 1080}}
    profile |= {"fisheye_params": {"camera_matrix": K, "distortion_coeffs": FOUR}}
    assert isinstance(read(tmp_path, {**profile, "distortion_model": "opencv_standard"}), OpenCvCamera)
    assert "'poly5'" in refusal(tmp_path, {**profile, "distortion_model": "poly5"})
    assert "stretched" in refusal(tmp_path, {**profile, "input_horizontal_stretch": 1.33})
    assert read(tmp_path, {**profile, "input_horizontal_stretch": 0.0}) == FISHEYE  # not set


def test_a_pose_beside_a_camera_is_no_distortion(tmp_path: Path) -> None:
    pose = {f"t_{row}{column}": float(row == column) for row in range(3) for column in range(4)}
    content = {"fx": 726.8, "fy": 727.8, "cx": 742.7, "cy": 542.1, "width": 1440, "height": 1080, **pose}
    assert read(tmp_path, content) == FISHEYE.plane


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_text_of_two_bytes_a_letter(encoding: str, tmp_path: Path) -> None:
    mark = {"utf-16": b"", "utf-16-le": b"\xff\xfe", "utf-16-be": b"\xfe\xff"}[encoding]
    assert read(tmp_path, mark + "726.8 727.8 742.7 542.1\r\n".encode(encoding)) == FISHEYE.plane


# ---- sentences


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("726,8 727,8 742,7 542,1\n", "decimal commas (726,8)"),
        ("726,8 0 742,7\n0 727,8 542,1\n0 0 1\n", "decimal commas (726,8)"),
        ('{"fx": "726,8", "fy": 727.8, "cx": 742.7, "cy": 542.1}', "fx has a decimal comma (726,8)"),
        ("fx: 726,8\nfy: 727,8\ncx: 742,7\ncy: 542,1\n", "decimal commas"),
        ('{"fx": 726,8, "fy": 727,8, "cx": 742,7, "cy": 542,1}', "decimal commas"),
        ("K: [ 726,8, 0, 742,7, 0, 727,8, 542,1, 0, 0, 1 ]\n", "decimal commas"),
        ("# oST version 5.0 parameters\n\n[image]\n\nwidth\n1440\n", "ROS' ost.txt; the ost.yaml"),
        ("ParGroup: Cam_Par: Internal camera parameters;\n  Cx:desc: 742.7;\n", "HALCON's"),
        ('{"fx": {"a": 1}, "fy": ', "line 1, column"),
        ("fx: [1, 2\nfy: {", "line "),
        ("<a><b></a>", "line 1"),
        ("%-- Focal length:\nfc = [ 657.39 ; 657.76 ];\n", "Bouguet"),
        ("cam0 (/left):\n\tprojection: [ 460.1 459.0 365.4 249.3] +- [ 0.4 0.4 0.3 0.3]\n", "Kalibr's report"),
        (
            '{"sfm_data_version": "0.3", "intrinsics": [{"key": 0, "value": {"polymorphic_name": "pinhole"}}]}',
            "OpenMVG",
        ),
        ("#Pix4D camera calibration file\nFOCAL 4.49\nXPOINT 0.01\n", "Pix4D"),
        ('[{"id": 0, "img_name": "0001", "width": 1440, "height": 1080, "fx": 726.8}]', "Gaussian splatting"),
        ("K = array([[726.8, 0, 742.7], [0, 727.8, 542.1], [0, 0, 1]])\n", "numpy.savez"),
        ({"intrinsics": [{"a": 1}, {"b": 2}], "fx": 3}, ""),
    ],
)
def test_what_is_not_read_is_named(content: Any, said: str, tmp_path: Path) -> None:
    assert said in refusal(tmp_path, content)


# ---- plausible


def test_short_focal_lengths_are_a_fisheyes_not_a_pinholes(tmp_path: Path) -> None:
    capsule = read(tmp_path, "74.2 74.2 128 128 -0.3 0.1 0 0", (256, 256))
    assert capsule.central.fx == 74.2
    wide = {"fx": 55.0, "fy": 55.0, "cx": 128.0, "cy": 128.0}
    assert "plausible" in refusal(tmp_path, wide, (256, 256))
    fisheye = read(tmp_path, {**wide, "model": "fisheye", "D": FOUR}, (256, 256))
    assert isinstance(fisheye, FisheyeCamera)


@pytest.mark.parametrize("size", [(800, 800), (320, 240), (1350, 1080)])
def test_the_middle_of_other_pictures_is_no_principal_point(size: tuple[int, int], tmp_path: Path) -> None:
    text = f"fx: {size[0]}\nfy: {size[0]}\ncx: 319.5\ncy: 239.5\n"
    assert "the middle of 640x480 px" in refusal(tmp_path, text, size)
    stated = f"{text}image_width: {size[0]}\nimage_height: {size[1]}\n"
    if size[0] > 320:
        assert read(tmp_path, stated, size).cx == 319.5


@pytest.mark.parametrize("centre", ["320 240", "319.5 239.5", "360 240", "512 384"])
def test_an_exact_middle_of_other_pictures_is_none_however_near(centre: str, tmp_path: Path) -> None:
    assert "the middle of " in refusal(tmp_path, f"600 600 {centre}", (720, 576))
    off = " ".join(str(float(number) + 0.3) for number in centre.split())
    if float(centre.split()[0]) < 400:  # a calibrated centre as near may be these pictures' own
        assert read(tmp_path, f"600 600 {off}", (720, 576)).fx == 600
    assert read(tmp_path, "600 600 360 288", (720, 576)).cx == 360


def _metashape(*sensors: str) -> str:
    inner = "".join(f"<sensor>{one}</sensor>" for one in sensors)
    return f"<document><chunk><sensors>{inner}</sensors></chunk></document>"


def _sensor(focal: float, kind: str = "adjusted") -> str:
    inner = f'<resolution width="1440" height="1080"/><f>{focal}</f><cx>3</cx><cy>-2</cy>'
    return f'<calibration type="frame" class="{kind}">{inner}</calibration>'


def test_metashapes_adjusted_camera_is_taken_and_of_two_sensors_none(tmp_path: Path) -> None:
    both = _metashape(_sensor(1500.0, "initial") + _sensor(726.8), "")
    assert read(tmp_path, both).fx == 726.8
    assert "holds 2 cameras" in refusal(tmp_path, _metashape(_sensor(1500.0), _sensor(726.8)))


def test_intrinsics_of_each_frame_beside_a_camera_are_no_distortion(tmp_path: Path) -> None:
    K = [726.8, 0, 0, 0, 727.8, 0, 742.7, 542.1, 1]
    record3d = {"w": 1440, "h": 1080, "K": K, "perFrameIntrinsicCoeffs": [[726.8, 727.8, 742.7, 542.1]]}
    assert read(tmp_path, record3d).cy == 542.1
