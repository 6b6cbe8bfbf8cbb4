"""EndoSLAM: real trajectories with poses in a spreadsheet, rendered ones with Unity's poses and depth."""

from __future__ import annotations

import zipfile
from pathlib import Path

import cv2
import numpy as np
import openpyxl
import pytest
from drawn_inputs import number_in, picture, save

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import InputError
from scopemap.io.opening import open_sequence

SIZE = (96, 96)
K = np.array([[46.8, 0.0, 53.5], [0.0, 46.7, 54.5], [0.0, 0.0, 1.0]])
C, S = np.cos(0.4), np.sin(0.4)
HEADER = "tX,tY,tZ,rX,rY,rZ,rW,time(s)"
# Position, Unity units, and quaternion x y z w: x right, y up, z forward, left-handed.
ROWS = [
    (0.66, 8.98, -3.13, 0, 0, 0, 1),
    (0.67, 8.99, -3.12, 0, np.sin(0.2), 0, np.cos(0.2)),  # turned to the right
    (0.68, 9.00, -3.11, np.sin(0.2), 0, 0, np.cos(0.2)),  # turned down
    (0.69, 9.01, -3.10, 0.1, -0.3, 0.5, np.sqrt(1 - 0.35)),
]
CUT_OFF = "the last row is cut off and was left out"
COLUMNS = ["ImageFrame", "Pose_Index", *(f"trans_{a}" for a in "xyz"), *(f"quot_{a}" for a in "xyzw")]


def line(row: tuple[float, ...], i: int) -> str:
    return ",".join(f"{x:.9g}" for x in row) + f",{1 + i * 0.0333334:.7f}\n"


def table(rows: list[tuple[float, ...]]) -> str:
    return HEADER + "\n" + "".join(line(row, i) for i, row in enumerate(rows))


def write_unity(organ: Path, numbers: tuple[int, ...] = (0, 1, 2, 3), again: bool = False) -> Path:
    """Write a rendered organ; `again`: with the repeated folders of the copy on Mendeley."""
    frames = organ / ("Frames/Frames" if again else "Frames")
    depths = organ / ("Depths/Pixelwise Depths" if again else "Pixelwise Depths")
    for folder in (frames, depths, organ / "Poses", organ.parent / "Calibration"):
        folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        save(frames / f"image_{number:04d}.png", picture(number % 40, SIZE))
        depth = np.full((SIZE[1], SIZE[0], 4), 7, np.uint8)
        depth[..., 2] = 40
        depth[:10, :, 2], depth[10:20, :, 2], depth[20:30, :, 2] = 0, 255, 1
        cv2.imwrite(str(depths / f"aov_image_{number:04d}.png"), depth)
    # The table that is published ends in the middle of a row.
    (organ / "Poses" / "colon_position_rotation.csv").write_text(table(ROWS) + "0.70,9.02,-3.09,0.1,0.2")
    (organ.parent / "Calibration" / "cam.txt").write_text(",".join(f"{x:g}" for x in K.ravel()))
    return organ


def write_xlsx(file: Path, rows: list[list[object]]) -> Path:
    """Write what pandas' `to_excel` does, its unnamed index in column A."""
    file.parent.mkdir(parents=True, exist_ok=True)
    workbook = openpyxl.Workbook()
    for row in rows:
        workbook.worksheets[0].append(row)
    workbook.save(file)
    return file


def robot_row(number: int) -> list[object]:
    """Row of image `number`: 1 mm a frame along x from 0.18 m, turned by 0.4 rad about z."""
    position = [0.18 + number / 1000, -0.2, 0.45]
    return [number - 60, number, number - 59, *position, 0, 0, np.sin(0.2), np.cos(0.2)]


def write_real(folder: Path, numbers: tuple[int, ...] = (60, 61, 63), rows: tuple[int, ...] = (60, 61, 63)) -> Path:
    (folder / "Frames").mkdir(parents=True)
    for number in numbers:
        save(folder / "Frames" / f"frame_{number:06d}.jpg", picture(number % 40, SIZE))
    write_xlsx(folder / "Poses" / "poses.xlsx", [[None, *COLUMNS], *(robot_row(number) for number in rows)])
    return folder


def rotated(quaternion: tuple[float, ...], vector: np.ndarray) -> np.ndarray:
    """What Unity's `quaternion * vector` gives."""
    q, w = np.array(quaternion[:3]), quaternion[3]
    return vector + 2 * w * np.cross(q, vector) + 2 * np.cross(q, np.cross(q, vector))


# ---- rendered by Unity


