"""SERV-CT: the left pictures of an experiment, each with its own calibration, and depth from CT."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_inputs import number_in, picture, save

from scopemap.errors import CalibrationError, InputError
from scopemap.io.opening import open_sequence

SIZE = (80, 64)
P1 = [[90.5, 0, 41.25, 0], [0, 91.0, 30.5, 0], [0, 0, 1, 0]]
P2 = [[90.5, 0, 41.25, -480.0], [0, 91.0, 30.5, 0], [0, 0, 1, 0]]
NUMBERS = [9, 10, 11]


def calibration(P: list[list[float]]) -> dict[str, Any]:
    """P1, P2 and Q as cv2's matrices are written to JSON."""
    return {
        "P1": {"rows": 3, "cols": 4, "data": np.ravel(P).tolist()},
        "P2": {"rows": 3, "cols": 4, "data": np.ravel(P2).tolist()},
        "Q": {"rows": 4, "cols": 4, "data": np.eye(4).ravel().tolist()},
    }


def depth_image(number: int) -> np.ndarray:
    """256 = 1 mm; the upper rows are unknown."""
    values = np.full((SIZE[1], SIZE[0]), 256 * (50 + number) + 64, np.uint16)
    values[:10], values[-10:] = 0, 65535
    return values


def write_experiment(folder: Path, numbers: list[int] | None = None, truth: str = "Ground_truth_CT") -> Path:
    inner = ("Left_rectified", "Right_rectified", "Rectified_calibration", f"{truth}/DepthL", f"{truth}/OcclusionL")
    for name in inner:
        (folder / name).mkdir(parents=True, exist_ok=True)
    for number in NUMBERS if numbers is None else numbers:
        name = f"{number:03d}.png"
        save(folder / "Left_rectified" / name, picture(number, SIZE))
        save(folder / "Right_rectified" / name, picture(number + 20, SIZE))
        (folder / "Rectified_calibration" / f"{number:03d}.json").write_text(json.dumps(calibration(P1)))
        cv2.imwrite(str(folder / truth / "DepthL" / name), depth_image(number))
        # Yellow lies outside the right picture, red is hidden from it, blue is where the scan holds nothing.
        occlusion = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
        occlusion[:, :5], occlusion[:, 5:9], occlusion[:, 60:] = (255, 255, 0), (255, 0, 0), (0, 0, 255)
        save(folder / truth / "OcclusionL" / name, occlusion)
    return folder


# ---- what is there is read


@pytest.mark.parametrize("truth", ["Ground_truth_CT", "Reference_CT"])
def test_an_experiment(truth: str, tmp_path: Path) -> None:
    sequence = open_sequence(write_experiment(tmp_path / "Experiment_2", truth=truth))
    assert (sequence.source.name, sequence.count, sequence.calibrated) == ("serv-ct", 3, True)
    np.testing.assert_array_equal(sequence.camera.matrix, np.array(P1)[:, :3])
    assert sequence.camera_source == "P1 in 009.json"
    for (frame, found), number in zip(sequence, NUMBERS, strict=True):
        assert frame.index == found.index == number_in(frame.rgb) == number
        assert frame.time_s == pytest.approx(number / 30)
        assert (found.T_world_camera, found.quality) == (None, "registered")
        assert found.depth_mm.dtype == np.float32
        assert np.isnan(found.depth_mm[:10]).all()
        assert np.isnan(found.depth_mm[:, 60:]).all()
        np.testing.assert_array_equal(found.depth_mm[10:-10, :60], 50.25 + number)
        np.testing.assert_array_equal(found.depth_mm[-10:, :60], np.float32(65535 / 256))
    assert sequence.warnings == []
    told = " ".join(sequence.notes)
    assert all(words in told for words in ("no video", "no pose is known", "the CT scan", truth))


@pytest.mark.parametrize("outer", ["", "SERV-CT", "SERV-CT/SERV-CT"])
def test_it_is_found_from_outside_and_two_are_named(outer: str, tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / outer / "Experiment_1", [1, 2])
    assert open_sequence(tmp_path).path == folder
    write_experiment(tmp_path / outer / "Experiment_2")
    with pytest.raises(InputError, match=r"holds 2 sequences \(.*Experiment_1, .*Experiment_2\); give one of them"):
        open_sequence(tmp_path)


