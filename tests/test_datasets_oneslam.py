"""OneSLAM's layout: calibration and rate in JSON, poses by frame number, depth in thousandths of the scene's unit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_inputs import frames_of, number_in, picture, save

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import CalibrationError, InputError
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory

SIZE = (80, 64)
NUMBERS = [3, 9, 10, 24]
STATED = {"intrinsics": {"fx": 70.0, "fy": 71, "cx": 41.5, "cy": 30.25}, "FPS": 25}
# A quarter turn about x: y of the camera is z of the world, z of the camera is -y of the world.
TURN = "0.70710678 0 0 0.70710678"
TURNED = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def write_oneslam(folder: Path, suffix: str = "jpg", header: str = "# frame_index tx ty tz qx qy qz qw") -> Path:
    """The pose's x is the number of the frame, frame 9 has no pose, frame 10 no depth."""
    for name in ("images", "depths"):
        (folder / name).mkdir(parents=True)
    for number in NUMBERS:
        save(folder / "images" / f"{number:08d}.{suffix}", picture(number, SIZE))
        if number != 10:
            cv2.imwrite(str(folder / "depths" / f"{number:08d}.png"), depth_image(40000 + number))
    poses = [f"{number} {number} -2.5 40 {TURN}" for number in NUMBERS if number != 9]
    (folder / "poses_gt.txt").write_text("\n".join([header, *poses]) + "\n")
    write_json(folder, STATED)
    return folder


def write_json(folder: Path, stated: Any) -> None:
    (folder / "calibration.json").write_text(json.dumps(stated))


def depth_image(level: int) -> np.ndarray:
    depth = np.full((SIZE[1], SIZE[0]), level, np.uint16)
    depth[:8] = 0
    return depth


def write_mask(folder: Path, colour: bool = False) -> None:
    """Tissue is all but the ten columns on the right, where 254 is not enough."""
    mask = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    mask[:, -10:-5], mask[:, -5:] = 254, 0
    cv2.imwrite(str(folder / "mask.bmp"), cv2.cvtColor(mask, cv2.COLOR_GRAY2BGR) if colour else mask)


# ---- what a folder gives


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("nesting", ["", "sets", "sets/colon"])
def test_a_folder(nesting: str, suffix: str, tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / nesting / "colon", suffix)
    write_mask(folder)
    sequence = open_sequence(tmp_path if nesting else folder)
    assert (sequence.source.name, sequence.path, sequence.count) == ("oneslam", folder, 4)
    assert sequence.calibrated
    np.testing.assert_array_equal(sequence.camera.matrix, [[70, 0, 41.5], [0, 71, 30.25], [0, 0, 1]])
    pairs = list(sequence)
    assert [number_in(frame.rgb) for frame, _ in pairs] == [frame.index for frame, _ in pairs] == NUMBERS
    assert [frame.time_s for frame, _ in pairs] == pytest.approx([3 / 25, 9 / 25, 10 / 25, 24 / 25])
    assert pairs[1][0].name == f"00000009.{suffix}"
    assert {truth.quality for _, truth in pairs} == {"registered"}
    assert sequence.warnings == []


def test_poses_are_camera_to_world_by_frame_number(tmp_path: Path) -> None:
    sequence = open_sequence(write_oneslam(tmp_path / "colon"))
    for number in (3, 10, 24):
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = TURNED
        T_world_camera[:3, 3] = [number, -2.5, 40.0]
        np.testing.assert_allclose(sequence.source.pose(number), T_world_camera, atol=1e-7)
        np.testing.assert_array_equal(sequence.source.truth(number).T_world_camera, sequence.source.pose(number))
    assert sequence.source.pose(9) is None
    assert reference_trajectory(sequence).indices.tolist() == [3, 10, 24]
    assert any("poses: of 3 of 4 frames, camera-to-world, mm (assumed)" in note for note in sequence.notes)
    assert any("taken as registered" in note for note in sequence.notes)


