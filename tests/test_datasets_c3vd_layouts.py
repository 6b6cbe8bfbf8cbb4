"""C3VD in folders: C3VDv2, and EndoGSLAM's undistorted copy with depth of 8 bit."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_inputs import SIZE, number_in, picture, poses, save, write_c3vd

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.errors import CalibrationError, InputError
from scopemap.io.opening import open_sequence
from scopemap_bench.datasets.c3vd import CAMERA, UNDISTORTED_CAMERA

FULL = (1350, 1080)


def write_folders(
    folder: Path, images: str, name: str, depth_name: str = "{:04d}_depth.tiff", depth: np.ndarray | None = None
) -> Path:
    (folder / images).mkdir(parents=True)
    for number in range(11):
        save(folder / images / name.format(number), picture(number))
        if depth is not None:
            (folder / "depth").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / "depth" / depth_name.format(number)), depth)
    lines = (",".join(f"{x:.9g}" for x in T.T.ravel()) for T in poses(11))
    (folder / "pose.txt").write_text("\n".join(lines) + "\n")
    return folder


def depth_of(dtype: type, level: int) -> np.ndarray:
    depth = np.full((SIZE[1], SIZE[0]), level, dtype)
    depth[0], depth[-1] = 0, np.iinfo(dtype).max
    return depth


def write_endogslam(folder: Path, name: str = "{:04d}_color.png", depth_name: str = "{:04d}_depth.tiff") -> Path:
    return write_folders(folder, "color", name, depth_name, depth_of(np.uint8, 102))


def write_v2(folder: Path, depth: bool = True) -> Path:
    return write_folders(folder, "rgb", "{:04d}.png", depth=depth_of(np.uint16, 16384) if depth else None)


@pytest.mark.parametrize("name", ["{:04d}_color.png", "{}_color.png", "{:04d}.png"])
def test_endogslams_copy(name: str, tmp_path: Path) -> None:
    sequence = open_sequence(write_endogslam(tmp_path / "cecum_t1_b", name, name.replace("_color.png", "_depth.tiff")))
    assert sequence.source.name == "c3vd"
    for number, (frame, truth) in enumerate(sequence):
        assert frame.index == truth.index == number_in(frame.rgb) == number
        np.testing.assert_allclose(truth.T_world_camera, poses(11)[number], atol=1e-6)
        assert truth.depth_mm[54, 67] == pytest.approx(102 / 2.55)
        assert np.isnan(truth.depth_mm[[0, -1]]).all(), "0 is outside, 255 was clipped"
        assert truth.quality == "registered"
    assert any("8 bit" in note for note in sequence.notes)


def test_endogslams_camera_is_a_pinhole_of_half_the_size(tmp_path: Path) -> None:
    camera = open_sequence(write_endogslam(tmp_path / "c")).rectifier.source
    assert camera == UNDISTORTED_CAMERA.resized(*SIZE)
    half = UNDISTORTED_CAMERA.resized(675, 540)
    np.testing.assert_allclose([half.fx, half.fy], [401.1595, 400.9425])
    # A point keeps its place: the centre of the image, and the principal point's distance from it.
    np.testing.assert_allclose([half.cx - 337, half.cy - 269.5], [(668.286 - 674.5) / 2, (547.733 - 539.5) / 2])


def test_folders_with_depth_of_16_bit_were_only_sorted_and_keep_the_lens(tmp_path: Path) -> None:
    depth = depth_of(np.uint16, 32768)
    sequence = open_sequence(write_folders(tmp_path / "c", "color", "{:04d}_color.png", depth=depth))
    assert sequence.rectifier.source == CAMERA.resized(*SIZE)
    assert sequence.source.truth(3).depth_mm[54, 67] == pytest.approx(32768 / 655.35)


def test_c3vd_v2(tmp_path: Path) -> None:
    sequence = open_sequence(write_v2(tmp_path / "c1_ascending_t1_v1"))
    assert sequence.source.name == "c3vd"
    assert sequence.rectifier.source == CAMERA.resized(*SIZE)
    pairs = list(sequence)
    assert [frame.index for frame, _ in pairs] == list(range(11))
    for frame, truth in pairs:
        assert number_in(frame.rgb) == frame.index
        np.testing.assert_allclose(truth.T_world_camera, poses(11)[frame.index], atol=1e-6)
    # "A pixel value of 16,384 corresponds to a depth of 25 mm", says the data set's page.
    assert sequence.source.truth(0).depth_mm[54, 67] == pytest.approx(25, abs=1e-3)


def test_c3vd_v2_with_poses_only(tmp_path: Path) -> None:
    sequence = open_sequence(write_v2(tmp_path / "c1_full_t1_v1", depth=False))
    assert all(truth.depth_mm is None for _, truth in sequence)
    np.testing.assert_allclose(sequence.source.pose(5), poses(11)[5], atol=1e-6)


def test_a_flat_folder_is_read_as_before_even_beside_other_folders(tmp_path: Path) -> None:
    folder = write_c3vd(tmp_path / "c")
    (folder / "rgb").mkdir()
    save(folder / "rgb" / "0.png", picture(9))
    sequence = open_sequence(folder)
    assert sequence.count == 11
    assert sequence.rectifier.source == CAMERA.resized(*SIZE)
    assert sequence.source.truth(0).depth_mm is not None


@pytest.mark.parametrize("write", [write_endogslam, write_v2])
def test_a_calibration_beside_the_frames_wins(write, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    folder = write(tmp_path / "c")
    write_calibration(PinholeCamera(100.0, 100.0, 67.0, 53.5, *SIZE), folder / "camera.yaml", depth_scale_mm=0.5)
    sequence = open_sequence(folder)
    assert sequence.camera.fx == 100
    assert sequence.source.truth(0).depth_mm[54, 67] in (102 * 0.5, 16384 * 0.5)
    assert sequence.source.truth(0).quality == "exact"


def test_an_image_without_a_pose_is_named(tmp_path: Path) -> None:
    folder = write_v2(tmp_path / "c")
    save(folder / "rgb" / "0011.png", picture(11))
    with pytest.raises(InputError, match=r"0011\.png has no line in pose\.txt"):
        open_sequence(folder)


def test_images_of_another_aspect_are_refused(tmp_path: Path) -> None:
    folder = write_endogslam(tmp_path / "c")
    for file in (folder / "color").iterdir():
        save(file, picture(1, (128, 64)))
    with pytest.raises(CalibrationError, match=r"1350x1080 px, but the images are 128x64 px"):
        open_sequence(folder)


@pytest.mark.parametrize("content", [b"no image", cv2.imencode(".png", np.zeros((8, 10, 3), np.uint8))[1].tobytes()])
def test_depth_that_is_none_is_one_sentence(content: bytes, tmp_path: Path) -> None:
    folder = write_v2(tmp_path / "c")
    (folder / "depth" / "0002_depth.tiff").write_bytes(content)
    with pytest.raises(InputError, match=r"0002_depth\.tiff: expected a depth image") as caught:
        open_sequence(folder).source.truth(2)
    assert "\n" not in str(caught.value)
