"""SimCol3D: rendered colonoscopy, left-handed poses in cm, depth of 16 bit."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_inputs import number_in, picture, save

from scopemap.errors import InputError
from scopemap.io.opening import open_sequence

SIZE = (95, 95)
K = np.array([[45.52, 0.0, 47.5], [0.0, 45.52, 47.0], [0.0, 0.0, 1.0]])
C, S = np.cos(0.3), np.sin(0.3)
# Position, cm, and quaternion x y z w of each image, by Unity: x right, y up, z forward, left-handed.
POSITIONS = [(0, 0, 0), (1, 2, 3), (-4, 5.5, 6), (0.1, -0.2, 0.3)]
QUATERNIONS = [
    (0, 0, 0, 1),
    (0, np.sin(0.15), 0, np.cos(0.15)),  # turned to the right
    (np.sin(0.15), 0, 0, np.cos(0.15)),  # turned down
    (0.1, -0.3, 0.5, np.sqrt(1 - 0.35)),
]


def table(rows: list[tuple[float, ...]]) -> str:
    return "".join(" ".join(f"{x:.12g}" for x in row) + "\n" for row in rows)


def depth_image() -> np.ndarray:
    depth = np.full((SIZE[1], SIZE[0]), 65280, np.uint16)
    depth[:10], depth[10:20], depth[20:30] = 0, 32640, 65281
    return depth


def write_simcol(scene: Path, name: str = "S1", numbers: tuple[int, ...] = (0, 1, 2, 3)) -> Path:
    folder = scene / f"Frames_{name}"
    folder.mkdir(parents=True)
    for number in numbers:
        save(folder / f"FrameBuffer_{number:04d}.png", picture(number, SIZE))
        cv2.imwrite(str(folder / f"Depth_{number:04d}.png"), depth_image())
    (scene / f"SavedPosition_{name}.txt").write_text(table(POSITIONS))
    (scene / f"SavedRotationQuaternion_{name}.txt").write_text(table(QUATERNIONS))
    np.savetxt(scene / "cam.txt", K)
    return folder


def rotated(quaternion: tuple[float, ...], vector: np.ndarray) -> np.ndarray:
    """What Unity's `quaternion * vector` gives."""
    q, w = np.array(quaternion[:3]), quaternion[3]
    return vector + 2 * w * np.cross(q, vector) + 2 * np.cross(q, np.cross(q, vector))


# ---- a trajectory


def test_a_trajectory(tmp_path: Path) -> None:
    sequence = open_sequence(write_simcol(tmp_path / "SyntheticColon_I"))
    assert (sequence.source.name, sequence.count, sequence.calibrated) == ("simcol3d", 4, True)
    np.testing.assert_array_equal(sequence.camera.matrix, K)
    assert "cam.txt" in sequence.camera_source
    for (frame, truth), number in zip(sequence, range(4), strict=True):
        assert frame.index == truth.index == number_in(frame.rgb) == number
        assert (frame.time_s, frame.name) == (number / 30, f"FrameBuffer_{number:04d}.png")
        assert truth.quality == "exact"
    assert sequence.warnings == []
    assert any("left-handed" in note and "cm" in note for note in sequence.notes)
    assert any("30 s" in note for note in sequence.notes)


def test_depth_of_65280_is_20_cm_and_0_is_unknown(tmp_path: Path) -> None:
    truth = open_sequence(write_simcol(tmp_path)).source.truth(2)
    assert truth.depth_mm.dtype == np.float32
    assert np.isnan(truth.depth_mm[:10]).all()
    np.testing.assert_allclose(truth.depth_mm[10:20], 100.0, rtol=1e-6)
    assert np.isnan(truth.depth_mm[20:30]).all()
    np.testing.assert_allclose(truth.depth_mm[30:], 200.0, rtol=1e-6)


