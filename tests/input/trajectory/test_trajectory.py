"""Trajectory files: every form is read back as the poses that were written, bad input is named with its line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import se3_exp
from scopemap.input.trajectory.trajectory import Trajectory, write_kitti, write_tum
from scopemap.result.trajectories import read_trajectory
from tests.support.sample_trajectories import write_c3vd, write_run


@pytest.fixture
def trajectory() -> Trajectory:
    rng = np.random.default_rng(0)
    twists = np.hstack([rng.normal(size=(6, 3)), rng.normal(scale=80, size=(6, 3))])
    status = np.array(["initial", "ok", "lost", "lost", "ok", "ok"])
    poses = np.stack([se3_exp(twist) for twist in twists])
    poses[2:4] = np.nan
    return Trajectory(np.array([0, 2, 4, 6, 8, 11]), np.array([0, 2, 4, 6, 8, 11]) / 25, poses, status)


def test_run_folder_gives_back_indices_and_lost_frames(tmp_path: Path, trajectory: Trajectory) -> None:
    write_run(tmp_path, trajectory)
    found = read_trajectory(str(tmp_path))
    np.testing.assert_array_equal(found.indices, trajectory.indices)
    np.testing.assert_array_equal(found.status, trajectory.status)
    np.testing.assert_allclose(found.T_world_camera, trajectory.T_world_camera, atol=1e-7)
    assert found.has_indices


def test_run_folder_whose_files_do_not_fit_is_refused(tmp_path: Path, trajectory: Trajectory) -> None:
    write_run(tmp_path, trajectory)
    table = (tmp_path / "frames.csv").read_text()
    for changed in (table.rsplit("\n", 2)[0], table.replace("0.080000", "0.120000"), table.replace("lost", "gone")):
        (tmp_path / "frames.csv").write_text(changed)
        with pytest.raises(InputError, match=r"same run|status"):
            read_trajectory(tmp_path)
    (tmp_path / "frames.csv").write_text(table.replace("time_s", "seconds"))
    with pytest.raises(InputError, match="index, time_s and status"):
        read_trajectory(tmp_path)


def test_tum_holds_tracked_frames_alone_and_says_what_its_poses_are(tmp_path: Path, trajectory: Trajectory) -> None:
    write_tum(tmp_path / "a.tum", trajectory, comment="scale unknown")
    lines = (tmp_path / "a.tum").read_text().splitlines()
    head = " ".join(line for line in lines if line.startswith("#"))
    for words in ("4 tracked frames of 6", "camera-to-world", "OpenCV", "unit: mm", "time: s", "scale unknown"):
        assert words in head
    stamps = [float(line.split()[0]) for line in lines if not line.startswith("#")]
    np.testing.assert_allclose(stamps, np.array([0, 2, 8, 11]) / 25, atol=1e-6)
    poses = file_interface.read_tum_trajectory_file(tmp_path / "a.tum")
    np.testing.assert_allclose(poses.poses_se3, trajectory.T_world_camera[[0, 1, 4, 5]], atol=1e-7)


def test_runs_of_earlier_versions_with_a_line_per_lost_frame_are_read(tmp_path: Path, trajectory: Trajectory) -> None:
    write_run(tmp_path, trajectory)
    held = trajectory.T_world_camera[[0, 1, 1, 1, 4, 5]]
    every = replace(trajectory, T_world_camera=held, status=np.array(["initial"] + ["ok"] * 5))
    write_tum(tmp_path / "trajectory.tum", every)
    found = read_trajectory(tmp_path)
    np.testing.assert_array_equal(found.tracked, trajectory.tracked)
    np.testing.assert_allclose(found.T_world_camera, trajectory.T_world_camera, atol=1e-7)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_tum_says_its_unit_and_its_times(tmp_path: Path, trajectory: Trajectory, unit: str) -> None:
    write_tum(tmp_path / "a.tum", trajectory, unit=unit)
    numbers = np.loadtxt(tmp_path / "a.tum")
    assert numbers.shape == (4, 8)
    assert np.all(numbers[:, 7] >= 0)
    tracked = trajectory.rows(trajectory.tracked)
    np.testing.assert_allclose(numbers[:, 1:4] * {"mm": 1, "m": 1000}[unit], tracked.positions_mm, atol=1e-5)
    # The header wins over what the caller assumes.
    found = read_trajectory(tmp_path / "a.tum", unit="m" if unit == "mm" else "mm")
    np.testing.assert_allclose(found.T_world_camera, tracked.T_world_camera, atol=1e-5)
    np.testing.assert_allclose(found.times_s, tracked.times_s, atol=1e-6)
    assert not found.has_indices


def test_our_tum_with_whole_seconds_is_not_taken_for_frame_numbers(tmp_path: Path, trajectory: Trajectory) -> None:
    whole = Trajectory(trajectory.indices, np.arange(6.0), trajectory.T_world_camera, trajectory.status)
    write_tum(tmp_path / "a.tum", whole)
    assert not read_trajectory(tmp_path / "a.tum").has_indices
    lines = (tmp_path / "a.tum").read_text().splitlines()
    body = "\n".join(line for line in lines if not line.startswith("#"))
    (tmp_path / "foreign.tum").write_text(body)
    foreign = read_trajectory(tmp_path / "foreign.tum")
    assert foreign.has_indices
    assert foreign.indices.tolist() == [0, 1, 4, 5]
    # Seconds since 1970 are no frame numbers.
    (tmp_path / "a.tum").write_text("1403636579 0 0 0 0 0 0 1\n1403636580 0 0 0 0 0 0 1\n")
    assert not read_trajectory(tmp_path / "a.tum").has_indices


def test_foreign_tum_is_sorted_and_scaled(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# from elsewhere\n0.5 1 2 3 0 0 0 1\n\n0.25, 4, 5, 6, 0, 0, 0, -1 # late\n")
    found = read_trajectory(tmp_path / "a.txt", unit="m")
    np.testing.assert_allclose(found.times_s, [0.25, 0.5])
    np.testing.assert_allclose(found.positions_mm, [[4000, 5000, 6000], [1000, 2000, 3000]])
    np.testing.assert_allclose(found.T_world_camera[:, :3, :3], np.stack([np.eye(3)] * 2), atol=1e-15)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_kitti_round_trip(tmp_path: Path, trajectory: Trajectory, unit: str) -> None:
    tracked = trajectory.rows(trajectory.tracked)
    write_kitti(tmp_path / "a.txt", tracked, unit=unit)
    found = read_trajectory(tmp_path / "a.txt", unit=unit)
    np.testing.assert_allclose(found.T_world_camera, tracked.T_world_camera, atol=1e-8)
    if unit == "mm":
        theirs = file_interface.read_kitti_poses_file(str(tmp_path / "a.txt"))
        np.testing.assert_allclose(theirs.poses_se3, tracked.T_world_camera, atol=1e-8)
    assert found.indices.tolist() == list(range(4))
    np.testing.assert_allclose(found.times_s, np.arange(4) / 30)


def test_c3vd_in_both_forms_and_with_a_pose_at_the_origin(tmp_path: Path, trajectory: Trajectory) -> None:
    poses = trajectory.T_world_camera[trajectory.tracked]
    poses[0, :3, 3] = 0  # ambiguous alone: the form is decided over the whole file
    stored, row_major = tmp_path / "pose.txt", tmp_path / "row_major.txt"
    write_c3vd(tmp_path, poses, digits=6)
    row_major.write_text("# row-major\n" + "".join(" ".join(f"{x:.6g}" for x in T.ravel()) + "\n" for T in poses))
    for path in (stored, row_major, tmp_path):
        found = read_trajectory(path)
        np.testing.assert_allclose(found.T_world_camera, poses, atol=2e-3)
        # Six digits in the file, exact rotations inside.
        R = found.T_world_camera[:, :3, :3]
        np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.stack([np.eye(3)] * 4), atol=1e-12)


@pytest.mark.parametrize("kind", ["auto", "c3vd"])
@pytest.mark.parametrize("separator", [",", " ", ", "])
@pytest.mark.parametrize(
    ("stamps", "indices"),
    [((0.0, 0.034, 0.067, 0.134), None), ((3, 0, 1, 10), [0, 1, 3, 10]), ((7e9, 1.5, 2, 3), None)],
)
def test_c3vd_with_the_time_first(
    tmp_path: Path,
    trajectory: Trajectory,
    stamps: tuple[float, ...],
    indices: list[int] | None,
    separator: str,
    kind: str,
) -> None:
    """C3VDv3's renderer: time, then the matrix column by column."""
    poses = trajectory.T_world_camera[trajectory.tracked]
    rows = [[stamp, *T.T.ravel()] for stamp, T in zip(stamps, poses, strict=True)]
    (tmp_path / "pose.txt").write_text("".join(separator.join(map(repr, map(float, row))) + "\n" for row in rows))
    for path in (tmp_path / "pose.txt", tmp_path):
        found = read_trajectory(path, kind=kind, unit="m")
        np.testing.assert_allclose(found.T_world_camera, poses[np.argsort(stamps)], atol=1e-9)
        assert found.has_indices == (indices is not None)
        assert indices is None or found.indices.tolist() == indices
        assert indices is not None or found.times_s.tolist() == sorted(stamps)


