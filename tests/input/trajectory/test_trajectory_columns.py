"""Headers, time stamps and units of trajectory files: every order of columns and unit of time gives the same poses."""

from __future__ import annotations

import csv
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PosePath3D
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import InputError
from scopemap.input.trajectory.trajectory import Trajectory, write_tum
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.datasets.tum import read_stamped
from tests.support.drawn_run import draw_run
from tests.support.front_door import call
from tests.support.sample_trajectories import as_trajectory, vector_a

EUROC = "timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
_BEHIND = (("v_RS_R", "m s^-1"), ("b_w_RS_S", "rad s^-1"), ("b_a_RS_S", "m s^-2"))
STATE = "".join(f",{name}_{axis} [{unit}]" for name, unit in _BEHIND for axis in "xyz")
EPOCH_NS = 1_403_636_579_763_555_584
STEP_NS = 33_333_333


@pytest.fixture
def truth() -> Trajectory:
    return as_trajectory(vector_a()[1])


def rows(truth: Trajectory, *, w_first: bool, unit: str = "m") -> list[list[float]]:
    """Position and quaternion of each pose."""
    xyzw = Rotation.from_matrix(truth.T_world_camera[:, :3, :3]).as_quat()
    positions = truth.positions_mm / {"m": 1000, "mm": 1}[unit]
    return np.hstack([positions, np.roll(xyzw, 1, axis=1) if w_first else xyzw]).tolist()


def write(file: Path, header: str, stamps: list[str], values: list[list[float]], separator: str = ",") -> Path:
    lines = [separator.join([stamp, *map(repr, row)]) for stamp, row in zip(stamps, values, strict=True)]
    file.write_text("\n".join([header, *lines] if header else lines) + "\n")
    return file


def ns(start: int = EPOCH_NS, count: int = 60) -> list[str]:
    return [str(start + STEP_NS * number) for number in range(count)]


