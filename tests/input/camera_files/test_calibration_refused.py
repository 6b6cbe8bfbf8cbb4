"""What a calibration says is used or refused by its name: coefficients, sizes, lenses; and values that cannot be."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import CalibrationError
from scopemap.input.camera_files.reading import read_calibration
from tests.input.camera_files.test_calibration_sources import (
    ATAN,
    BROWN,
    BROWN3,
    CX,
    CY,
    FX,
    FY,
    INTRINSICS,
    KB,
    METASHAPE,
    NAMED,
    SIZE,
    Content,
    at,
    basalt,
    dso,
    mat,
    npy,
    npz,
    numbered,
)

K = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]
K_NINE = [value for row in K for value in row]
K_TEXT = f"{FX} 0 {CX}\n0 {FY} {CY}\n0 0 1\n"


def refusal(folder: Path, content: Content, size: tuple[int, int] = SIZE) -> str:
    with pytest.raises(CalibrationError) as caught:
        read_calibration(at(folder, content), size)
    message = str(caught.value)
    assert "any.thing" in message
    assert "\n" not in message
    return message


def written(form: str, values: dict[str, Any]) -> Content:
    """The same names and values as a file of each form."""
    lines = [(name, " ".join(map(str, value)) if isinstance(value, list) else value) for name, value in values.items()]
    match form:
        case "json":
            return values
        case "yaml":
            return "%YAML:1.0\n---\n" + "".join(f"{name}: {value}\n" for name, value in values.items())
        case "orb-slam":
            return "%YAML:1.0\n---\n" + "".join(f"Camera.{name}: {value}\n" for name, value in values.items())
        case "lines":
            return "".join(f"{name} = {value}\n" for name, value in lines)
        case "ini":
            return "[camera]\n" + "".join(f"{name}={value}\n" for name, value in lines)
        case _:
            inner = "".join(f"<{name}>{value}</{name}>" for name, value in lines)
            return f"<?xml version='1.0'?>\n<opencv_storage>{inner}</opencv_storage>"


FORMS = ("json", "yaml", "orb-slam", "lines", "ini", "xml")


# ---- coefficients

STRAY: list[tuple[dict[str, Any], str]] = [
    ({"model": "fisheye", **numbered("k", 1, KB), "k5": 0.1}, "k5"),
    ({"model": "fisheye", **numbered("k", 0, KB), "k4": 0.1}, "k4"),
    ({"model": "fisheye", **numbered("k", 1, KB), "p1": 0.1}, "p1"),
    ({"model": "fisheye", **numbered("k", 0, KB), "p0": 0.1}, "p0"),
    ({"k1": -0.3, "k2": 0.1, "p1": 1e-3, "p2": 0, "k3": 0, "k4": 0, "k5": 0, "k6": 0, "k7": 0.1}, "k7"),
    ({"k1": -0.3, "k2": 0.1, "p1": 1e-3, "p2": 0, "p3": 0.1}, "p3"),
    ({"k1": -0.3, "k2": 0.1, "k3": 0.01, "k4": 0.02, "p1": 1e-3, "p2": 0}, "k4"),
    ({"k1": -0.3, "k2": 0.1, "p1": 1e-3, "p2": 0, "s1": 0.1}, "s1"),
    ({"k1": -0.3, "k2": 0.1, "p1": 1e-3, "p2": 0, "tauX": 0.1}, "tauX"),
    ({"D": list(BROWN), "s4": 0.1}, "s4"),
    ({"D": list(BROWN), "k1": -0.2}, "k1"),
    ({"D": list(BROWN), "my_distortion": [0.1, 0.2]}, "my_distortion"),
    ({"D": list(BROWN), "distCoeffs": [0.1, 0, 0, 0]}, "distCoeffs"),
    ({"D": list(BROWN), "xi": 1.2}, "xi"),
    ({"kc_0": -0.3, "kc_2": 0.1}, "kc1"),
    ({"model": "pinhole", "k1": -0.3, "omega": 0.9}, "omega"),
]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("lens", "name"), STRAY, ids=lambda value: value if isinstance(value, str) else "")
def test_a_coefficient_that_is_not_used_is_an_error_by_its_name(
    form: str, lens: dict[str, Any], name: str, tmp_path: Path
) -> None:
    assert name in refusal(tmp_path, written(form, {**NAMED, **lens})).partition("cannot be used")[2]


@pytest.mark.parametrize("form", FORMS)
def test_zeros_and_the_same_coefficients_twice_are_no_contradiction(form: str, tmp_path: Path) -> None:
    twice = {"D": list(BROWN), **dict(zip(("k1", "k2", "p1", "p2"), BROWN, strict=True)), "k3": 0, "s1": 0.0}
    found = read_calibration(at(tmp_path, written(form, {**NAMED, **twice})), SIZE)
    assert getattr(found.camera, "distortion", None) == BROWN


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (f"{K_TEXT}-0.3 0.1 0.001\n", "expected 4, 5 or 8 numbers, got 3"),
        (f"{K_TEXT}-0.3 0.1 0.001 0 0 0 0 0 0\n", "expected 4, 5 or 8 numbers, got 9"),
        (dso("Pinhole", (0.8, 1.0, 0.5, 0.5, 0.1)), "its lens, opencv, has 0 coefficients (none), found 1: 0.1"),
        (dso("FOV", (0.8, 1.0, 0.5, 0.5)), "its lens, fov, has 1 coefficients (omega), found 0"),
        (dso("RadTan", (0.8, 1.0, 0.5, 0.5, 0.1)), "has 4 coefficients (k1 k2 p1 p2), found 1: 0.1"),
        (METASHAPE.replace("<k3>", "<k4>0.1</k4><k3>"), "k4 of its Metashape lens"),
        (METASHAPE.replace("<k3>", "<p3>0.1</p3><k3>"), "p3 of its Metashape lens"),
        (METASHAPE.replace("<b1>", "<b2>40</b2><b1>"), "a skew of 40"),
        (mat(**{**INTRINSICS, "Skew": 30.0}), "a skew of 30"),
        ({**NAMED, "skew": 30.0}, "a skew of 30"),
        (basalt("kb4", **numbered("k", 1, KB), k5=0.1), "k5"),
        ({"K": K, "model": "fisheye", "D": [*KB, 0.1]}, "Kannala-Brandt lens has 4 coefficients, found 5"),
        ({**NAMED, "model": "FisheyeRadTanThinPrism", "params": [0.1, 0.2]}, "'params'"),
        ({**NAMED, "cam_model": "Ocam"}, "'ocam', but it has no polynomial"),
        ({"cx": CX, "cy": CY, "a0": -400.0, "a2": 8e-4}, "begins with -400"),
        ({"cx": CX, "cy": CY, "a0": 400.0, "a2": -8e-4, "c": 1.0}, "a 'stretch' of c, d and e"),
        ({"one": NAMED, "two": NAMED}, "holds 2 cameras (one, two)"),
    ],
)
def test_numbers_of_a_lens_that_do_not_fit_are_refused(content: Content, name: str, tmp_path: Path) -> None:
    assert name in refusal(tmp_path, content)


# ---- models


def kalibr(model: str, intrinsics: list[float]) -> str:
    lens = "distortion_coeffs: [0.1, 0.2, 0.0, 0.0]\n  distortion_model: radtan"
    return f"cam0:\n  camera_model: {model}\n  intrinsics: {intrinsics}\n  {lens}\n  resolution: [640, 480]\n"


MEI = {
    "model_type": "MEI", "mirror_parameters": {"xi": 1.2}, "distortion_parameters": {"k1": -0.1},
    "projection_parameters": {"gamma1": 900.0, "gamma2": 900.0, "u0": 318.0, "v0": 245.0},
}  # fmt: skip


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (kalibr("omni", [1.2, FX, FY, CX, CY]), "omni"),
        (kalibr("ds", [-0.2, 0.6, FX, FY, CX, CY]), "ds"),
        (kalibr("eucm", [0.6, 1.1, FX, FY, CX, CY]), "eucm"),
        (basalt("ds", xi=-0.2, alpha=0.6), "ds"),
        (basalt("eucm", alpha=0.6, beta=1.1), "eucm"),
        (basalt("ucm", alpha=0.6), "ucm"),
        (MEI, "mei"),
        ({"K": K, "D": [0.1, 0, 0, 0], "xi": [[1.2]]}, "MEI"),
        (METASHAPE.replace("frame", "fisheye"), "fisheye' of Metashape"),
        (METASHAPE.replace("frame", "equisolid_fisheye"), "equisolid fisheye' of Metashape"),
        (
            "<document><chunk><sensors><sensor id='0' type='fisheye'><calibration type='fisheye'><f>500</f>"
            "</calibration></sensor></sensors></chunk></document>",
            "fisheye' of Metashape",
        ),
        (dso("Omni", (FX, FY, CX, CY, 1.2)), "omni"),
        (dso("EUCM", (FX, FY, CX, CY, 0.6, 1.1)), "eucm"),
        ("[camera]\nmodel = double_sphere\nfx = 500\nfy = 500\ncx = 318\ncy = 245\nxi = -0.2\nalpha = 0.6\n", "double"),
    ],
)
def test_a_lens_without_a_counterpart_is_refused_by_its_name(content: Content, name: str, tmp_path: Path) -> None:
    message = refusal(tmp_path, content)
    assert "has no counterpart here" in message
    assert name in message


@pytest.mark.parametrize("text", ["[camera]\nthis is no pair\n", "; mine\n[camera]\nmask = a.png\n"])
def test_an_ini_that_holds_no_camera_is_not_taken_for_json(text: str, tmp_path: Path) -> None:
    assert "JSON" not in refusal(tmp_path, text)


# ---- sizes

SIDES = [
    ("imx", "imy"), ("width", "height"), ("image_width", "image_height"), ("w", "h"), ("img_w", "img_h"), ("nx", "ny"),
    ("res_x", "res_y"), ("cols", "rows"), ("frame_width", "frame_height"), ("width_px", "height_px"),
    ("calib_width", "calib_height"), ("resolution_x", "resolution_y"),
]  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("names", SIDES, ids=lambda names: names[0])
def test_a_size_by_any_usual_name_holds(names: tuple[str, str], form: str, tmp_path: Path) -> None:
    file = at(tmp_path, written(form, {**NAMED, names[0]: 640, names[1]: 480}))
    assert read_calibration(file, SIZE).camera == PinholeCamera(FX, FY, CX, CY, *SIZE)
    with pytest.raises(CalibrationError, match="is for 640x480 px, but the images are 720x576 px"):
        read_calibration(file, (720, 576))


@pytest.mark.parametrize(
    "content",
    [
        {"calibration": {"K": K}, "image": {"width": 640, "height": 480}},
        {"K": K, "video": {"width": 640, "height": 480, "fps": 25}},
        {"camera": NAMED, "meta": {"image_size": [640, 480]}},
        {"K": K, "resolution": "640x480"},
        {"K": K, "image_size": "640 x 480 px"},
        {"K": K, "image_shape": [480, 640, 3], "image_size": [640, 480]},
        {"K": K, "_comment": "laparoscope, 640 x 480"},
        f"# 640 x 480\n{K_TEXT}",
        f"{K_TEXT}# 640x480 px\n",
        f"# calibrated at 640×480\n{FX} {FY} {CX} {CY}\n",
        f"# width: 640, height: 480\n{K_TEXT}",
        f"# width = 640\n# height = 480\n{K_TEXT}",
        f"# image size: 640 480\n{K_TEXT}",
        f"// resolution 640, 480\n{FX} {FY} {CX} {CY}\n",
        f"% 640 x 480\n{K_TEXT}",
        f"K: {K_NINE}  # 640 x 480\nboard: 9 x 6\n",
        f"<?xml version='1.0'?><opencv_storage><!-- 640 x 480 --><K>{K_TEXT}</K></opencv_storage>",
        f"; 640 x 480\n[intrinsics]\nfx = {FX}\nfy = {FY}\ncx = {CX}\ncy = {CY}\n",
        f"{K_TEXT}640 480\n",
        f"{FX} {FY} {CX} {CY}\n640 480\n",
    ],
)
def test_a_size_beside_the_camera_or_in_a_comment_holds(content: Content, tmp_path: Path) -> None:
    file = at(tmp_path, content)
    assert read_calibration(file, SIZE).camera == PinholeCamera(FX, FY, CX, CY, *SIZE)
    with pytest.raises(CalibrationError, match="is for 640x480 px, but the images are 720x576 px"):
        read_calibration(file, (720, 576))


@pytest.mark.parametrize(
    "content",
    [
        {"K": K, "board": {"width": 9, "height": 6}, "target": {"width": 1000, "height": 900}},
        {"K": K, "nx": 9, "ny": 6, "size": [9, 6]},
        {"K": K, "depth_camera": {"image_size": [320, 240]}, "right": {"width": 1000, "height": 1000}},
        f"# board 9 x 6, squares of 3 mm, 120 x 80 mm\n{K_TEXT}",
        f"# 1920 x 1080, cut to 640 x 480\n{K_TEXT}",
        f"# 2024-01-01, rms 0.215\n{K_TEXT}",
    ],
)
def test_what_is_no_size_of_the_pictures_is_not_taken_for_one(content: Content, tmp_path: Path) -> None:
    assert read_calibration(at(tmp_path, content), (720, 576)).size_origin == "images"


# ---- values that cannot be


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"fx": -520.5}, "focal length -520.5"),
        ({"fx": 0}, "focal length 0"),
        ({"fy": 0}, "focal length 520.5, 0"),
        ({"fx": "nan"}, "fx must be a finite number"),
        ({"cx": "inf"}, "cx must be a finite number"),
        ({"fx": 4.2, "fy": 4.2}, "focal length 4.2, 4.2 px .* if it is in mm"),
        ({"fx": 4.2, "fy": 4.2, "cx": 0.05, "cy": -0.02}, "neither px nor shares"),
        ({"cx": 0, "cy": 0}, "neither px nor shares"),
        ({"cx": 0.5, "cy": 0.5}, "neither px nor shares"),
        ({"model": "fov", "omega": 52.0}, "between 0 and pi, got 52"),
        ({"k1": "none"}, "k1 must be a finite number"),
    ],
)
def test_values_that_no_camera_has_are_refused(form: str, wrong: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=message):
        read_calibration(at(tmp_path, written(form, {**NAMED, **wrong})), SIZE)


def test_five_px_alone_may_be_of_two_lenses(tmp_path: Path) -> None:
    assert "holds 5 numbers" in refusal(tmp_path, f"{FX} {FY} {CX} {CY} 0.2")
    assert "between 0 and pi, got -0.3" in refusal(tmp_path, f"{' '.join(map(str, ATAN[:4]))} -0.3")


# ---- .mat files


def opaque() -> bytes:
    """A .mat file with an object of MATLAB's class cameraParameters (MCOS), as MATLAB lays it out."""

    def element(kind: int, content: bytes) -> bytes:
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    def matrix(flags: int, *elements: bytes) -> bytes:
        return element(14, element(6, struct.pack("<II", flags, 0)) + b"".join(elements))

    numbers = matrix(13, element(5, struct.pack("<2i", 1, 2)), element(1, b""), element(6, struct.pack("<2I", 1, 2)))
    names = [element(1, text) for text in (b"params", b"MCOS", b"cameraParameters")]
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"
    return header + matrix(17, *names, numbers)