def test_poses_are_right_handed_mm_camera_to_world(tmp_path: Path) -> None:
    source = open_sequence(write_simcol(tmp_path)).source
    np.testing.assert_allclose(source.pose(0), np.eye(4), atol=1e-12)
    right = [[C, 0, S, 10], [0, 1, 0, -20], [-S, 0, C, 30], [0, 0, 0, 1]]
    down = [[1, 0, 0, -40], [0, C, S, -55], [0, -S, C, 60], [0, 0, 0, 1]]
    np.testing.assert_allclose(source.pose(1), right, atol=1e-9)
    np.testing.assert_allclose(source.pose(2), down, atol=1e-9)
    assert all(np.linalg.det(source.pose(i)[:3, :3]) == pytest.approx(1) for i in range(4))


@pytest.mark.parametrize("number", range(4))
def test_a_point_of_the_scene_is_seen_where_unity_draws_it(number: int, tmp_path: Path) -> None:
    sequence = open_sequence(write_simcol(tmp_path))
    local_cm = np.array([1.5, 2.5, 8.0])  # right of the axis, above it, before the camera
    x, y, z = local_cm
    drawn_at = [K[0, 2] + K[0, 0] * x / z, K[1, 2] - K[1, 1] * y / z]
    world_cm = rotated(QUATERNIONS[number], local_cm) + POSITIONS[number]
    world_mm = 10 * world_cm * [1, -1, 1]
    in_camera = np.linalg.inv(sequence.source.pose(number)) @ [*world_mm, 1]
    assert in_camera[2] == pytest.approx(80)
    np.testing.assert_allclose(sequence.camera.project(in_camera[:3]), drawn_at, atol=1e-6)


def test_frames_sorted_by_number_keep_their_lines(tmp_path: Path) -> None:
    folder = write_simcol(tmp_path, numbers=(3, 1, 2))
    (folder / "FrameBuffer_0002.png").rename(folder / "FrameBuffer_2.png")
    sequence = open_sequence(folder)
    assert sequence.source.numbers == [1, 2, 3]
    assert [number_in(frame.rgb) for frame in sequence.frames()] == [1, 2, 3]
    np.testing.assert_allclose(sequence.source.pose(3)[:3, 3], [1, 2, 3])
    assert sequence.source.truth(2).depth_mm is None


# ---- where it lies


@pytest.mark.parametrize("inside", [".", "Frames_S1/Frames_S1", "SyntheticColon_I"])
def test_it_is_found_one_up_and_in_a_repeated_folder(inside: str, tmp_path: Path) -> None:
    scene = tmp_path / "SyntheticColon_I"
    folder = write_simcol(scene / "SyntheticColon_I" if inside == "SyntheticColon_I" else scene)
    if inside.startswith("Frames"):
        shutil.move(folder, scene / "away")
        folder.mkdir()
        folder = Path(shutil.move(scene / "away", folder / "Frames_S1"))
    sequence = open_sequence(scene)
    assert (sequence.source.name, sequence.path) == ("simcol3d", folder)
    np.testing.assert_allclose(sequence.source.pose(1)[:3, 3], [10, -20, 30])
    np.testing.assert_array_equal(sequence.camera.matrix, K)


def test_several_trajectories_are_named_and_each_has_its_own_poses(tmp_path: Path) -> None:
    write_simcol(tmp_path / "SyntheticColon_II", "B1")
    second = write_simcol(tmp_path / "SyntheticColon_II", "B10")
    moved = [(x + 7, y, z) for x, y, z in POSITIONS]
    (second.parent / "SavedPosition_B10.txt").write_text(table(moved))
    with pytest.raises(InputError, match=r"holds 2 sequences \(Frames_B1, Frames_B10\)"):
        open_sequence(tmp_path / "SyntheticColon_II")
    assert open_sequence(second).source.pose(0)[0, 3] == pytest.approx(70)