def evaluate(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[dict, str]:
    capfd.readouterr()
    assert call("evaluate", *arguments, "--json") == 0
    said = capfd.readouterr()
    return json.loads(said.out), said.err


# ---- headers


@pytest.mark.parametrize(
    ("header", "w_first", "unit"),
    [
        ("#" + EUROC, True, "m"),
        (EUROC, True, "m"),
        ("# timestamp tx ty tz qw qx qy qz", True, "m"),
        ("timestamp,tx,ty,tz,qw,qx,qy,qz", True, "m"),
        ("# x y z qw qx qy qz", True, "m"),
        ("# timestamp gt_x gt_y gt_z gt_qw gt_qx gt_qy gt_qz", True, "m"),
        ("# timestamp world_x world_y world_z qw qx qy qz", True, "m"),
        ("# timestamp tx_mm ty_mm tz_mm qw qx qy qz", True, "mm"),
        ("# units: mm\n# timestamp tx ty tz qw qx qy qz", True, "mm"),
        ("# timestamp tx ty tz qx qy qz qw", False, "m"),
        ("Time;Pos.X [mm];Pos.Y [mm];Pos.Z [mm];Quat.X;Quat.Y;Quat.Z;Quat.W", False, "mm"),
        ("%time,position.x,position.y,position.z,orientation.w,orientation.x,orientation.y,orientation.z", True, "m"),
    ],
)
def test_a_header_names_the_columns_and_their_unit(
    tmp_path: Path, truth: Trajectory, header: str, w_first: bool, unit: str
) -> None:
    stamps = [f"{time_s:.6f}" for time_s in truth.times_s]
    found = read_trajectory(
        write(tmp_path / "a.csv", header.replace("[ns]", "[s]"), stamps, rows(truth, w_first=w_first, unit=unit))
    )
    np.testing.assert_allclose(found.T_world_camera, truth.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(found.times_s, truth.times_s, atol=1e-6)


def test_columns_in_any_place_are_found_by_name(tmp_path: Path, truth: Trajectory) -> None:
    values = rows(truth, w_first=True)
    table = [
        [f"{q!r}" for q in row[3:]] + [str(7), str(n)] + [f"{p!r}" for p in row[:3]] for n, row in enumerate(values)
    ]
    with (tmp_path / "a.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["qw", "qx", "qy", "qz", "inliers", "frame", "tx", "ty", "tz"], *table])
    found = read_trajectory(tmp_path / "a.csv")
    np.testing.assert_allclose(found.T_world_camera, truth.T_world_camera, atol=1e-9)
    assert found.indices.tolist() == list(range(60))
    assert "columns" in found.source
    assert "by its header" in found.source


def test_a_unit_that_is_not_read_is_refused(tmp_path: Path, truth: Trajectory) -> None:
    header = "time,tx [cm],ty [cm],tz [cm],qw,qx,qy,qz"
    with pytest.raises(InputError, match="states positions in 'cm'"):
        read_trajectory(write(tmp_path / "a.csv", header, ns(), rows(truth, w_first=True)))


def test_a_header_that_does_not_fit_its_rows_is_refused(tmp_path: Path, truth: Trajectory) -> None:
    file = write(tmp_path / "a.txt", "# timestamp tx ty tz qw qx qy qz cost", ns(), rows(truth, w_first=True), " ")
    with pytest.raises(InputError, match=r"a\.txt, line 2: found 8 numbers where the header names 9 columns; correct"):
        read_trajectory(file)


def test_a_data_sets_poses_follow_their_header_too(tmp_path: Path, truth: Trajectory) -> None:
    values = rows(truth, w_first=True)
    table = read_stamped(write(tmp_path / "groundtruth.txt", "# timestamp tx ty tz qw qx qy qz", ns(0), values, " "))
    np.testing.assert_allclose(table.values[:, 4:], np.roll([row[3:] for row in values], -1, axis=1))


# ---- EuRoC


@pytest.mark.parametrize("more", [False, True])
@pytest.mark.parametrize("header", [True, False])
def test_euroc_is_read_as_evo_reads_it(tmp_path: Path, truth: Trajectory, more: bool, header: bool) -> None:
    values = [row + [0.1 * n for n in range(9)] * more for row in rows(truth, w_first=True)]
    file = write(tmp_path / "data.csv", f"#{EUROC}{STATE * more}" * header, ns(), values)
    theirs = file_interface.read_euroc_csv_trajectory(str(file))
    kinds = ["euroc"] if not (header or more) else ["auto", "euroc"]  # 8 bare numbers are TUM's
    for kind in kinds:
        found = read_trajectory(file, kind=kind)
        np.testing.assert_allclose(found.positions_mm, 1000 * theirs.positions_xyz, atol=1e-9)
        np.testing.assert_allclose(found.T_world_camera[:, :3, :3], np.stack(theirs.poses_se3)[:, :3, :3], atol=1e-9)
        np.testing.assert_allclose(found.times_s, theirs.timestamps, atol=1e-6)
    assert "stamps are nanoseconds" in found.source


def test_the_folder_of_a_euroc_recording_holds_its_truth(tmp_path: Path, truth: Trajectory) -> None:
    place = tmp_path / "mav0/state_groundtruth_estimate0"
    place.mkdir(parents=True)
    write(place / "data.csv", "#" + EUROC, ns(), rows(truth, w_first=True))
    np.testing.assert_allclose(read_trajectory(tmp_path).T_world_camera, truth.T_world_camera, atol=1e-9)


def test_eurocs_truth_against_orb_slam3(tmp_path: Path, truth: Trajectory, capfd: pytest.CaptureFixture[str]) -> None:
    true = write(tmp_path / "truth.csv", "#" + EUROC, ns(), rows(truth, w_first=True))
    stamps = [f"{stamp}.000000" for stamp in ns()]
    slam = write(tmp_path / "CameraTrajectory.txt", "", stamps, rows(truth, w_first=False), " ")
    figures, said = evaluate(capfd, slam, "--truth", true)
    assert figures["tracked"] == 60
    assert figures["ate_rmse_mm"] < 1e-6
    assert figures["rotation_max_deg"] < 1e-4
    assert "doubts" not in figures
    assert said == ""


# ---- time stamps


@pytest.mark.parametrize("power", [3, 6, 9])
@pytest.mark.parametrize("start_s", [0, 1_403_636_579.75])
def test_smaller_units_of_time_are_recognised(tmp_path: Path, truth: Trajectory, power: int, start_s: float) -> None:
    """From a second of the epoch on; from zero by steps that no frame numbers have, which leaves milliseconds out."""
    times_s = start_s + np.arange(60) / 30
    stamps = [str(round(time_s * 10**power)) for time_s in times_s]
    found = read_trajectory(write(tmp_path / "a.txt", "", stamps, rows(truth, w_first=False), " "))
    if power > 3 or start_s:
        assert not found.has_indices
        np.testing.assert_allclose(found.times_s, times_s, atol=6e-4)
    stated = read_trajectory(
        write(tmp_path / "b.txt", f"# time: {['m', 'u', 'n'][power // 3 - 1]}s", stamps, rows(truth, w_first=False))
    )
    np.testing.assert_allclose(stated.times_s, times_s, atol=6e-4)


def test_numbers_of_frames_stay_numbers(tmp_path: Path, truth: Trajectory) -> None:
    for step in (1, 10, 1000):
        stamps = [str(step * n) for n in range(60)]
        found = read_trajectory(write(tmp_path / "a.txt", "", stamps, rows(truth, w_first=False), " "))
        assert found.indices.tolist() == [step * n for n in range(60)]


def test_c3vds_times_may_be_nanoseconds(tmp_path: Path, truth: Trajectory) -> None:
    values = [T.T.ravel().tolist() for T in truth.T_world_camera]
    found = read_trajectory(write(tmp_path / "pose.txt", "", ns(), values))
    assert "C3VD" in found.source
    np.testing.assert_allclose(np.diff(found.times_s), STEP_NS / 1e9, atol=1e-6)


# ---- our own files


@pytest.mark.parametrize("to", ["euroc", "tum", "kitti"])
def test_a_run_agrees_with_its_own_export(tmp_path: Path, to: str, capfd: pytest.CaptureFixture[str]) -> None:
    run = draw_run(tmp_path / "result")
    file = tmp_path / ("data.csv" if to == "euroc" else "path.txt")
    assert call("export", run, "--to", to, "--out", file, "--quiet") == 0
    for one, other in ((run, file), (file, run), (run / "trajectory.tum", file)):
        if to == "kitti" and one != run:
            continue  # has no times
        figures, said = evaluate(capfd, one, "--truth", other, "--align", "none")
        assert figures["ate_rmse_mm"] < 1e-5
        assert figures["rotation_max_deg"] < 1e-4
        assert figures["tlr"] == pytest.approx(1)
        assert "doubts" not in figures, said


# ---- units


def test_a_plain_tum_file_is_metres_as_evo_has_it(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """RMSE of positions without alignment, in mm, by evo and by `evaluate`."""
    true = vector_a()[1]
    noisy = true.copy()
    noisy[:, :3, 3] = true[:, :3, 3] + 0.05 * np.sin(np.arange(180).reshape(60, 3))
    files = [tmp_path / "estimate.txt", tmp_path / "truth.txt"]
    for file, poses in zip(files, (noisy, true), strict=True):
        write(file, "", [f"{n / 30:.6f}" for n in range(60)], rows(as_trajectory(poses), w_first=False), " ")
    theirs, truth = (file_interface.read_tum_trajectory_file(str(file)) for file in files)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        error.process_data(sync.associate_trajectories(truth, theirs))
    expected_mm = 1000 * error.get_statistic(metrics.StatisticsType.rmse)
    figures, said = evaluate(capfd, files[0], "--truth", files[1], "--align", "none")
    assert figures["ate_rmse_mm"] == pytest.approx(expected_mm, rel=1e-6)
    assert figures["sources"]["truth"].startswith("TUM, camera-to-world, m (assumed)")
    assert said == ""
    path = PosePath3D(poses_se3=list(read_trajectory(files[1]).T_world_camera))
    assert path.path_length == pytest.approx(1000 * truth.path_length)


def test_our_own_file_is_mm_because_it_says_so(tmp_path: Path, truth: Trajectory) -> None:
    write_tum(tmp_path / "trajectory.tum", truth)
    lines = (tmp_path / "trajectory.tum").read_text().splitlines()
    assert any("unit: mm" in line for line in lines)
    for unit in (None, "m", "mm"):
        found = read_trajectory(tmp_path / "trajectory.tum", unit=unit)
        np.testing.assert_allclose(found.positions_mm, truth.positions_mm, atol=1e-8)
    bare = "\n".join(line for line in lines if not line.startswith("#"))
    (tmp_path / "bare.txt").write_text(bare)
    np.testing.assert_allclose(read_trajectory(tmp_path / "bare.txt").positions_mm, 1000 * truth.positions_mm)
    np.testing.assert_allclose(read_trajectory(tmp_path / "bare.txt", unit="mm").positions_mm, truth.positions_mm)


# ---- text that is none, or of another country


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_in_any_usual_encoding(encoding: str, truth: Trajectory, tmp_path: Path) -> None:
    stamps = [f"{number / 30:.6f}" for number in range(60)]
    plain = write(tmp_path / "plain.txt", "", stamps, rows(truth, w_first=False), " ")
    (tmp_path / "other.txt").write_bytes(plain.read_text().encode(encoding))
    assert np.array_equal(read_trajectory(tmp_path / "other.txt").positions_mm, read_trajectory(plain).positions_mm)


@pytest.mark.parametrize("separator", [" ", ";", "\t"])
@pytest.mark.parametrize("form", ["tum", "kitti"])
def test_decimal_commas_are_named(separator: str, form: str, truth: Trajectory, tmp_path: Path) -> None:
    stamps = [f"{number / 30:.6f}" for number in range(60)]
    values = rows(truth, w_first=False) if form == "tum" else truth.T_world_camera[:, :3].reshape(-1, 12).tolist()
    lines = [
        ([stamp] if form == "tum" else []) + [f"{value:.6f}" for value in row]
        for stamp, row in zip(stamps, values, strict=True)
    ]
    (tmp_path / "commas.txt").write_text("\n".join(separator.join(line).replace(".", ",") for line in lines))
    with pytest.raises(InputError, match=r"line 1: it has decimal commas .*: write points"):
        read_trajectory(tmp_path / "commas.txt")


def test_decimal_commas_beside_whole_powers_are_named(tmp_path: Path) -> None:
    """As German and French spreadsheets save a table: semicolons, and 1E-05 without a comma."""
    file = tmp_path / "excel.csv"
    file.write_text("timestamp;tx;ty;tz;qx;qy;qz;qw\n0,5;1,25;1E-05;-2E+00;0;0;0;1\n")
    with pytest.raises(InputError, match=r"line 2: it has decimal commas .*: write points"):
        read_trajectory(file)


@pytest.mark.parametrize("content", [b"\x93NUMPY\x01\x00\xff", b'{"frames": []}', b"x,y,z\n1,2,3"])
def test_what_is_no_text_of_poses_is_one_sentence_of_ours(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "poses.dat").write_bytes(content)
    with pytest.raises(InputError) as refused:
        read_trajectory(tmp_path / "poses.dat")
    assert not {"codec", "could not convert", "byte 0x"} & set(str(refused.value).split("'"))
    assert "no text" in str(refused.value) or "expected numbers, found" in str(refused.value)


def test_nanoseconds_with_decimals_are_no_seconds(truth: Trajectory, tmp_path: Path) -> None:
    stamps = [f"{number * 1e9 / 30:.6f}" for number in range(60)]
    found = read_trajectory(write(tmp_path / "orb.txt", "", stamps, rows(truth, w_first=False), " "))
    assert found.times_s == pytest.approx(np.arange(60) / 30)
