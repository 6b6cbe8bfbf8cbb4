"""TUM RGB-D: lists of time stamps, association, units, published cameras, and what is wrong with such folders."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_inputs import frames_of, number_in, picture, save

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.cameras.lenses import OpenCvCamera
from scopemap.errors import CalibrationError, InputError
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory
from scopemap_bench.datasets.tum import associated

SIZE = (64, 48)  # a tenth of the data set's
START_S = 1305031102.175304
STAMPS = [START_S + step for step in (0.0, 0.036, 0.07, 0.1)]
ROOM = "rgbd_dataset_freiburg3_desk"
# A quarter turn about z: x of the camera is y of the world, y of the camera is -x of the world.
TURN = "0 0 0.70710678 0.70710678"
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def write_list(file: Path, rows: list[tuple[float, str]]) -> None:
    lines = ["# images", f"# file: '{file.stem}.bag'", "# timestamp filename", *(f"{t:.6f} {name}" for t, name in rows)]
    file.write_text("\n".join(lines) + "\n")


def write_tum(folder: Path, stamps: list[float] = STAMPS, level: int = 5000) -> Path:
    """Depth is taken 5 ms after colour, not at all for frame 2; a pose 4 ms before it, x = 0.1 m times its number."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    colours, depths, poses = [], [], ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    for number, stamp in enumerate(stamps):
        colours.append((stamp, f"rgb/{stamp:.6f}.png"))
        save(folder / colours[-1][1], picture(number, SIZE))
        poses.append(f"{stamp - 0.004:.4f} {0.1 * number:.4f} 2.0000 -0.5000 {TURN}")
        if number != 2:
            depths.append((stamp + 0.005, f"depth/{stamp + 0.005:.6f}.png"))
            depth = np.full((SIZE[1], SIZE[0]), level + 5 * number, np.uint16)
            depth[:6] = 0
            cv2.imwrite(str(folder / depths[-1][1]), depth)
    write_list(folder / "rgb.txt", colours)
    write_list(folder / "depth.txt", depths)
    (folder / "groundtruth.txt").write_text("\n".join(poses) + "\n")
    (folder / "accelerometer.txt").write_text("# timestamp ax ay az\n1305031102.1 0 0 9.8\n")
    return folder


def pose_at(x_mm: float) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = TURNED
    T_world_camera[:3, 3] = [x_mm, 2000.0, -500.0]
    return T_world_camera


def replace_line(file: Path, number: int, line: str) -> None:
    lines = file.read_text().splitlines()
    lines[number] = line
    file.write_text("\n".join(lines) + "\n")


# ---- what a sequence gives


@pytest.mark.parametrize("nesting", ["", "download", f"download/{ROOM}"])
def test_a_sequence(nesting: str, tmp_path: Path) -> None:
    folder = write_tum(tmp_path / nesting / ROOM)
    sequence = open_sequence(tmp_path if nesting else folder)
    assert (sequence.source.name, sequence.path, sequence.count) == ("tum", folder, 4)
    pairs = list(sequence)
    assert [number_in(frame.rgb) for frame, _ in pairs] == [frame.index for frame, _ in pairs] == [0, 1, 2, 3]
    assert [truth.index for _, truth in pairs] == [0, 1, 2, 3]
    np.testing.assert_allclose([frame.time_s for frame, _ in pairs], STAMPS, rtol=0, atol=1e-6)
    assert pairs[0][0].name == f"{START_S:.6f}.png"
    for number, (_, truth) in enumerate(pairs):
        np.testing.assert_allclose(truth.T_world_camera, pose_at(100.0 * number), atol=1e-7)
        assert truth.quality == "registered"
    assert sequence.warnings == []


def test_depth_is_5000_per_metre_and_0_is_unknown(tmp_path: Path) -> None:
    source = open_sequence(write_tum(tmp_path / ROOM)).source
    for number, depth_mm in [(0, 1000.0), (1, 1001.0), (3, 1003.0)]:
        found = source.truth(number).depth_mm
        assert found.dtype == np.float32
        assert found.shape == (SIZE[1], SIZE[0])
        assert np.isnan(found[:6]).all()
        np.testing.assert_allclose(found[6:], depth_mm, rtol=1e-6)
    assert source.truth(2).depth_mm is None
    assert source.truth(2).T_world_camera is not None


def test_selected_frames_keep_number_and_stamp(tmp_path: Path) -> None:
    sequence = open_sequence(write_tum(tmp_path / ROOM), frames=slice(1, None, 2))
    assert [(f.index, number_in(f.rgb)) for f in frames_of(sequence)] == [(1, 1), (3, 3)]
    assert sequence.source.stamps(sequence.selection) == [
        (1, pytest.approx(STAMPS[1], abs=1e-6)),
        (3, pytest.approx(STAMPS[3], abs=1e-6)),
    ]
    reference = reference_trajectory(sequence)
    assert reference.indices.tolist() == [1, 3]
    np.testing.assert_allclose(reference.positions_mm, [[100, 2000, -500], [300, 2000, -500]], atol=1e-7)