def test_c3vds_times_may_not_repeat(tmp_path: Path, trajectory: Trajectory) -> None:
    rows = [[0.5, *T.T.ravel()] for T in trajectory.T_world_camera[trajectory.tracked]]
    np.savetxt(tmp_path / "pose.txt", rows, delimiter=",")
    with pytest.raises(InputError, match=r"pose\.txt, line 2: the time stamp of an earlier line is repeated"):
        read_trajectory(tmp_path)


def test_seven_scenes_is_metres_and_numbered_by_file(tmp_path: Path, trajectory: Trajectory) -> None:
    poses = trajectory.T_world_camera[[0, 1, 4]]
    for number, T in zip((3, 10, 100), poses, strict=True):
        metres = T.copy()
        metres[:3, 3] /= 1000
        np.savetxt(tmp_path / f"frame-{number:06d}.pose.txt", metres)
    found = read_trajectory(tmp_path)
    assert found.indices.tolist() == [3, 10, 100]
    np.testing.assert_allclose(found.T_world_camera, poses, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "wanted"), [("tum", 8), ("kitti", 12), ("c3vd", 16), ("oneslam", 8), ("bodyslam", 12)]
)
def test_a_named_kind_must_fit(tmp_path: Path, kind: str, wanted: int) -> None:
    (tmp_path / "a.txt").write_text("# three\n1 2 3\n")
    with pytest.raises(InputError, match=rf"a\.txt, line 2: found 3 numbers where .* has {wanted} in every line"):
        read_trajectory(tmp_path / "a.txt", kind=kind)
    with pytest.raises(InputError, match="cannot read a trajectory from the folder"):
        read_trajectory(tmp_path, kind=kind)