def test_depth_is_in_thousandths_and_0_is_unknown(tmp_path: Path) -> None:
    source = open_sequence(write_oneslam(tmp_path / "colon")).source
    for number, depth_mm in [(3, 40.003), (9, 40.009), (24, 40.024)]:
        found = source.truth(number).depth_mm
        assert found.dtype == np.float32
        assert np.isnan(found[:8]).all()
        np.testing.assert_allclose(found[8:], depth_mm, rtol=1e-6)
    assert source.truth(10).depth_mm is None
    assert any("depth: 0.001 mm per unit" in note for note in source.notes)


def test_a_scene_in_metres_is_brought_to_mm_as_a_whole(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon", header="# unit: m")
    source = open_sequence(folder).source
    np.testing.assert_allclose(source.pose(3)[:3, 3], [3000.0, -2500.0, 40000.0])
    np.testing.assert_allclose(source.truth(3).depth_mm[8:], 40003.0, rtol=1e-6)
    assert any("m (stated)" in note for note in source.notes)


def test_depth_outside_the_mask_is_unknown(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    for colour in (False, True):
        write_mask(folder, colour)
        sequence = open_sequence(folder)
        found = sequence.source.truth(3).depth_mm
        assert np.isnan(found[:, -10:]).all()
        assert np.isfinite(found[8:, :-10]).all()
        assert any("mask.bmp is applied to the true depth only" in note for note in sequence.notes)


def test_without_truth_there_is_none(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    (folder / "poses_gt.txt").unlink()
    for file in (folder / "depths").iterdir():
        file.unlink()
    sequence = open_sequence(folder)
    assert [truth for _, truth in sequence] == [None] * 4
    assert reference_trajectory(sequence) is None
    assert "no pose is known: there is no poses_gt.txt" in sequence.notes


def test_a_calibration_beside_the_images_wins_with_its_depth_scale(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    write_calibration(PinholeCamera(60.0, 61.0, 39.0, 33.0, *SIZE), folder / "camera.yaml", depth_scale_mm=0.002)
    sequence = open_sequence(folder)
    assert sequence.camera == PinholeCamera(60.0, 61.0, 39.0, 33.0, *SIZE)
    np.testing.assert_allclose(sequence.source.truth(3).depth_mm[8:], 80.006, rtol=1e-6)
    assert sequence.source.stamps(slice(0, 1)) == [(3, pytest.approx(3 / 25))]


def test_without_a_rate_30_per_second_are_assumed_and_said(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    write_json(folder, {"intrinsics": STATED["intrinsics"]})
    sequence = open_sequence(folder)
    assert [frame.time_s for frame in frames_of(sequence)] == pytest.approx([0.1, 0.3, 1 / 3, 0.8])
    assert any("frame number / 30 s (assumed" in note for note in sequence.notes)


# ---- what is wrong with a folder


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ([1, 2], 'no object with "intrinsics"'),
        ({"FPS": 30}, "no 3x3 camera matrix"),
        ({"intrinsics": {"fx": 70, "fy": 70, "cx": 40}}, "has no cy"),
        ({"intrinsics": {"fx": "wide", "fy": 70, "cx": 40, "cy": 32}}, "fx must be a finite number, found 'wide'"),
        ({"intrinsics": {"fx": None, "fy": 70, "cx": 40, "cy": 32}}, "fx must be a finite number, found 'None'"),
        ({"intrinsics": {"fx": 10**400, "fy": 70, "cx": 40, "cy": 32}}, "fx must be a finite number, found 'inf'"),
        ({"intrinsics": {"fx": float("nan"), "fy": 70, "cx": 40, "cy": 32}}, "fx must be a finite number, found 'nan'"),
        ({"intrinsics": {"fx": -70, "fy": 70, "cx": 40, "cy": 32}}, "does not fit images of 80x64 px"),
        ({"intrinsics": {"fx": 900, "fy": 900, "cx": 40, "cy": 32}}, "focal length 900, 900"),
        ({"intrinsics": {"fx": 70, "fy": 70, "cx": 400, "cy": 32}}, "principal point 400, 32 is outside"),
    ],
)
def test_a_calibration_that_is_none_is_one_sentence(stated: object, message: str, tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    write_json(folder, stated)
    with pytest.raises(CalibrationError, match=message) as caught:
        open_sequence(folder, dataset="oneslam")
    assert "\n" not in str(caught.value)
    assert "calibration.json" in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"[1, 2]", b'{"FPS": 30}', b'{"intrinsics": ', b" " * (2 << 20), b"[" * 100_000]
)
def test_another_calibration_json_is_not_taken_for_ours(content: bytes, tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    (folder / "calibration.json").write_bytes(content)
    sequence = open_sequence(folder)
    assert (sequence.source.name, sequence.path) == ("images", folder / "images")


@pytest.mark.parametrize("rate", [0, -25, "fast", [25], float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(rate: object, tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    write_json(folder, STATED | {"FPS": rate})
    with pytest.raises(InputError, match="FPS must be a positive number"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("3 0 0 0 0 0 1", "found 8 numbers where earlier lines have 7"),
        ("3 0 0 zero 0 0 0 1", "line 2: expected numbers"),
        ("3 0 0 0 0 0 0 2", "line 2: the quaternion has length 2"),
        ("10 0 0 0 0 0 0 1", "line 3: the time stamp of an earlier line comes again"),
        ("3.5 0 0 0 0 0 0 1", "stamped by frame number here, but not all stamps are whole"),
    ],
)
def test_poses_that_are_none_are_named(row: str, message: str, tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    lines = (folder / "poses_gt.txt").read_text().splitlines()
    (folder / "poses_gt.txt").write_text("\n".join([lines[0], row, *lines[2:]]))
    with pytest.raises(InputError, match=message):
        open_sequence(folder)


@pytest.mark.parametrize("row", ["3 nan nan nan nan nan nan nan", "3 1 2 3 0 0 0 0", "# 3 1 2 3 0 0 0 1"])
def test_a_row_without_a_pose_leaves_its_frame_without_one(row: str, tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    lines = (folder / "poses_gt.txt").read_text().splitlines()
    (folder / "poses_gt.txt").write_text("\n".join([lines[3], row, lines[2]]))
    source = open_sequence(folder).source
    assert [source.pose(number) is None for number in NUMBERS] == [True, True, False, False]
    assert source.truth(3).T_world_camera is None


def test_poses_of_other_frames_are_a_warning(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    (folder / "poses_gt.txt").write_text(f"500 0 0 0 {TURN}\n")
    assert any("no row is stamped with the number of an image" in warning for warning in open_sequence(folder).warnings)


def test_two_images_for_one_frame_and_images_without_a_number_are_refused(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    save(folder / "images" / "00000009.png", picture(9, SIZE))
    with pytest.raises(InputError, match=r"00000009\.(jpg|png) and 00000009\.(png|jpg) have the same number"):
        open_sequence(folder)
    (folder / "images" / "00000009.png").rename(folder / "images" / "last.png")
    with pytest.raises(InputError, match=r"last\.png: its name holds no number"):
        open_sequence(folder)


def test_masks_and_depth_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    folder = write_oneslam(tmp_path / "colon")
    cv2.imwrite(str(folder / "depths" / "00000003.png"), np.full((32, 40), 500, np.uint16))
    cv2.imwrite(str(folder / "depths" / "00000009.png"), np.full((64, 80), 50, np.uint8))
    write_mask(folder)
    source = open_sequence(folder).source
    with pytest.raises(InputError, match=r"depth is 40x32 px, mask\.bmp 80x64 px"):
        source.truth(3)
    with pytest.raises(InputError, match="one 16-bit channel"):
        source.truth(9)
    (folder / "mask.bmp").write_bytes(b"BM")
    with pytest.raises(InputError, match=r"mask\.bmp: expected a mask of 80x64 px, found no readable image"):
        open_sequence(folder)
    cv2.imwrite(str(folder / "mask.bmp"), np.full((20, 30), 255, np.uint8))
    with pytest.raises(InputError, match="found 30x20 px"):
        open_sequence(folder)
