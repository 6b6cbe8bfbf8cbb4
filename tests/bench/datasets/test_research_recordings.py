"""What is peculiar to StereoMIS, EndoMapper, CLiMB and EndoSLAM: videos, kinematics, simulations, calibrations."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.errors import InputError
from scopemap.input.opening import open_sequence
from scopemap.result.reference import read_reference, reference_trajectory
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.datasets import endomapper_sim
from scopemap_bench.datasets.endomapper_sim import read_exr_red
from scopemap_bench.methods.method import create_method
from scopemap_bench.plan import MethodPlan, found_sequences, read_plan
from tests.support.drawn_climb import path_of, write_clip, write_foreign_run, write_reference
from tests.support.drawn_image_sets import (
    SHEET_COLUMNS,
    SIM_HEADER,
    UNITY_HEADER,
    UNITY_K,
    buffer,
    levels,
    robot_row,
    unity_row,
    write_depth_exr,
    write_exr,
    write_image,
    write_picture,
    write_real,
    write_sim,
    write_unity,
    write_xlsx,
)
from tests.support.drawn_inputs import number_in, picture
from tests.support.drawn_video_sets import (
    FRAMES,
    KB4,
    SCOPE_SIZE,
    STEREO_SIZE,
    archive_of,
    images_bin,
    kinematic_pose,
    write_endomapper,
    write_frames,
    write_ini,
    write_kinematics,
    write_models,
    write_stereomis,
    xml,
)

# ---- StereoMIS


def test_the_reference_of_a_video_is_known_without_decoding(tmp_path: Path) -> None:
    sequence = open_sequence(write_stereomis(tmp_path / "P1"), frames=slice(1, None, 2))
    reference = reference_trajectory(sequence)
    np.testing.assert_array_equal(reference.indices, [1, 3, 5])
    np.testing.assert_allclose(reference.times_s, [1 / 25, 3 / 25, 5 / 25])
    np.testing.assert_allclose(reference.T_world_camera, [kinematic_pose(n) for n in (1, 3, 5)], atol=1e-6)
    found = [(frame.index, number_in(frame.rgb)) for frame in sequence.source.frames(slice(1, 4))]
    assert found == [(1, 1), (2, 2), (3, 3)]


def test_views_beside_each_other_and_a_single_one(tmp_path: Path) -> None:
    sequence = open_sequence(write_stereomis(tmp_path / "P1", stacking=1))
    assert any("left, the left half" in note for note in sequence.notes)
    assert [number_in(frame.rgb) for frame in sequence.source.frames(slice(None))] == list(range(FRAMES))
    write_frames(next((tmp_path / "P1").glob("*.mp4")), [picture(i, STEREO_SIZE) for i in range(FRAMES)])
    sequence = open_sequence(tmp_path / "P1")
    assert (sequence.source.width, sequence.source.height) == STEREO_SIZE
    assert any("the whole image" in note for note in sequence.notes)


def test_the_calibration_is_brought_to_the_size_of_the_view(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    write_ini(folder / "StereoCalibration.ini", res_x=320, res_y=256, fc_x=261, fc_y=263, cc_x=163, cc_y=126)
    # Half the size: a centre c moves to (c + 0.5) / 2 - 0.5.
    assert open_sequence(folder).source.camera.central == PinholeCamera(130.5, 131.5, 81.25, 62.75, *STEREO_SIZE)


@pytest.mark.parametrize(("first", "separator"), [(0, ","), (1, " "), (1, "\t")])
def test_every_form_of_the_kinematics(first: int, separator: str, tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    write_kinematics(folder / "groundtruth.txt", first, FRAMES, separator)
    (folder / "groundtruth.txt").write_text("# a comment\n\n" + (folder / "groundtruth.txt").read_text())
    poses = open_sequence(folder).source.poses
    np.testing.assert_allclose([poses[i] for i in range(FRAMES)], [kinematic_pose(i) for i in range(FRAMES)], atol=1e-6)
    assert FRAMES not in poses


def test_frames_without_a_pose_and_without_any(tmp_path: Path) -> None:
    folder = write_stereomis(tmp_path / "P1")
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    kept = [lines[4], lines[0], "1 nan nan nan nan nan nan nan", lines[2].replace("0.002", "inf"), lines[3]]
    (folder / "groundtruth.txt").write_text("\n".join(kept))
    assert sorted(open_sequence(folder).source.poses) == [0, 3, 4]
    (folder / "groundtruth.txt").unlink()
    sequence = open_sequence(folder)
    assert reference_trajectory(sequence) is None
    assert any("no pose is known" in note for note in sequence.notes)


# ---- EndoMapper


@pytest.mark.parametrize("number", ["1", "01", "Endoscope_01", "N/A", "", None])
def test_forms_of_the_endoscopes_number(number: object, tmp_path: Path) -> None:
    sequence = open_sequence(write_endomapper(tmp_path, number))
    assert sequence.calibrated == (number not in ("N/A", "", None))
    assert reference_trajectory(sequence) is None
    assert any("no pose is known" in note for note in sequence.notes)
    if not sequence.calibrated:
        assert any("no calibration: Seq_001_info.json names no endoscope" in note for note in sequence.notes)
        (sequence.path / "Endoscope_07_geometrical.xml").write_text(xml((90.0, *KB4[1:])))
        assert open_sequence(sequence.path).source.camera.central.fx == 90.0


def test_a_video_of_another_name_beside_a_calibration_of_another_size(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    (folder / "Seq_001.mov").rename(folder / "clip.mov")
    assert not open_sequence(folder / "clip.mov").calibrated
    text = xml((160.0, 162.0, 161.5, 119.5, *KB4[4:]), size=(320, 240))
    (folder / "Endoscope_01_geometrical.xml").write_text(text)
    source = open_sequence(folder).source
    assert source.camera == FisheyeCamera(PinholeCamera(80.0, 81.0, 80.5, 59.5, *SCOPE_SIZE), KB4[4:])


def test_poses_of_the_largest_sub_model(tmp_path: Path) -> None:
    folder = write_endomapper(tmp_path)
    # The second and the third have most images; the first has the longest file, as it has more points.
    nan = images_bin([4], quaternion=(np.nan,) * 4)
    chosen = struct.pack("<Q", 4) + images_bin([2, 6, 3])[8:] + nan[8:]
    write_models(archive_of(folder), {0: images_bin([90, 91]), 4: chosen, 10: images_bin([1, 2, 3, 5])})
    sequence = open_sequence(folder)
    # out2.png is frame 1; x_camera = R x_world + t, half a turn about z: the centre is -R^T t = (tx, ty, -tz).
    centres = {index: pose[:3, 3].tolist() for index, pose in sequence.source.poses.items()}
    assert centres == {1: [2.0, 2.0, 3.0], 5: [6.0, 2.0, 3.0], 2: [3.0, 2.0, 3.0]}
    assert any("sub-model 4, the largest of 3: 3 frames; its scale is arbitrary" in note for note in sequence.notes)


# ---- CLiMB


def test_the_clip_may_be_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_clip(tmp_path)
    shutil.move(tmp_path / "Seq_001_a.mp4", folder)
    monkeypatch.chdir(folder)
    for path in (folder, tmp_path, Path()):
        assert open_sequence(path).source.name == "climb"


def test_a_reference_alone_is_a_truth_but_no_input(tmp_path: Path) -> None:
    folder = write_reference(tmp_path, path_of(6))
    np.testing.assert_allclose(read_reference(folder).T_world_camera, path_of(6), atol=1e-9)
    with pytest.raises(InputError):
        open_sequence(folder)


def test_what_is_missing_or_too_much_is_reported(tmp_path: Path) -> None:
    folder = write_clip(tmp_path)
    shutil.rmtree(folder / "results_txt")
    (tmp_path / "scales.csv").unlink()
    write_reference(tmp_path / "longer", path_of(8), scale=None)
    shutil.move(tmp_path / "longer" / "Seq_001_a" / "results_txt", folder)
    (folder / "Seq_001_info.json").unlink()
    sequence = open_sequence(folder)
    (warning,) = sequence.warnings
    assert "Seq_001_a.mp4: 2 of 8 poses belong to frames beyond the 6 of the video" in warning
    assert any("scale unknown" in note for note in sequence.notes)
    assert any("no calibration: Seq_001_info.json is missing" in note for note in sequence.notes)


def test_the_plan_finds_the_clips_and_imports_submaps_of_another_system(tmp_path: Path) -> None:
    folder, poses = write_clip(tmp_path), path_of(6)
    write_reference(tmp_path, path_of(6), clip="Seq_002_a")
    found, missing = found_sequences(read_plan("climb"), tmp_path)
    assert ([sequence.path for sequence in found], missing) == (["Seq_001_a"], [])
    write_foreign_run(tmp_path / "theirs/Seq_001_a/1", (poses[:3], [1, 2, 3]), (poses[3:], [4, 5, 6]))
    plan = MethodPlan(name="theirs", use="import", files="theirs/{sequence}/1")
    create_method(plan, tmp_path, "Seq_001_a").run(open_sequence(folder), {}, tmp_path / "run")
    submaps = read_trajectory(tmp_path / "run")
    tracked = [submap.indices[submap.tracked].tolist() for submap in (submaps, *submaps.others)]
    assert tracked == [[0, 1, 2], [3, 4, 5]]
    np.testing.assert_allclose(submaps.others[0].T_world_camera, poses[3:], atol=1e-6)


# ---- tables of Unity: EndoSLAM rendered, EndoMapper simulated


def test_five_digits_sort_as_numbers_and_later_images_follow_the_last_row(tmp_path: Path) -> None:
    source = open_sequence(write_unity(tmp_path / "UnityCam" / "Colon", (3, 10000, 9999, 2))).source
    assert [number_in(frame.rgb) for frame in source.frames(slice(None))] == [2, 3, 39, 0]
    np.testing.assert_allclose(source.pose(3)[:3, 3], [690, -9010, -3100])
    assert source.pose(9999) is None
    assert source.stamps(slice(None))[3][1] == pytest.approx(1 + 3 * 0.0333334 + 9997 / 30)
    assert any("holds 4 rows for 4 images; 2 images have no pose" in warning for warning in source.warnings)


def test_a_rendered_organ_in_repeated_folders_and_with_depth_of_one_channel(tmp_path: Path) -> None:
    organ = write_unity(tmp_path / "EndoSLAM" / "UnityCam" / "UnityCam" / "Colon", again=True)
    write_image(organ / "Depths" / "Pixelwise Depths" / "aov_image_0003.png", levels(np.uint8, 3, 255, (96, 96)))
    for up in (organ, organ.parent, tmp_path):
        source = open_sequence(up).source
        assert (source.path, source.truth(0).depth_mm[50, 0]) == (organ, 400)
    np.testing.assert_allclose(source.truth(3).depth_mm[[0, 50, -1], 0], [np.nan, 30, np.nan])
    assert np.isnan(source.truth(0).depth_mm[10:20]).all()
    np.testing.assert_array_equal(source.camera.matrix, UNITY_K)
    (organ.parent / "Calibration" / "cam.txt").unlink()
    for number in range(4):
        write_picture(organ / "Frames" / "Frames" / f"image_{number:04d}.png", number, (320, 320))
    camera = open_sequence(organ).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (156.0418, 155.7529, 178.5604, 181.8043)


@pytest.mark.parametrize("sim", [True, False])
def test_a_row_of_nan_is_no_pose_and_keeps_its_place(sim: bool, tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0") if sim else write_unity(tmp_path / "UnityCam" / "Colon")
    sign, header = (";", SIM_HEADER) if sim else (",", UNITY_HEADER)
    rows = [unity_row(n, sign) for n in range(4)]
    rows[1] = sign.join(["nan"] * 8) + "\n"
    file = folder / ("trajectory.csv" if sim else "Poses/colon_position_rotation.csv")
    file.write_text(header + "\n" + "".join(rows))
    source = open_sequence(folder).source
    assert [source.pose(n) is None for n in range(4)] == [False, True, False, False]
    assert source.truth(1).depth_mm is not None
    assert source.stamps(slice(1, 2))[0][1] == pytest.approx(1.0333334)


def test_a_part_of_a_simulation_keeps_its_rows_and_times_must_increase(tmp_path: Path) -> None:
    folder = write_sim(tmp_path / "Seq_0", first=2)
    reference = reference_trajectory(open_sequence(folder))
    np.testing.assert_array_equal(reference.indices, [2, 3])
    np.testing.assert_allclose(reference.positions_mm, [[68, -900, -311], [69, -901, -310]], atol=1e-6)
    (folder / "trajectory.csv").write_text(SIM_HEADER + "\n" + unity_row(1, ";") * 4)
    assert open_sequence(folder).source.stamps(slice(None)) == [(2, 2 / 30), (3, 3 / 30)]
    (folder / "trajectory.csv").unlink()
    with pytest.raises(InputError, match=r"trajectory\.csv"):
        endomapper_sim.EndoMapperSimFolder(folder)


def test_a_simulations_calibration_depth_of_another_size_and_missing_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_sim(tmp_path / "Seq_0")
    (folder / "calibration.txt").write_text("fx: 500\nfy: 501\ncx: 470\ncy: 350\n\ncols: 960\nrows: 720\n")
    write_depth_exr(folder / "depth" / "aov_image_0001.exr", buffer((48, 36)))
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.camera.matrix, [[50, 0, 46.55], [0, 50.1, 34.55], [0, 0, 1]])
    assert sequence.source.truth(1).depth_mm.shape == (36, 48)
    np.testing.assert_allclose(sequence.source.truth(0).depth_mm[:3, 0], [np.nan, np.nan, 400], rtol=1e-6)
    monkeypatch.setattr(endomapper_sim, "find_spec", lambda name: None)
    sequence = open_sequence(folder)
    assert sequence.source.truth(0).depth_mm is None
    assert any("pip install -e bench" in warning for warning in sequence.warnings)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("names", ["RGB", "ABGR", "Y"])
def test_the_red_channel_is_read_exactly(half: bool, names: str, tmp_path: Path) -> None:
    values = np.random.default_rng(1).random((40, 50)).astype(np.float16 if half else np.float32)
    write_exr(tmp_path / "a.exr", {name: values if name in "RY" else values + 1 for name in names}, half)
    read = read_exr_red(tmp_path / "a.exr")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, values.astype(np.float32))


def test_an_exr_file_that_is_none_is_one_sentence(tmp_path: Path) -> None:
    file = tmp_path / "a.exr"
    whole = write_exr(file, {"R": buffer(), "G": buffer(), "B": buffer()})
    window = struct.pack("<4i", 0, 0, 95, 71)
    damaged = [b"", b"no picture at all", whole[:60], whole[: len(whole) // 2], whole[:-1]]
    damaged += [whole.replace(window, struct.pack("<4i", 0, 0, -1, 71)), whole.replace(b"dataWindow", b"dataWindov")]
    damaged += [write_exr(file, {"G": buffer()})]
    for content in damaged:
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.exr: no OpenEXR image with a channel R or Y") as caught:
            read_exr_red(file)
        assert "\n" not in str(caught.value)
    file.write_bytes(whole.replace(window, struct.pack("<4i", 0, 0, 99999, 99999)))
    with pytest.raises(InputError, match=r"a\.exr: .*more than 64 million pixels"):
        read_exr_red(file)


# ---- EndoSLAM, held by a robot


def test_a_real_trajectory_is_joined_by_image_frame(tmp_path: Path) -> None:
    camera = tmp_path / "Cameras" / "HighCam"
    folder = write_real(camera / "Stomach-I" / "TumorfreeTrajectory_1", rows=(63, 60))
    (camera / "Calibration").mkdir()
    (camera / "Calibration" / "cam.txt").write_text(",".join(f"{x:g}" for x in UNITY_K.ravel()))
    for name in ("~$poses.xlsx", "._poses.xlsx"):
        (folder / "Poses" / name).write_bytes(b"lock")
    sequence = open_sequence(camera)
    assert sequence.path == folder
    np.testing.assert_array_equal(sequence.camera.matrix, UNITY_K)
    assert [sequence.source.pose(n) is None for n in (60, 61, 63)] == [False, True, False]
    assert sequence.source.pose(63)[0, 3] == pytest.approx(243)
    assert sequence.warnings == ["poses.xlsx holds 2 rows for 3 images; 1 images have no pose"]


def test_the_rate_is_that_of_the_camera_in_the_path(tmp_path: Path) -> None:
    write_real(tmp_path / "MiroCam" / "Colon-I" / "TumorfreeTrajectory_1")
    source = open_sequence(tmp_path / "MiroCam").source
    assert source.stamps(slice(None)) == [(60, 20.0), (61, pytest.approx(61 / 3)), (63, 21.0)]


def test_empty_cells_are_no_pose_and_empty_rows_nothing(tmp_path: Path) -> None:
    folder = write_real(tmp_path / "TumorfreeTrajectory_2")
    lacking = robot_row(61)
    lacking[5] = None
    rows = [[row[0], *row[:0:-1]] for row in (robot_row(60), lacking, [None] * 10, robot_row(63))]
    write_xlsx(folder / "Poses" / "poses.xlsx", [["", *SHEET_COLUMNS[::-1]], *rows])
    source = open_sequence(folder).source
    assert [source.pose(i) is None for i in (60, 61, 63)] == [False, True, False]
    np.testing.assert_allclose(source.pose(63)[:3, 3], [243, -200, 450])