GOOD = "0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no pose"),
        ("# only a comment\n", "no pose"),
        (GOOD + "x 0 0 0 0 0 0 1\n", "line 2: expected numbers"),
        (GOOD + "\n1 nan 0 0 0 0 0 1\n", "line 3: a pose holds NaN"),
        (GOOD + "1 1e308 0 0 0 0 0 1\n", "line 2: a position of "),
        (GOOD + "1 0 1e200 0 0 0 0 1\n", r"line 2: a position of 1e\+203 mm is none of a camera"),
        ("1 0 0 1e200 0 1 0 0 0 0 1 0\n", r"line 1: a position of 1e\+203 mm"),
        (GOOD + "1 0 0 0 0 0 0\n", "line 2: found 7 numbers"),
        (GOOD + "1 0 0 0 0 0 0 0\n", "line 2: the quaternion has length 0"),
        (GOOD + "0 1 1 1 0 0 0 1\n", "line 2: the time stamp of an earlier line"),
        ("1 2 3\n", "its lines hold 3 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 2 0 0 0 0 2 0\n", r"line 2: not a rigid motion"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", r"line 1: not a rigid motion .*det R = -1"),
        ("1 0 0 5 0 1 0 0 0 0 1 0 5 0 0 1\n", "neither the last row nor the last column"),
        ("1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 2\n", "line 1: not a rigid motion"),
    ],
)
def test_bad_files_are_named_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_trajectory(path)


def test_missing_empty_and_binary_paths(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file or folder"):
        read_trajectory(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"looked for .*trajectory\.tum"):
        read_trajectory(tmp_path)
    (tmp_path / "movie.mp4").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="cannot read"):
        read_trajectory(tmp_path / "movie.mp4")


@pytest.mark.real
def test_real_c3vd_and_seven_scenes(real_data: Path) -> None:
    clip = read_trajectory(real_data / "endoscopy" / "c3vd" / "cecum_t1_a")
    assert len(clip) == 276
    assert clip.path_length_mm == pytest.approx(54.7, abs=0.05)
    again = read_trajectory(real_data / "endoscopy" / "c3vd_camera_paths" / "c1v1.txt")
    np.testing.assert_allclose(again.T_world_camera, clip.T_world_camera[: len(again)], atol=1e-3)
    kitchen = read_trajectory(real_data / "rgbd" / "7scenes_kitchen_100f")
    assert len(kitchen) == 100
    assert 100 < kitchen.path_length_mm < 10_000