# ---- cameras


@pytest.mark.parametrize(
    ("name", "expected", "distortion"),
    [
        ("rgbd_dataset_freiburg1_xyz", [51.73, 51.65, 31.41, 25.08], (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
        ("rgbd_dataset_freiburg2_desk", [52.09, 52.10, 32.06, 24.52], (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
        ("fr3_office", [53.54, 53.92, 31.56, 24.31], None),
        (f"{ROOM}/sequence", [53.54, 53.92, 31.56, 24.31], None),
    ],
)
def test_the_published_cameras(
    name: str, expected: list[float], distortion: tuple[float, ...] | None, tmp_path: Path
) -> None:
    """At a tenth of the size: cx = (cx + 0.5) / 10 - 0.5."""
    source = open_sequence(write_tum(tmp_path / name)).source
    central = source.camera.central
    np.testing.assert_allclose([central.fx, central.fy, central.cx, central.cy], expected, atol=1e-9)
    assert (source.camera.distortion if isinstance(source.camera, OpenCvCamera) else None) == distortion
    assert "published" in source.camera_source


def test_another_folder_has_no_published_camera(tmp_path: Path) -> None:
    sequence = open_sequence(write_tum(tmp_path / "frame4_phantom"))
    assert not sequence.calibrated
    assert any("field of view" in note for note in sequence.notes)


def test_a_calibration_beside_the_lists_wins_with_its_depth_scale(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    write_calibration(PinholeCamera(60.0, 61.0, 30.0, 25.0, *SIZE), folder / "camera.yaml", depth_scale_mm=0.01)
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.camera.matrix, [[60, 0, 30], [0, 61, 25], [0, 0, 1]])
    np.testing.assert_allclose(sequence.source.truth(0).depth_mm[6:], 50.0, rtol=1e-6)


def test_images_of_another_aspect_are_refused(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    for file in (folder / "rgb").iterdir():
        save(file, picture(0, (64, 40)))
    with pytest.raises(CalibrationError, match="640x480 px, but the images are 64x40 px"):
        open_sequence(folder)


# ---- units


def test_poses_say_their_unit(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    assert any("m (assumed)" in note for note in open_sequence(folder).notes)
    text = (folder / "groundtruth.txt").read_text()
    (folder / "groundtruth.txt").write_text("# unit: mm; time: s\n" + text)
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.source.pose(3)[:3, 3], [0.3, 2.0, -0.5], atol=1e-9)
    assert any("mm (stated)" in note for note in sequence.notes)


def test_whole_stamps_are_seconds_and_said(tmp_path: Path) -> None:
    sequence = open_sequence(write_tum(tmp_path / ROOM, [0.0, 1.0, 2.0]))
    assert [frame.time_s for frame in frames_of(sequence)] == [0.0, 1.0, 2.0]
    assert any("whole numbers" in note for note in sequence.notes)


# ---- association


def test_association_is_greedy_by_time_and_one_to_one() -> None:
    # 0.110 is nearer to 0.112 than 0.100 is; 0.100 then takes what is left within 0.02 s.
    assert associated([0.100, 0.110], [0.085, 0.112]) == {1: 1, 0: 0}
    assert associated([0.100, 0.110], [0.112]) == {1: 0}
    assert associated([1.0, 2.0], [1.0199, 2.0201]) == {0: 0}
    assert associated([1.0], []) == {}


def test_a_pose_too_far_in_time_is_none(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    replace_line(folder / "groundtruth.txt", 5, f"{STAMPS[3] + 0.021:.4f} 9 9 9 {TURN}")
    sequence = open_sequence(folder)
    assert [sequence.source.pose(number) is None for number in range(4)] == [False, False, False, True]
    assert any("pose: of 3 of 4 frames" in note for note in sequence.notes)
    assert reference_trajectory(sequence).indices.tolist() == [0, 1, 2]


def test_another_clock_is_a_warning(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    (folder / "groundtruth.txt").write_text(f"0.0 0 0 0 {TURN}\n0.1 0 0 0 {TURN}\n")
    sequence = open_sequence(folder)
    assert sequence.source.pose(0) is None
    assert any("no pose belongs to any frame" in warning for warning in sequence.warnings)


@pytest.mark.parametrize("depth_first", [True, False])
def test_associations_win_over_time(depth_first: bool, tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    colour, depth = (f"rgb/{STAMPS[2]:.6f}.png", f"depth/{STAMPS[3] + 0.005:.6f}.png")
    first, second = (depth, colour) if depth_first else (colour, depth)
    (folder / "associations.txt").write_text(f"# pairs\n1.0 {first} 2.0 {second}\n3.0 rgb/other.png 4.0 depth/o.png\n")
    sequence = open_sequence(folder)
    assert [sequence.source.truth(number).depth_mm is None for number in range(4)] == [True, True, False, True]
    np.testing.assert_allclose(sequence.source.truth(2).depth_mm[6:], 1003.0, rtol=1e-6)
    assert any("depth: of 1 of 4 frames, associations.txt" in note for note in sequence.notes)


def test_lists_out_of_order_are_sorted_by_time(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(reversed(lines)) + "\n\n")
    sequence = open_sequence(folder)
    for frame, truth in sequence:
        assert number_in(frame.rgb) == frame.index
        np.testing.assert_allclose(truth.T_world_camera, pose_at(100.0 * frame.index), atol=1e-7)
    assert ["not in the order of time" in warning for warning in sequence.warnings] == [True]


# ---- what is wrong with a folder


def test_images_that_are_missing_or_broken_are_left_out_and_others_keep_their_numbers(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    (folder / f"rgb/{STAMPS[1]:.6f}.png").unlink()
    (folder / f"rgb/{STAMPS[2]:.6f}.png").write_bytes(b"no image")
    (folder / f"depth/{STAMPS[3] + 0.005:.6f}.png").unlink()
    sequence = open_sequence(folder)
    assert [(f.index, number_in(f.rgb)) for f in frames_of(sequence)] == [(0, 0), (3, 3)]
    np.testing.assert_allclose(sequence.source.pose(3), pose_at(300.0), atol=1e-7)
    assert sequence.source.truth(3).depth_mm is None
    assert any("rgb.txt: 1 of the 4 images that it names are not there" in warning for warning in sequence.warnings)
    assert any("depth.txt: 1 of the 3 images that it names are not there" in warning for warning in sequence.warnings)
    assert any("cannot be read and was left out" in warning for warning in sequence.warnings)


@pytest.mark.parametrize("row", ["nan nan nan nan nan nan nan", "1 2 3 0 0 0 0", "1 NaN 3 0 0 0 1"])
def test_a_row_without_a_pose_leaves_its_frame_without_one(row: str, tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    replace_line(folder / "groundtruth.txt", 3, f"{STAMPS[1]:.4f} {row}")
    source = open_sequence(folder).source
    assert [source.pose(number) is None for number in range(4)] == [False, True, False, False]


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        ("groundtruth.txt", "1305031102.2 0 0 0 0 0 1", r"line 4: found 7 numbers where earlier"),
        ("groundtruth.txt", "1305031102.2 0 0 0 0 0 0 1 5", r"line 4: found 9 numbers"),
        ("groundtruth.txt", "1305031102.2 0 0 x 0 0 0 1", r"line 4: expected numbers .*'x'"),
        ("groundtruth.txt", "1305031102.2 0 0 0 0 0 0 3", r"line 4: the quaternion has length 3"),
        ("groundtruth.txt", f"{STAMPS[0] - 0.004:.4f} 1 0 0 0 0 0 1", r"line 4: the time stamp of an earlier line"),
        ("rgb.txt", "1305031102.2", r"rgb\.txt, line 4: expected `timestamp filename`, found '1305031102\.2'"),
        ("rgb.txt", "1305031102.2 rgb/1.png 2.0 depth/1.png", r"rgb\.txt, line 4: expected `timestamp filename`"),
        ("rgb.txt", "now rgb/1.png", r"rgb\.txt, line 4: expected `timestamp filename`"),
        ("rgb.txt", "nan rgb/1.png", r"rgb\.txt, line 4: expected `timestamp filename`"),
        ("rgb.txt", f"{STAMPS[2]:.6f} rgb/1.png", r"rgb\.txt, line 6: the time stamp of an earlier line"),
        ("depth.txt", "1305031102.2 depth/1.png x", r"depth\.txt, line 4: expected `timestamp filename`"),
        ("associations.txt", "1.0 rgb/1.png 2.0", r"associations\.txt, line 4: expected `timestamp rgb_file"),
        ("associations.txt", "rgb/1.png 1.0 depth/1.png 1.0", r"associations\.txt, line 4: expected `timestamp rgb"),
    ],
)
def test_rows_that_are_none_are_named(file: str, line: str, message: str, tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    (folder / "associations.txt").write_text("# pairs\n" * 4)
    replace_line(folder / file, 3, line)
    if file == "depth.txt":
        (folder / "associations.txt").unlink()
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)


def test_a_colour_image_with_two_depths_is_refused(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / ROOM)
    colour = f"rgb/{STAMPS[2]:.6f}.png"
    (folder / "associations.txt").write_text(f"1.0 {colour} 2.0 depth/a.png\n1.0 {colour} 2.0 depth/b.png\n")
    with pytest.raises(InputError, match=r"line 2: .* has another depth image in an earlier line"):
        open_sequence(folder)


def test_folders_of_others_are_left_to_them(tmp_path: Path) -> None:
    for number in range(2):
        save(tmp_path / f"{number}.png", picture(number))
    (tmp_path / "rgb.txt").write_text("0.0 0.png\n0.1 1.png\n")
    assert open_sequence(tmp_path).source.name == "images"
    with pytest.raises(InputError, match=r"cannot read .*rgb\.txt"):
        open_sequence(write_tum(tmp_path / "c") / "rgb", dataset="tum")