def test_a_rendered_organ(tmp_path: Path) -> None:
    sequence = open_sequence(write_unity(tmp_path / "UnityCam" / "Colon"))
    assert (sequence.source.name, sequence.count, sequence.calibrated) == ("endoslam", 4, True)
    np.testing.assert_array_equal(sequence.camera.matrix, K)
    for (frame, truth), number in zip(sequence, range(4), strict=True):
        assert frame.index == truth.index == number_in(frame.rgb) == number
        assert frame.time_s == pytest.approx(1 + number * 0.0333334)
        assert truth.quality == "exact"
    notes = " ".join(sequence.notes)
    for part in ("depth: 8 bit, unit not documented", "poses: their unit is not documented", "left-handed", "row of"):
        assert part in notes
    (warning,) = sequence.warnings
    assert "colon_position_rotation.csv, line 6: found 5 columns" in warning
    assert CUT_OFF in warning


def test_rendered_depth_is_the_red_channel(tmp_path: Path) -> None:
    depth_mm = open_sequence(write_unity(tmp_path / "UnityCam" / "Colon")).source.truth(1).depth_mm
    assert (depth_mm.dtype, depth_mm.shape) == (np.float32, (96, 96))
    assert np.isnan(depth_mm[:20]).all()
    np.testing.assert_array_equal(depth_mm[20:30], 10)
    np.testing.assert_array_equal(depth_mm[30:], 400)


def test_rendered_poses_are_right_handed_mm(tmp_path: Path) -> None:
    source = open_sequence(write_unity(tmp_path / "UnityCam" / "Colon")).source
    right = [[C, 0, S, 670], [0, 1, 0, -8990], [-S, 0, C, -3120], [0, 0, 0, 1]]
    down = [[1, 0, 0, 680], [0, C, S, -9000], [0, -S, C, -3110], [0, 0, 0, 1]]
    np.testing.assert_allclose(source.pose(1), right, atol=1e-6)
    np.testing.assert_allclose(source.pose(2), down, atol=1e-6)


@pytest.mark.parametrize("number", range(4))
def test_a_point_of_the_scene_is_seen_where_unity_draws_it(number: int, tmp_path: Path) -> None:
    sequence = open_sequence(write_unity(tmp_path / "UnityCam" / "Colon"))
    x, y, z = local = np.array([0.015, 0.025, 0.08])  # right of the axis, above it, before the camera
    world_mm = 1000 * (rotated(ROWS[number][3:], local) + ROWS[number][:3]) * [1, -1, 1]
    in_camera = np.linalg.inv(sequence.source.pose(number)) @ [*world_mm, 1]
    drawn_at = [K[0, 2] + K[0, 0] * x / z, K[1, 2] - K[1, 1] * y / z]
    np.testing.assert_allclose(sequence.camera.project(in_camera[:3]), drawn_at, atol=1e-4)


def test_five_digits_sort_as_numbers_and_rows_are_numbers(tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "UnityCam" / "Colon", (3, 10000, 9999, 2))
    sequence = open_sequence(organ)
    assert [frame.index for frame in sequence.frames()] == [2, 3, 9999, 10000]
    assert [number_in(frame.rgb) for frame in sequence.frames()] == [2, 3, 39, 0]
    np.testing.assert_allclose(sequence.source.pose(3)[:3, 3], [690, -9010, -3100])
    assert sequence.source.pose(9999) is None
    assert any("holds 4 rows for 4 images; 2 images have no pose" in warning for warning in sequence.warnings)


def test_images_after_the_last_row_have_no_pose_and_go_on_in_time(tmp_path: Path) -> None:
    sequence = open_sequence(write_unity(tmp_path / "UnityCam" / "Stomach", tuple(range(6))))
    assert [sequence.source.pose(i) is None for i in range(6)] == [False] * 4 + [True] * 2
    assert sequence.source.truth(5).T_world_camera is None
    assert sequence.source.stamps(slice(None))[5][1] == pytest.approx(1 + 3 * 0.0333334 + 2 / 30)
    assert any("4 rows for 6 images; 2 images have no pose" in warning for warning in sequence.warnings)
    assert [frame.time_s for frame in sequence.frames()] == [t for _, t in sequence.source.stamps(slice(None))]


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("up", ["Colon", ".", "..", "../.."])
def test_it_is_found_from_above_and_in_repeated_folders(up: str, again: bool, tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "EndoSLAM" / "UnityCam" / "UnityCam" / "Colon", again=again)
    sequence = open_sequence((organ.parent / up).resolve())
    assert (sequence.source.name, sequence.path) == ("endoslam", organ)
    assert sequence.source.truth(0).depth_mm[50, 0] == 400
    np.testing.assert_array_equal(sequence.camera.matrix, K)


