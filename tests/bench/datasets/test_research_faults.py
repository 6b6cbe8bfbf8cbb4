"""Faults of research data sets: what cannot be read is one sentence that names the file, the rest is a warning."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.errors import CalibrationError, InputError, ScopemapError
from scopemap.engine.geometry.se3 import se3_exp
from scopemap.input.opening import open_sequence
from tests.support.drawn_datasets import WRITERS
from tests.support.drawn_image_sets import (
    ONESLAM_TURN,
    P1,
    SHEET_COLUMNS,
    SIM_HEADER,
    STAMPS,
    STATED,
    TUM_TURN,
    UNITY_HEADER,
    at_rest,
    buffer,
    calibration_json,
    llff,
    replace_line,
    robot_row,
    unity_row,
    unity_table,
    write_depth_exr,
    write_image,
    write_picture,
    write_xlsx,
)
from tests.support.drawn_video_sets import FRAMES, archive_of, images_bin, write_kinematics, write_models

Edit = Callable[[Path], object]
KINEMATICS, TABLE, SHEET = "groundtruth.txt", "Poses/colon_position_rotation.csv", "Poses/poses.xlsx"
POSITIONS, TURNS = "../SavedPosition_S1.txt", "../SavedRotationQuaternion_S1.txt"
HEAD = [None, *SHEET_COLUMNS]


def text(name: str, content: str | bytes) -> Edit:
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def drop(name: str) -> Edit:
    return lambda folder: (folder / name).unlink()


def line(name: str, number: int, content: str) -> Edit:
    return lambda folder: replace_line(folder / name, number, content)


def edited(name: str, change: Callable[[bytes], bytes]) -> Edit:
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def stated(**changed: object) -> Edit:
    return text("calibration.json", json.dumps(STATED | changed))


def intrinsics(**changed: object) -> Edit:
    return stated(intrinsics=STATED["intrinsics"] | changed)


def stored(rows: np.ndarray) -> Edit:
    return lambda folder: np.save(folder / "poses_bounds.npy", rows, allow_pickle=True)


def archived(folder: Path) -> None:
    with (folder / "poses_bounds.npy").open("wb") as opened:
        np.savez(opened, rows=llff(at_rest()))


def with_first(row: list[float]) -> Edit:
    return text("Rectified_calibration/010.json", calibration_json([row, *P1[1:]]))


def sheet(*rows: list[object]) -> Edit:
    return lambda folder: write_xlsx(folder / SHEET, list(rows))


def model(content: bytes) -> Edit:
    return lambda folder: write_models(archive_of(folder), {0: content})


def moved(number: int, factor: float, columns: slice) -> np.ndarray:
    """Camera-to-world from the identity on, turning and moving; some columns of one rotation scaled."""
    poses = np.stack([se3_exp(i * np.array([0.01, -0.05, 0.1, 2.0, -1.0, 0.5])) for i in range(5)])
    poses[number, :3, columns] *= factor
    return llff(poses)


def unpaired(folder: Path) -> None:
    write_picture(folder / "FrameBuffer_0004.png", 4, (96, 96))


FAULTS: list[tuple[str, Edit, str]] = [
    ("c3vd", lambda f: write_picture(f / "17_color.png", 17, (135, 108)), r"17_color\.png has no line in pose\.txt"),
    ("c3vd:v2", lambda f: write_picture(f / "rgb/0011.png", 11, (135, 108)), r"0011\.png has no line in pose\.txt"),
    *(("c3vd", text("pose.txt", content), r"pose\.txt") for content in ("1,2,3\n", "", "a b", "1.5," * 16)),
    ("c3vd:endogslam", lambda f: [write_picture(p, 1, (128, 64)) for p in (f / "color").iterdir()],
     "1350x1080 px, but the images are 128x64 px"),
    # ---- EndoNeRF
    ("endonerf", text("poses_bounds.npy", b""), "no NumPy array of numbers"),
    ("endonerf", edited("poses_bounds.npy", lambda b: b[:200]), "no NumPy array of numbers"),
    ("endonerf", edited("poses_bounds.npy", lambda b: b.replace(b"(5, 17)", b"(9**9, ")), "no NumPy array of numbers"),
    ("endonerf", edited("poses_bounds.npy", lambda b: b.replace(b"(5, 17), }    ", b"(99999, 17), }")), "no NumPy"),
    ("endonerf", archived, "it is an archive"),
    ("endonerf", stored(np.array([{"a": 1}], dtype=object)), "no NumPy array of numbers"),
    ("endonerf", stored(np.array([["a"] * 17] * 5)), "found <U1 of shape"),
    ("endonerf", stored(llff(at_rest())[:, :15]), r"expected LLFF's numbers of shape \(images, 17\), found float64"),
    ("endonerf", stored(np.zeros((0, 17))), "found none"),
    ("endonerf", stored(moved(3, -1, slice(0, 1))), r"row 3: not a rigid motion .* det R = -1"),
    ("endonerf", stored(moved(1, 1.5, slice(0, 3))), "row 1: not a rigid motion"),
    ("endonerf", stored(llff(at_rest(4))), "holds 4 rows for 5 images"),
    ("endonerf", stored(np.vstack([llff(at_rest(4)), llff(at_rest(1), focal_px=50)])), "several cameras"),
    ("endonerf", stored(llff(at_rest(), focal_px=1e4)), r"focal length 10000; .*camera\.yaml"),
    ("endonerf", stored(llff(at_rest(), 80, 64)), "is for 64x80 px, but the images are 80x64 px"),
    ("endonerf", lambda f: write_image(f / "depth/coloured-009.png", np.ones((64, 80), np.uint8)),
     r"coloured-009\.png and frame-9\.depth\.png have the same number"),
    # ---- SERV-CT
    *(("serv-ct", text("Rectified_calibration/010.json", content), r"010\.json.*no matrix P1 of 3x4 numbers")
      for content in ("", "[" * 100_000, "[1, 2]", '{"P2": [1]}', '{"P1": {"data": [1, 2, 3]}}', '{"P1": null}')),
    ("serv-ct", with_first([1e400, 0, 41, 0]), r"010\.json.*focal length inf"),
    ("serv-ct", with_first([90.5, 0, 360, 0]), "principal point 360, 30.5"),
    ("serv-ct", with_first([90.5, 3, 41, 0]), "is not .K . 0."),
    # ---- TUM
    (("tum"), line(KINEMATICS, 3, "1305031102.2 0 0 0 0 0 1"), r"line 4: found 7 numbers where earlier"),
    ("tum", line(KINEMATICS, 3, "1305031102.2 0 0 x 0 0 0 1"), r"line 4: expected numbers, found 'x'"),
    ("tum", line(KINEMATICS, 3, "1305031102.2 0 0 0 0 0 0 3"), r"line 4: the quaternion has length 3"),
    ("tum", line(KINEMATICS, 3, f"{STAMPS[0] - 0.004:.4f} 1 0 0 0 0 0 1"), r"line 4: the time stamp of an earlier"),
    *(("tum", line("rgb.txt", 3, row), r"rgb\.txt, line 4: expected `timestamp filename`, found")
      for row in ("1305031102.2", "1305031102.2 rgb/1.png 2.0 depth/1.png", "now rgb/1.png", "nan rgb/1.png")),
    ("tum", line("rgb.txt", 3, f"{STAMPS[2]:.6f} rgb/1.png"), r"rgb\.txt, line 6: the time stamp of an earlier line"),
    ("tum", line("depth.txt", 3, "1305031102.2 depth/1.png x"), r"depth\.txt, line 4: expected `timestamp filename`"),
    ("tum", text("associations.txt", "1.0 rgb/1.png 2.0\n"), r"associations\.txt, line 1: expected `timestamp rgb"),
    ("tum", text("associations.txt", f"1.0 rgb/{STAMPS[2]:.6f}.png 2.0 a.png\n1.0 rgb/{STAMPS[2]:.6f}.png 2.0 b.png"),
     "line 2: .* has another depth image in an earlier line"),
    # ---- OneSLAM
    ("oneslam", text("calibration.json", "[1, 2]"), 'no object with "intrinsics"'),
    ("oneslam", text("calibration.json", '{"FPS": 30}'), "no 3x3 camera matrix"),
    ("oneslam", intrinsics(fx="wide"), r"calibration\.json.*fx must be a finite number, found 'wide'"),
    ("oneslam", intrinsics(fx=10**400), "fx must be a finite number, found 'inf'"),
    ("oneslam", intrinsics(fx=900, fy=900), "focal length 900, 900"),
    ("oneslam", intrinsics(cx=400), "principal point 400, 30.25 is outside"),
    *(("oneslam", stated(FPS=rate), "FPS must be a positive number") for rate in (0, -25, "fast", [25], float("nan"))),
    ("oneslam", line("poses_gt.txt", 1, "3 0 0 0 0 0 1"), "found 8 numbers where earlier lines have 7"),
    ("oneslam", line("poses_gt.txt", 1, "10 0 0 0 0 0 0 1"), "line 3: the time stamp of an earlier line is repeated"),
    ("oneslam", line("poses_gt.txt", 1, "3.5 0 0 0 0 0 0 1"), "stamped by frame number here, but not all stamps"),
    ("oneslam", lambda f: write_picture(f / "images/00000009.png", 9), r"00000009\.\w+ and 00000009\.\w+ have"),
    ("oneslam", lambda f: write_picture(f / "images/last.png", 9), r"last\.png: its name holds no number"),
    ("oneslam", text("mask.bmp", b"BM"), r"mask\.bmp: expected a mask of 80x64 px, found no readable image"),
    ("oneslam", lambda f: write_image(f / "mask.bmp", np.ones((20, 30), np.uint8)), "found 30x20 px"),
    # ---- SimCol3D
    ("simcol3d", text(POSITIONS, "0 0 0\n" * 3), "holds 3 lines and SavedRotationQuaternion_S1.txt 4"),
    ("simcol3d", edited(TURNS, lambda b: b * 2), "holds 4 lines and .* 8"),
    ("simcol3d", text(POSITIONS, ""), "holds no pose"),
    ("simcol3d", line(POSITIONS, 3, "1 2"), "line 4: found 2 numbers where"),
    ("simcol3d", line(POSITIONS, 1, ""), "holds 3 lines"),
    ("simcol3d", line(TURNS, 3, "0 0 0 0"), "line 4: .* length 0 instead"),
    ("simcol3d", drop(POSITIONS), r"SavedPosition_S1\.txt .*No such file"),
    ("simcol3d", drop(TURNS), r"SavedRotationQuaternion_S1\.txt .*No such file"),
    ("simcol3d", unpaired, r"holds 4 lines .* the last image is FrameBuffer_0004\.png"),
    ("simcol3d", text(POSITIONS, b"\xff\xfe\x00\x80"), r"SavedPosition_S1\.txt"),
    # ---- tables of Unity, in both forms
    *(("endomapper-sim", text("trajectory.csv", content), rf"trajectory\.csv.*{message}") for content, message in (
        ("", "holds no pose"), (f"{SIM_HEADER}\n", "holds no pose"), (f"{SIM_HEADER}\n1;2\n", "line 2: found 2 col"),
        (f"{unity_table((0,), SIM_HEADER)}\n{unity_row(1, ';')}", "line 3: found 0 columns"),
        (f"{SIM_HEADER}\n0;0;0;0;0;0;0;0\n{unity_row(1, ';')}", "line 2: the quaternion has length 0"))),
    ("endomapper-sim", text("trajectory.csv", b"\xff\xfe\x00"), r"cannot read .*trajectory\.csv"),
    *(("endoslam:unity", text(TABLE, content), message) for content, message in (
        ("a,b\n" * 3, "line 1: could not convert"),
        ("tX,tZ,tY,rX,rY,rZ,rW,time(s)\n" + unity_row(0), "line 1: expected the columns tx,ty"),
        (unity_table((0,)) + "1,2,3\n" + unity_row(1), "line 3: found 3 columns where 8"),
        (unity_table().replace("8.99", "y"), "line 3: could not convert .*'y'"),
        (UNITY_HEADER, "holds no pose"))),
    ("endoslam:unity", lambda f: [p.rename(p.with_name(f"{p.stem[-1]}99.png")) for p in (f / "Frames").iterdir()],
     r"no image has a pose .* \(4 rows; images 99 to 399\)"),
    # ---- the robot's spreadsheet
    *(("endoslam:real", sheet(*rows), message) for rows, message in (
        ([], r"poses\.xlsx.*the first sheet has no column imageframe, trans_x"), ([HEAD], "it holds no pose"),
        ([HEAD[:-1], robot_row(60)], "no column quot_w, found imageframe"),
        ([HEAD, [0, "x", *robot_row(60)[2:]]], "row 2: expected 8 numbers"),
        ([HEAD, [0, 60.5, *robot_row(60)[2:]]], "row 2: ImageFrame must be the number of an image"),
        ([HEAD, [*robot_row(60)[:-1], 0.1]], "row 2: the quaternion has length"),
        ([HEAD, robot_row(7)], "no image has a pose"))),
    ("endoslam:real", text(SHEET, b"no zip"), r"poses\.xlsx: no Excel workbook"),
    ("endoslam:real", edited(SHEET, lambda b: b[: len(b) // 2]), r"poses\.xlsx: no Excel workbook"),
    # ---- StereoMIS
    *(("stereomis", text(KINEMATICS, content), rf"groundtruth\.txt.*{message}") for content, message in (
        ("# only this\n", "holds no pose"), ("0 1 2 3\n", "line 1: found 4 numbers where frame tx ty tz"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 0\n", "line 2: the quaternion has length 0"),
        ("0 0 0 0 0 0 0 1\n\n0 0 0 0 0 0 0 1\n", "line 3: the time stamp of an earlier line is repeated"),
        ("0.5 0 0 0 0 0 0 1\n", "must be frame numbers"), ("nan 0 0 0 0 0 0 1\n", "must be frame numbers"),
        ("-1 0 0 0 0 0 0 1\n", "must be frame numbers"))),
    ("stereomis", lambda f: (f / "b.mp4").write_bytes((f / "endoscope_part0001.mp4").read_bytes()),
     r"holds one video, found 2 \(b\.mp4, endoscope_part0001\.mp4"),
    ("stereomis", text("endoscope_part0001.mp4", b"not a video"), "reading the video"),
    # ---- EndoMapper
    *(("endomapper", model(content), rf"Seq_001\.zip.*{message}") for content, message in (
        (b"", "cut off"), (images_bin([1, 2, 3])[:-30], "cut off"), (images_bin([]), "no image with its pose"),
        (images_bin([1])[:-32] + struct.pack("<Q", 2**60), "the archive is damaged or incomplete .it is cut off"),
        (images_bin([1, 1]), "is repeated"), (images_bin([1], name="frame{}.png"), "'frame1.png' is not outN.png"),
        (images_bin([0, 1]), "'out0.png' is not outN.png"),
        (images_bin([1, 2], quaternion=(2.0, 0.0, 0.0, 0.0)), "quaternion has length 2"))),
    ("endomapper", edited("meta-data/colmap/Seq_001.zip", lambda b: b[: len(b) // 2]), "archive is damaged or incompl"),
    ("endomapper", edited("meta-data/colmap/Seq_001.zip", lambda b: b[:60] + b"\xff" * 10 + b[70:]), "archive is da"),
    ("endomapper", lambda f: zipfile.ZipFile(archive_of(f), "w").close(), "it holds no COLMAP model"),
    *(("endomapper", text("Seq_001_info.json", content), r"Seq_001_info\.json.*is no JSON object")
      for content in ("", "[1]", "{")),
    ("endomapper", text("Seq_001_info.json", '{"endoscope_number": "front"}'), "endoscope_number 'front' is none"),
    ("endomapper", lambda f: (f / "Seq_002.mov").write_bytes((f / "Seq_001.mov").read_bytes()),
     r"holds one video, found 2 \(Seq_001\.mov, Seq_002\.mov\)"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "edit", "message"), FAULTS)
def test_what_cannot_be_read_is_one_sentence(name: str, edit: Edit, message: str, tmp_path: Path) -> None:
    folder = WRITERS[name](tmp_path / "s")
    edit(folder)
    with pytest.raises(ScopemapError, match=message) as caught:
        open_sequence(folder, dataset=name.split(":")[0])
    assert "\n" not in str(caught.value)


TRUTH_FAULTS: list[tuple[str, Edit, int, str]] = [
    ("oneslam", lambda f: (write_image(f / "mask.bmp", np.ones((64, 80), np.uint8)),
                           write_image(f / "depths/00000003.png", np.ones((32, 40), np.uint16))), 3,
     r"00000003\.png: depth is 40x32 px, mask\.bmp 80x64 px"),
    ("serv-ct", text("Ground_truth_CT/OcclusionL/010.png", b"damaged"), 10, r"010\.png: expected an image of the size"),
    ("serv-ct", lambda f: write_image(f / "Ground_truth_CT/OcclusionL/010.png", np.zeros((32, 40, 3), np.uint8)), 10,
     r"010\.png: expected an image of the size of the depth"),
    ("endomapper-sim", lambda f: write_depth_exr(f / "depth/aov_image_0002.exr", buffer((48, 48))), 2,
     r"aov_image_0002\.exr: depth of 48x48 px for images of 96x72 px"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "edit", "number", "message"), TRUTH_FAULTS)
def test_truth_that_does_not_fit_is_one_sentence(
    name: str, edit: Edit, number: int, message: str, tmp_path: Path
) -> None:
    folder = WRITERS[name](tmp_path / "s")
    edit(folder)
    with pytest.raises(InputError, match=message):
        open_sequence(folder).source.truth(number)


WARNED: list[tuple[str, Edit, str]] = [
    ("serv-ct", drop("Rectified_calibration/009.json"), "no calibration for picture(s) 9: taken as of 010.json"),
    ("tum", text(KINEMATICS, f"0.0 0 0 0 {TUM_TURN}\n0.1 0 0 0 {TUM_TURN}\n"), "no pose belongs to any frame"),
    ("oneslam", text("poses_gt.txt", f"500 0 0 0 {ONESLAM_TURN}\n"), "no row is stamped with the number of an image"),
    ("endoslam:unity", text(TABLE, UNITY_HEADER + "\n" + unity_row(1) * 4), "all rotations are the same"),
    ("endoslam:unity", text(TABLE, unity_table((0, 1, 2))), "3 rows for 4 images; 1 images have no pose"),
    ("endoslam:unity", lambda f: None, "line 6: found 5 columns where 8 numbers were expected: the last row is"),
    ("endoslam:real", drop(SHEET), "no pose is known"),
    ("endomapper-sim", text("trajectory.csv", unity_table((0, 1, 2), SIM_HEADER)), "1 of 4 images have no pose"),
    ("endomapper-sim", text("trajectory.csv", SIM_HEADER + "\n" + unity_row(1, ";") * 4), "the times do not increase"),
    ("stereomis", lambda f: write_kinematics(f / KINEMATICS, frames=FRAMES + 2), "2 of 8 poses belong to frames"),
    ("endomapper", model(images_bin([1, 7, 8])), "2 of 3 poses belong to frames beyond the 6"),
    ("endomapper", text("Seq_001_info.json", '{"endoscope_number": 12}'),
     "Endoscope_12_geometrical.xml (Seq_001_info.json) is not in"),
    ("simcol3d", lambda f: (f / "..").joinpath("SavedPosition_S1.txt").rename(f.parent / "SavedPosition_S2.txt")
     and (f.parent / "SavedRotationQuaternion_S1.txt").unlink(), "no pose is known"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "edit", "words"), WARNED)
def test_what_is_doubtful_is_a_warning(name: str, edit: Edit, words: str, tmp_path: Path) -> None:
    folder = WRITERS[name](tmp_path / "s")
    edit(folder)
    assert any(words in str(warning) for warning in open_sequence(folder).warnings)


def test_a_damaged_sheet_is_one_sentence(tmp_path: Path) -> None:
    folder = WRITERS["endoslam:real"](tmp_path / "s")
    for broken in ("<worksheet>", "<a><sheetData><row r='1'><c r='A1' t='s'><v>5</v></c></row></sheetData></a>"):
        with zipfile.ZipFile(folder / SHEET, "w") as archive:
            archive.writestr("xl/worksheets/sheet1.xml", broken)
        with pytest.raises(InputError, match=r"poses\.xlsx: no Excel workbook, or damaged"):
            open_sequence(folder)


@pytest.mark.parametrize("content", [b"", b'{"FPS": 30}', b'{"intrinsics": ', b" " * (2 << 20), b"[" * 100_000])
def test_another_calibration_json_is_not_taken_for_oneslams(content: bytes, tmp_path: Path) -> None:
    folder = WRITERS["oneslam"](tmp_path / "colon")
    (folder / "calibration.json").write_bytes(content)
    sequence = open_sequence(folder)
    assert (sequence.source.name, sequence.path) == ("images", folder / "images")


def test_a_camera_that_cannot_be_used_is_an_error_of_calibration(tmp_path: Path) -> None:
    folder = WRITERS["serv-ct"](tmp_path / "s")
    with_first([0.1, 0, 0.5, 0])(folder)
    with pytest.raises(CalibrationError, match="does not fit images of 80x64 px"):
        open_sequence(folder)