def test_poses_in_the_folder_itself_serve_any_name(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    folder = write_simcol(scene)
    for name in ("SavedPosition", "SavedRotationQuaternion"):
        (scene / f"{name}_S1.txt").rename(folder / f"{name}.txt")
    folder = folder.rename(tmp_path / "mine")
    source = open_sequence(folder).source
    np.testing.assert_allclose(source.pose(1)[:3, 3], [10, -20, 30])
    for name in ("SavedPosition", "SavedRotationQuaternion"):
        shutil.copy(folder / f"{name}.txt", folder / f"{name}_S9.txt")
    assert open_sequence(folder).source.pose(1) is None  # whose are they?


def test_poses_of_another_trajectory_are_not_taken(tmp_path: Path) -> None:
    folder = write_simcol(tmp_path)
    folder = folder.rename(tmp_path / "Frames_S2")
    sequence = open_sequence(folder)
    assert sequence.source.pose(0) is None
    assert sequence.source.truth(0).depth_mm is not None
    assert any("no pose is known" in warning for warning in sequence.warnings)


# ---- calibration and depth of other kinds


def test_without_cam_txt_the_camera_is_assumed_and_said(tmp_path: Path) -> None:
    folder = write_simcol(tmp_path)
    (tmp_path / "cam.txt").unlink()
    sequence = open_sequence(folder)
    assert not sequence.calibrated
    assert any("field of view" in note for note in sequence.notes)


def test_depth_of_8_bit_ends_at_20_cm_too(tmp_path: Path) -> None:
    folder = write_simcol(tmp_path)
    values = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    values[5:], values[50:] = 51, 255
    cv2.imwrite(str(folder / "Depth_0001.png"), values)
    depth_mm = open_sequence(folder).source.truth(1).depth_mm
    assert np.isnan(depth_mm[:5]).all()
    np.testing.assert_allclose([depth_mm[5, 0], depth_mm[60, 0]], [40, 200], rtol=1e-6)


# ---- faults


def test_a_line_of_nan_is_no_pose(tmp_path: Path) -> None:
    folder = write_simcol(tmp_path)
    (tmp_path / "SavedPosition_S1.txt").write_text(table([POSITIONS[0], (np.nan,) * 3, *POSITIONS[2:]]))
    source = open_sequence(folder).source
    assert source.pose(1) is None
    assert source.truth(1).T_world_camera is None
    np.testing.assert_allclose(source.pose(2)[:3, 3], [-40, -55, 60])


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("SavedPosition_S1.txt", table(POSITIONS[:3]), "holds 3 lines and SavedRotationQuaternion_S1.txt 4"),
        ("SavedRotationQuaternion_S1.txt", table(QUATERNIONS) * 2, "holds 4 lines and .* 8"),
        ("SavedPosition_S1.txt", "", "holds no pose"),
        ("SavedPosition_S1.txt", table(POSITIONS[:3]) + "1 2", "line 4: found 2 numbers where"),
        ("SavedPosition_S1.txt", "1 2 3\n\n" + table(POSITIONS[2:]), "holds 3 lines"),
        ("SavedPosition_S1.txt", table(POSITIONS[:3]) + "1 2 x", "line 4: expected numbers .*'x'"),
        ("SavedRotationQuaternion_S1.txt", table([*QUATERNIONS[:3], (0, 0, 0, 0)]), "line 4: .* length 0 instead"),
        ("SavedRotationQuaternion_S1.txt", table([(0, 0, 0, 2), *QUATERNIONS[1:]]), "line 1: .* length 2 instead"),
        ("SavedPosition_S1.txt", None, r"SavedPosition_S1\.txt .*No such file"),
        ("SavedRotationQuaternion_S1.txt", None, r"SavedRotationQuaternion_S1\.txt .*No such file"),
    ],
)
def test_poses_that_do_not_fit_are_one_sentence(file: str, text: str | None, message: str, tmp_path: Path) -> None:
    folder = write_simcol(tmp_path)
    if text is None:
        (tmp_path / file).unlink()
    else:
        (tmp_path / file).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)


def test_fewer_lines_than_images_and_binary_poses(tmp_path: Path) -> None:
    folder = write_simcol(tmp_path)
    save(folder / "FrameBuffer_0004.png", picture(4, SIZE))
    with pytest.raises(InputError, match=r"holds 4 lines .* the last image is FrameBuffer_0004\.png"):
        open_sequence(folder)
    (tmp_path / "SavedPosition_S1.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(InputError, match=r"SavedPosition_S1\.txt"):
        open_sequence(folder)