def test_equal_rotations_are_warned_of(tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "UnityCam" / "Colon")
    rows = [(*row[:3], *ROWS[1][3:]) for row in ROWS]
    (organ / "Poses" / "colon_position_rotation.csv").write_text(table(rows))
    assert any("all rotations are the same" in warning for warning in open_sequence(organ).warnings)


def test_a_calibration_beside_the_frames_wins_and_without_any_the_published_one_serves(tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "UnityCam" / "Colon")
    (organ.parent / "Calibration" / "cam.txt").unlink()
    assert not open_sequence(organ).calibrated
    for number in range(4):
        save(organ / "Frames" / f"image_{number:04d}.png", picture(number, (320, 320)))
    camera = open_sequence(organ).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (156.0418, 155.7529, 178.5604, 181.8043)
    own = PinholeCamera(150.0, 150.0, 160.0, 160.0, 320, 320)
    write_calibration(own, organ / "camera.yaml", depth_scale_mm=0.5)
    sequence = open_sequence(organ)
    assert sequence.camera == own
    assert sequence.source.truth(0).depth_mm[50, 0] == 20


def test_a_row_of_nan_is_no_pose_and_keeps_its_place(tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "UnityCam" / "Colon")
    rows = [ROWS[0], (np.nan,) * 7, *ROWS[2:]]
    (organ / "Poses" / "colon_position_rotation.csv").write_text(table(rows).replace(",1.0333334", ",nan"))
    source = open_sequence(organ).source
    assert source.pose(1) is None
    np.testing.assert_allclose(source.pose(2)[:3, 3], [680, -9000, -3110])
    assert source.stamps(slice(1, 2))[0][1] == pytest.approx(1.0333334)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no pose"),
        (HEADER, "holds no pose"),
        ("a,b\n" * 3, "line 1: could not convert"),
        ("tX,tZ,tY,rX,rY,rZ,rW,time(s)\n" + line(ROWS[0], 0), "line 1: expected the columns tx,ty"),
        (table(ROWS[:1]) + "1,2,3\n" + line(ROWS[1], 1), "line 3: found 3 columns where 8"),
        (table(ROWS[:1]).replace("0.66", ""), "line 2: found 7 columns"),
        (table(ROWS).replace("8.99", "y"), "line 3: could not convert .*'y'"),
        (table([ROWS[0], (*ROWS[1][:3], 0, 0, 0, 0), ROWS[2]]), "line 3: the quaternion has length 0"),
    ],
)
def test_tables_that_are_none_are_one_sentence(text: str, message: str, tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "UnityCam" / "Colon")
    (organ / "Poses" / "colon_position_rotation.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(organ)
    assert "\n" not in str(caught.value)
    assert "colon_position_rotation.csv" in str(caught.value)


def test_images_without_a_row_are_refused(tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "UnityCam" / "Colon", (500, 501))
    with pytest.raises(InputError, match=r"no image has a pose .* \(4 rows; images 500 to 501\)"):
        open_sequence(organ)


def test_depth_of_another_kind_is_refused_and_missing_depth_is_none(tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "UnityCam" / "Colon")
    depths = organ / "Pixelwise Depths"
    cv2.imwrite(str(depths / "aov_image_0000.png"), np.ones((96, 96), np.uint16))
    (depths / "aov_image_0001.png").unlink()
    (depths / "aov_image_0002.png").write_bytes(b"\x89PNG")
    cv2.imwrite(str(depths / "aov_image_0003.png"), np.full((96, 96), 3, np.uint8))
    source = open_sequence(organ).source
    for number in (0, 2):
        with pytest.raises(
            InputError, match=rf"aov_image_000{number}\.png: expected a depth image of one 8-bit channel"
        ):
            source.truth(number)
    assert source.truth(1).depth_mm is None
    np.testing.assert_array_equal(source.truth(3).depth_mm, 30)


# ---- real organs


def test_a_real_trajectory_is_joined_by_image_frame(tmp_path: Path) -> None:
    camera = tmp_path / "Cameras" / "HighCam"
    folder = write_real(camera / "Stomach-I" / "TumorfreeTrajectory_1", rows=(63, 60))
    (camera / "Calibration").mkdir()
    (camera / "Calibration" / "cam.txt").write_text(",".join(f"{x:g}" for x in K.ravel()))
    sequence = open_sequence(tmp_path / "Cameras" / "HighCam")
    assert (sequence.source.name, sequence.path, sequence.count) == ("endoslam", folder, 3)
    np.testing.assert_array_equal(sequence.camera.matrix, K)
    for (frame, truth), number in zip(sequence, (60, 61, 63), strict=True):
        assert frame.index == number
        assert number_in(frame.rgb) == number % 40
        assert frame.time_s == pytest.approx(number / 20)
        if number == 61:
            assert truth is None
        else:
            assert (truth.quality, truth.depth_mm) == ("kinematic", None)
            expected = [[C, -S, 0, 180 + number], [S, C, 0, -200], [0, 0, 1, 450], [0, 0, 0, 1]]
            np.testing.assert_allclose(truth.T_world_camera, expected, atol=1e-9)
    assert sequence.warnings == ["poses.xlsx holds 2 rows for 3 images; 1 images have no pose"]
    notes = " ".join(sequence.notes)
    assert "camera or robot hand" in notes
    assert "published rate of HighCam" in notes


def test_the_rate_is_that_of_the_camera_in_the_path(tmp_path: Path) -> None:
    folder = write_real(tmp_path / "MiroCam" / "Colon-I" / "TumorfreeTrajectory_1")
    (folder / "Poses" / "poses.xlsx").rename(folder / "Poses" / "poses.txt")
    sequence = open_sequence(tmp_path / "MiroCam")
    assert sequence.source.stamps(slice(None)) == [(60, 20.0), (61, pytest.approx(61 / 3)), (63, 21.0)]
    assert sequence.source.pose(60) is None
    assert [truth for _, truth in sequence] == [None] * 3
    assert any("no pose is known" in warning for warning in sequence.warnings)


def test_empty_cells_are_no_pose_and_empty_rows_nothing(tmp_path: Path) -> None:
    folder = write_real(tmp_path / "TumorfreeTrajectory_2")
    lacking = robot_row(61)
    lacking[5] = None
    header = ["", *COLUMNS[::-1]]
    rows = [[row[0], *row[:0:-1]] for row in (robot_row(60), lacking, [None] * 10, robot_row(63))]
    write_xlsx(folder / "Poses" / "poses.xlsx", [header, *rows])
    source = open_sequence(folder).source
    assert [source.pose(i) is None for i in (60, 61, 63)] == [False, True, False]
    np.testing.assert_allclose(source.pose(63)[:3, 3], [243, -200, 450])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "the first sheet has no column imageframe, trans_x"),
        ([[None, *COLUMNS]], "it holds no pose"),
        ([[None, *COLUMNS[:-1]], robot_row(60)], "no column quot_w, found imageframe"),
        ([[None, *COLUMNS], [0, "x", *robot_row(60)[2:]]], "row 2: expected 8 numbers"),
        ([[None, *COLUMNS], [0, 60.5, *robot_row(60)[2:]]], "row 2: ImageFrame must be the number of an image"),
        ([[None, *COLUMNS], [0, None, *robot_row(60)[2:]]], "row 2: ImageFrame must be"),
        ([[None, *COLUMNS], [*robot_row(60)[:-1], 0.1]], "row 2: the quaternion has length"),
        ([[None, *COLUMNS], robot_row(7)], "no image has a pose"),
    ],
)
def test_sheets_that_do_not_fit_are_one_sentence(rows: list[list[object]], message: str, tmp_path: Path) -> None:
    folder = write_real(tmp_path / "TumorfreeTrajectory_1")
    write_xlsx(folder / "Poses" / "poses.xlsx", rows)
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)
    assert "poses.xlsx" in str(caught.value)


def test_damaged_workbooks_are_one_sentence(tmp_path: Path) -> None:
    folder = write_real(tmp_path / "TumorfreeTrajectory_1")
    file = folder / "Poses" / "poses.xlsx"
    whole = file.read_bytes()
    for content in (b"", b"no zip", whole[: len(whole) // 2], whole.replace(b"sheet1.xml", b"sheet7.xml")):
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"poses\.xlsx: (no Excel workbook|this workbook has no first sheet)"):
            open_sequence(folder)
    for broken in ("<worksheet>", "<a><sheetData><row r='1'><c r='A1' t='s'><v>5</v></c></row></sheetData></a>"):
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("xl/worksheets/sheet1.xml", broken)
        with pytest.raises(InputError, match=r"poses\.xlsx: no Excel workbook, or damaged"):
            open_sequence(folder)


def test_what_excel_and_macs_leave_behind_is_no_second_file(tmp_path: Path) -> None:
    folder = write_real(tmp_path / "TumorfreeTrajectory_1")
    for name in ("~$poses.xlsx", "._poses.xlsx"):
        (folder / "Poses" / name).write_bytes(b"lock")
    assert open_sequence(folder).source.pose(60) is not None