def test_ct_is_preferred_and_another_scanner_taken_and_said(tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_2")
    write_experiment(folder, truth="Ground_truth_RGB")
    for file in (folder / "Ground_truth_RGB" / "DepthL").iterdir():
        cv2.imwrite(str(file), np.full((SIZE[1], SIZE[0]), 256 * 7, np.uint16))
    assert open_sequence(folder).source.truth(9).depth_mm[30, 30] == 59.25
    shutil.rmtree(folder / "Ground_truth_CT")
    sequence = open_sequence(folder)
    assert sequence.source.truth(9).depth_mm[30, 30] == 7.0
    assert any("structured light" in note for note in sequence.notes)


def test_left_pictures_alone_are_no_experiment(tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_1")
    shutil.rmtree(folder / "Ground_truth_CT")
    sequence = open_sequence(folder)
    assert (sequence.source.name, sequence.source.truth(9)) == ("serv-ct", None)
    shutil.rmtree(folder / "Rectified_calibration")
    shutil.rmtree(folder / "Right_rectified")
    assert open_sequence(folder).source.name == "images"


def test_depth_that_is_missing_is_none_and_without_occlusions_all_of_it_counts(tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_1")
    (folder / "Ground_truth_CT" / "DepthL" / "010.png").unlink()
    (folder / "Ground_truth_CT" / "OcclusionL" / "011.png").unlink()
    truths = [truth for _, truth in open_sequence(folder)]
    assert truths[1] is None
    assert np.isnan(truths[0].depth_mm[30, 60:]).all()
    np.testing.assert_array_equal(truths[2].depth_mm[30], 61.25)


# ---- calibrations


@pytest.mark.parametrize("entry", [P1, {"data": P1}, {"type_id": "opencv-matrix", "data": np.ravel(P1).tolist()}])
def test_forms_of_p1(entry: Any, tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_1")
    for file in (folder / "Rectified_calibration").iterdir():
        file.write_text(json.dumps({"P1": entry}))
    np.testing.assert_array_equal(open_sequence(folder).camera.matrix, np.array(P1)[:, :3])


def test_pictures_of_another_camera_are_brought_to_that_of_the_first(tmp_path: Path) -> None:
    """Points lie where the first camera sees them, in picture and depth alike; their depth stays what it is."""
    folder = write_experiment(tmp_path / "Experiment_1")
    other = np.array(P1)
    other[:2, :3] = [[105.0, 0, 33.0], [0, 106.0, 27.0]]
    (folder / "Rectified_calibration" / "010.json").write_text(json.dumps(calibration(other.tolist())))
    points = np.array([[-10.0, -5, 60], [5, 8, 70], [12, -9, 55]])
    rgb, depth = np.full((64, 80, 3), 60, np.uint8), np.full((64, 80), 30 * 256, np.uint16)
    for point in points:
        u, v, _ = np.rint(other[:, :3] @ point / point[2]).astype(int)
        rgb[v - 1 : v + 2, u - 1 : u + 2] = 250
        depth[v - 1 : v + 2, u - 1 : u + 2] = point[2] * 256
    save(folder / "Left_rectified" / "010.png", rgb)
    cv2.imwrite(str(folder / "Ground_truth_CT" / "DepthL" / "010.png"), depth)
    sequence = open_sequence(folder)
    np.testing.assert_array_equal(sequence.camera.matrix, np.array(P1)[:, :3])
    (before, _), (frame, truth), (after, _) = sequence
    for point in points:
        u, v, _ = np.rint(np.array(P1)[:, :3] @ point / point[2]).astype(int)
        assert frame.rgb[v, u].min() > 180
        assert truth.depth_mm[v, u] == point[2]
    # The first camera sees 12 px further to the left (33.5 / 105 against 41.75 / 90.5): the other knows nothing there.
    assert np.isnan(truth.depth_mm[:, :12]).all()
    assert np.isfinite(truth.depth_mm[20:50, 14:50]).all()
    assert (frame.rgb[:, :12] == 0).all()
    assert (number_in(before.rgb), number_in(after.rgb)) == (9, 11)
    assert any("1 pictures of other cameras" in note for note in sequence.notes)


def test_a_calibration_that_is_missing_is_that_of_the_first_and_said(tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_1")
    (folder / "Rectified_calibration" / "009.json").unlink()
    sequence = open_sequence(folder)
    assert sequence.camera.fx == 90.5
    assert sequence.warnings == ["no calibration for picture(s) 9: taken as of 010.json"]


def test_without_any_the_camera_is_assumed_and_said(tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_1")
    shutil.rmtree(folder / "Rectified_calibration")
    sequence = open_sequence(folder)
    assert not sequence.calibrated
    assert any("field of view" in note for note in sequence.notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no matrix P1 of 3x4 numbers"),
        ("not JSON", "no matrix P1"),
        ("[" * 100_000, "no matrix P1"),
        ("[1, 2]", "no matrix P1"),
        ('{"P2": [1]}', "no matrix P1"),
        ('{"P1": {"rows": 3, "cols": 4}}', "no matrix P1"),
        ('{"P1": {"data": [1, 2, 3]}}', "cannot reshape"),
        ('{"P1": {"data": ["a", 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]}}', "could not convert"),
        ('{"P1": null}', "no matrix P1"),
        (json.dumps(calibration([[1e400, 0, 41, 0], *P1[1:]])), "focal length inf"),
        (json.dumps(calibration([[float("nan"), 0, 41, 0], *P1[1:]])), "focal length nan"),
        (json.dumps(calibration([[-90.5, 0, 41, 0], *P1[1:]])), "focal length -90.5"),
        (json.dumps(calibration([[0.1, 0, 0.5, 0], *P1[1:]])), "does not fit images of 80x64 px"),
        (json.dumps(calibration([[90.5, 0, 360, 0], *P1[1:]])), "principal point 360, 30.5"),
        (json.dumps(calibration([[90.5, 3, 41, 0], *P1[1:]])), "is not .K . 0."),
        (json.dumps(calibration([P1[0], P1[1], [0, 0, 0, 0]])), "is not .K . 0."),
    ],
)
def test_a_calibration_that_is_none_is_one_sentence(text: str, message: str, tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_1")
    (folder / "Rectified_calibration" / "010.json").write_text(text)
    with pytest.raises(CalibrationError, match=message) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)
    assert "010.json" in str(caught.value)


# ---- pictures and depth that are damaged


def test_occlusions_of_another_size_or_damaged_are_refused(tmp_path: Path) -> None:
    folder = write_experiment(tmp_path / "Experiment_1")
    file = folder / "Ground_truth_CT" / "OcclusionL" / "010.png"
    for content in (cv2.imencode(".png", np.zeros((32, 40, 3), np.uint8))[1].tobytes(), b"damaged"):
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"010\.png: expected an image of the size of the depth"):
            open_sequence(folder).source.truth(10)