def bomb() -> bytes:
    packed = zlib.compress(bytes(400_000_000), 9)
    return mat(a=1.0)[:128] + struct.pack("<II", 15, len(packed)) + packed


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (opaque(), "holds objects of MATLAB, .*toStruct\\(params\\); save\\('cam.mat', '-struct', 's', '-v7'\\)"),
        (b"MATLAB 7.3 MAT-file".ljust(512, b"\0"), "version 7.3, .*'-v7'"),
        (mat(K=np.eye(3))[:150], "damaged .mat file"),
        (mat(a=1.0)[:128], "toStruct"),
        (mat(a=1.0, b="text"), "no 3x3 camera matrix"),
        (mat(**{**INTRINSICS, "FocalLength": [np.nan, FY]}), "must be a finite number"),
        (mat(**{**INTRINSICS, "FocalLength": [[FX, FY, 1.0]]}), "expected 2 numbers in FocalLength, fx fy, found 3"),
        (mat(MappingCoefficients=[400.0, 1e-4], DistortionCenter=[CX, CY]), "4 numbers in MappingC"),
    ],
)
def test_mat_files_that_cannot_be_read_are_one_sentence(content: bytes, message: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=message):
        read_calibration(at(tmp_path, content), SIZE)
    assert "\n" not in refusal(tmp_path, content)


