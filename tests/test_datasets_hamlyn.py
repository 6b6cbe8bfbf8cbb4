"""Hamlyn: rectified sequences with stereo depth, and the trackers' test sequences with predicted depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_inputs import number_in, picture, save

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.config import Config
from scopemap.errors import InputError
from scopemap.io.opening import open_sequence
from scopemap.masking.masker import Masker

SIZE = (80, 64)
K = np.array([[70.0, 0.0, 41.0], [0.0, 71.0, 30.5], [0.0, 0.0, 1.0]])
MATRICES = {
    "3x3": K,
    "3x4": np.hstack([K, np.zeros((3, 1))]),
    "4x4": np.block([[K, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]),
    "9": K.reshape(1, 9),
    "12": np.hstack([K, np.zeros((3, 1))]).reshape(12, 1),
    "16": np.vstack([np.hstack([K, [[5.0], [6.0], [0.0]]]), [0, 0, 0, 1]]).reshape(2, 8),
}


def depth_image() -> np.ndarray:
    depth = np.full((SIZE[1], SIZE[0]), 50, np.uint16)
    depth[:10], depth[-10:] = 0, 301
    return depth


def write_images(folder: Path, numbers: list[int], images: str = "image01", depths: str = "depth01") -> Path:
    for name in (images, depths):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for number in numbers:
        save(folder / images / f"{number:010d}.jpg", picture(number, SIZE))
        cv2.imwrite(str(folder / depths / f"{number:010d}.png"), depth_image())
    return folder


def write_rectified(root: Path, name: str = "rectified01") -> Path:
    folder = write_images(root / name, [3, 4, 10])
    write_images(folder, [3, 4, 10], "image02", "depth02")
    (root / "calibration" / name).mkdir(parents=True)
    np.savetxt(root / "calibration" / name / "intrinsics.txt", K)
    return folder


# ---- the rectified set


def test_a_rectified_sequence(tmp_path: Path) -> None:
    folder = write_rectified(tmp_path)
    sequence = open_sequence(folder)
    assert (sequence.source.name, sequence.count, sequence.calibrated) == ("hamlyn", 3, True)
    np.testing.assert_allclose(sequence.camera.matrix, K)
    for (frame, truth), number in zip(sequence, [3, 4, 10], strict=True):
        assert frame.index == truth.index == number_in(frame.rgb) == number
        assert truth.T_world_camera is None
        assert truth.quality == "stereo"
        assert truth.depth_mm.dtype == np.float32
        assert np.isnan(truth.depth_mm[:10]).all()
        np.testing.assert_array_equal(truth.depth_mm[10:-10], 50)
        np.testing.assert_array_equal(truth.depth_mm[-10:], 301)
    assert sequence.warnings == []
    assert any("no pose is known" in note for note in sequence.notes)


@pytest.mark.parametrize(
    "place",
    [
        "rectified01/intrinsics.txt",
        "calibration/rectified01/intrinsics.txt",
        "../calibration/rectified01/intrinsics.txt",
        "intrinsics_rectified01.txt",
    ],
)
def test_intrinsics_are_looked_for_in_every_place(place: str, tmp_path: Path) -> None:
    root = tmp_path / "sets" / "hamlyn"
    folder = write_images(root / "rectified01", [0, 1])
    file = root / place
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(file, MATRICES["3x4"])
    np.testing.assert_allclose(open_sequence(folder).camera.matrix, K)


def test_the_nearest_intrinsics_win(tmp_path: Path) -> None:
    folder = write_rectified(tmp_path)
    own = K.copy()
    own[0, 0] = 77.0
    np.savetxt(folder / "intrinsics.txt", own)
    assert open_sequence(folder).camera.fx == 77.0
    write_calibration(PinholeCamera(60.0, 60.0, 40.0, 32.0, *SIZE), folder / "camera.yaml", depth_scale_mm=0.1)
    sequence = open_sequence(folder)
    assert sequence.camera.fx == 60.0
    assert sequence.source.truth(3).depth_mm[30, 30] == pytest.approx(5.0)


def test_without_intrinsics_the_camera_is_assumed_and_said(tmp_path: Path) -> None:
    sequence = open_sequence(write_images(tmp_path / "rectified05", [0, 1]))
    assert not sequence.calibrated
    assert any("field of view" in note for note in sequence.notes)


def test_the_root_of_one_sequence_leads_to_it_and_of_several_names_them(tmp_path: Path) -> None:
    folder = write_rectified(tmp_path)
    assert open_sequence(tmp_path).path == folder
    write_images(tmp_path / "rectified04", [0, 1])
    with pytest.raises(InputError, match=r"holds 2 sequences \(rectified01, rectified04\); give one of them"):
        open_sequence(tmp_path)


def test_black_side_bars_are_masked_without_being_asked_for(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "rectified14", [])
    for number in range(3):
        image = np.full((64, 120, 3), 120, np.uint8)
        image += np.random.default_rng(number).integers(0, 60, image.shape, np.uint8)
        image[:, :30], image[:, -25:] = 0, 0
        save(folder / "image01" / f"{number:010d}.jpg", image)
    np.savetxt(folder / "intrinsics.txt", K)
    masker = Masker(Config().mask)
    masked = [masker(frame) for frame, _ in open_sequence(folder)]
    assert not masked[-1].valid[:, :27].any()
    assert not masked[-1].valid[:, -22:].any()
    assert masked[-1].valid[:, 33:92].mean() > 0.95


# ---- the trackers' test sequences


def test_a_tracking_sequence(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "test1", [0, 1], "color", "depth")
    np.savetxt(folder / "intrinsics.txt", MATRICES["3x4"])
    sequence = open_sequence(folder)
    assert sequence.source.name == "hamlyn-tracking"
    np.testing.assert_allclose(sequence.camera.matrix, K)
    for frame, truth in sequence:
        assert number_in(frame.rgb) == frame.index
        assert (truth.quality, truth.T_world_camera) == ("predicted", None)
        assert truth.depth_mm[30, 30] == 50


def test_other_names_are_not_taken_for_a_tracking_sequence(tmp_path: Path) -> None:
    folder = write_images(tmp_path / "test1", [0, 1], "color", "depth")
    np.savetxt(folder / "intrinsics.txt", K)
    for file in (folder / "color").iterdir():
        file.rename(file.with_stem(f"a{file.stem}"))
    with pytest.raises(InputError, match="there is no image"):
        open_sequence(folder)