@pytest.mark.slow
def test_a_compressed_bomb_is_not_unpacked(tmp_path: Path) -> None:
    assert "larger than any calibration" in refusal(tmp_path, bomb())
    assert "larger than any calibration" in refusal(tmp_path, npz(K=np.zeros(40_000_000)))


def test_arrays_that_are_damaged_or_pickled_are_refused(tmp_path: Path) -> None:
    assert "its arrays cannot be read" in refusal(tmp_path, npz(K=np.eye(3))[:100])
    assert "its arrays cannot be read" in refusal(tmp_path, npy(np.array([{"fx": 1}])))
    assert "its arrays cannot be read" in refusal(tmp_path, npy(np.eye(3)).replace(b"}", b" "))
    assert "no 3x3 camera matrix" in refusal(tmp_path, npz(K=np.array([{"fx": 1}])))


def test_a_column_of_five_is_bouguets_lens_and_a_skew_is_noted(tmp_path: Path) -> None:
    content = mat(fc=[FX, FY], cc=[CX, CY], kc=np.array(BROWN3)[:, None], alpha_c=2e-3)
    found = read_calibration(at(tmp_path, content), SIZE)
    assert getattr(found.camera, "distortion", None) == BROWN3
    assert "its skew of 1.041 px left out" in found.source
