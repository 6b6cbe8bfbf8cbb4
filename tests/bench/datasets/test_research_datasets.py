"""Research data sets, one body for all: frames, times, camera, poses in mm and OpenCV axes, depth in mm, places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import inverse, se3, so3_exp
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from scopemap.result.wording import in_words
from scopemap_bench.datasets.c3vd import CAMERA, UNDISTORTED_CAMERA
from scopemap_bench.datasets.sevenscenes import COLOUR_CAMERA, T_COLOUR_DEPTH
from tests.support.drawn_climb import path_of
from tests.support.drawn_datasets import WRITERS
from tests.support.drawn_image_sets import (
    HAMLYN_K,
    P1,
    ROOM,
    STAMPS,
    UNITY_K,
    UNITY_ROWS,
    levels,
    unity_rotated,
    write_experiment,
    write_image,
    write_images,
    write_simcol,
    write_unity,
)
from tests.support.drawn_inputs import SIZE, number_in, poses
from tests.support.drawn_video_sets import KB4, LENS, SCOPE_SIZE, STEREO_SIZE, STIR_K, kinematic_pose

NAN = float("nan")
Depths = tuple[float, float, float]


@dataclass(frozen=True)
class Case:
    """What a copy of a layout holds.

    numbers : of the frames. camera : of the images, None where it is unknown. quality : of the truth. pose, depth : by
    frame number, depth in the first row, in the middle and in the last row, mm. time_s : of a frame. unit_mm : mm per
    unit of the depth files. told : words of the notes.
    """

    numbers: list[int]
    camera: CameraModel | None
    quality: str
    pose: Callable[[int], Any] = lambda n: None
    depth: Callable[[int], Depths | None] = lambda n: None
    time_s: Callable[[int], float] = lambda n: n / 30
    unit_mm: float = 1.0
    told: tuple[str, ...] = ()


def pinhole(K: Any, size: tuple[int, int]) -> PinholeCamera:
    return PinholeCamera(K[0][0], K[1][1], K[0][2], K[1][2], *size)


def unity_pose(number: int, mm_per_unit: float) -> np.ndarray:
    """The pose in OpenCV's axes: columns are Unity's rotations of its own right, down and ahead, y turned over."""
    row = UNITY_ROWS[number]
    mirror = np.array([1, -1, 1])
    columns = [mirror * unity_rotated(row[3:], mirror * axis) for axis in np.eye(3)]
    return se3(np.stack(columns, -1), mm_per_unit * mirror * row[:3])


def turned(axis: tuple[int, int, int], quarter: float, position: list[float]) -> np.ndarray:
    return se3(so3_exp(quarter * np.pi / 2 * np.array(axis)), np.array(position, float))


def of_colmap(number: int) -> np.ndarray | None:
    """x_camera = R x_world + t with half a turn about z: the centre -R^T t is (tx, ty, -tz), tx = N of outN.png."""
    return turned((0, 0, 1), 2, [number + 1, 2, 3]) if number < 3 else None


FISHEYE = FisheyeCamera(PinholeCamera(*KB4[:4], *SCOPE_SIZE), KB4[4:])
CASES = {
    "c3vd": Case(
        [0, 1, 2, 3], CAMERA.resized(*SIZE), "registered", lambda n: poses(4)[n],
        lambda n: (NAN, 32768 / 65535 * 100, NAN), unit_mm=100 / 65535, told=("time stamps",),
    ),
    # "A pixel value of 16,384 corresponds to a depth of 25 mm", says the data set's page.
    "c3vd:v2": Case(
        [*range(11)], CAMERA.resized(*SIZE), "registered", lambda n: poses(11)[n],
        lambda n: (NAN, 25.0004, NAN), unit_mm=100 / 65535,
    ),
    "c3vd:endogslam": Case(
        [*range(11)], UNDISTORTED_CAMERA.resized(*SIZE), "registered", lambda n: poses(11)[n],
        lambda n: (NAN, 40, NAN), unit_mm=100 / 255, told=("8 bit",),
    ),
    "7-scenes": Case(
        [0, 1, 2], COLOUR_CAMERA, "registered", lambda n: poses(3)[n] @ inverse(T_COLOUR_DEPTH),
        lambda n: (NAN, 1500, 1500), told=("brought to the colour camera",),
    ),
    "hamlyn": Case(
        [3, 4, 10], pinhole(HAMLYN_K, (80, 64)), "stereo", depth=lambda n: (NAN, 50, 301),
        told=("no pose is known", "stereo matching"),
    ),
    "hamlyn-tracking": Case(
        [0, 1, 2], PinholeCamera(60, 60, 40, 32, 80, 64), "predicted", depth=lambda n: (NAN, 50, 301),
        told=("predicted",),
    ),
    "endonerf": Case(
        [0, 1, 2, 9, 10], PinholeCamera(71.25, 71.25, 39.5, 31.5, 80, 64), "stereo", lambda n: np.eye(4),
        lambda n: (NAN, 60 + n, 392 if n % 2 else 255), told=("camera is at rest", "stereo matching", "gt_masks"),
    ),
    "serv-ct": Case(
        [9, 10, 11], pinhole(P1, (80, 64)), "registered", depth=lambda n: (NAN, 50.25 + n, 65535 / 256),
        unit_mm=1 / 256, told=("no video", "no pose is known", "the CT scan", "Ground_truth_CT"),
    ),
    "tum": Case(
        [0, 1, 2, 3], PinholeCamera(53.54, 53.92, 31.56, 24.31, 64, 48), "registered",
        lambda n: turned((0, 0, 1), 1, [100 * n, 2000, -500]),
        lambda n: None if n == 2 else (NAN, 1000 + n, 1000 + n), lambda n: STAMPS[n], 0.2, ("m (assumed)",),
    ),
    "oneslam": Case(
        [3, 9, 10, 24], PinholeCamera(70, 71, 41.5, 30.25, 80, 64), "registered",
        lambda n: None if n == 9 else turned((1, 0, 0), 1, [n, -2.5, 40]),
        lambda n: None if n == 10 else (NAN, 40 + n / 1000, 40 + n / 1000), lambda n: n / 25, 1e-3,
        ("poses: of 3 of 4 frames, camera-to-world, mm (assumed)", "taken as registered", "0.001 mm per unit"),
    ),
    "simcol3d": Case(
        [0, 1, 2, 3], pinhole(UNITY_K, (96, 96)), "exact", lambda n: unity_pose(n, 10),
        lambda n: (NAN, 100, 200), unit_mm=200 / 65280, told=("cm", "left-handed"),
    ),
    "endoslam:unity": Case(
        [0, 1, 2, 3], pinhole(UNITY_K, (96, 96)), "exact", lambda n: unity_pose(n, 1000),
        lambda n: (NAN, 400, 10), lambda n: 1 + n * 0.0333334, 10,
        ("depth: 8 bit, unit not documented", "their unit is not documented", "left-handed"),
    ),
    "endoslam:real": Case(
        [60, 61, 63], None, "kinematic", lambda n: turned((0, 0, 1), 0.8 / np.pi, [180 + n, -200, 450]),
        time_s=lambda n: n / 20, told=("camera or robot hand", "published rate of HighCam"),
    ),
    # Near is 0.01 dm, far 4 dm; 1 / (0.25 + 9.975) dm lies between. A tenth of 960x720: c is (c + 0.5) / 10 - 0.5.
    "endomapper-sim": Case(
        [0, 1, 2, 3], PinholeCamera(47.264955, 47.264955, 47.5, 35.5, 96, 72), "exact", lambda n: unity_pose(n, 100),
        lambda n: (NAN, 9.7799511, 1), lambda n: 1 + n * 0.0333334, 100, ("left-handed", "those of trajectory.csv"),
    ),
    "stereomis": Case(
        [*range(6)], OpenCvCamera(PinholeCamera(130.5, 131.5, 81.25, 62.75, *STEREO_SIZE), LENS), "kinematic",
        kinematic_pose, time_s=lambda n: n / 25, told=("metres", "left, the upper half", "masks/ is not used"),
    ),
    "stir": Case(
        [*range(6)], pinhole(STIR_K, STEREO_SIZE), "kinematic", time_s=lambda n: n / 25, told=("points of dye",),
    ),
    "d4d": Case(
        [0, 1, 2, 3], PinholeCamera(75.5, 76.0, 40.25, 30.5, 80, 64), "stereo", depth=lambda n: (NAN, 60 + n, 80),
        unit_mm=1000, told=("structured light", "stereo matching"),
    ),
    "endomapper": Case(
        [*range(6)], FISHEYE, "sfm", of_colmap, time_s=lambda n: n / 50, told=("its scale is arbitrary",),
    ),
    "climb": Case(
        [*range(6)], FISHEYE, "sfm", lambda n: path_of(6)[n], time_s=lambda n: n / 50,
        told=("mm by scales.csv: 6 frames",),
    ),
}  # fmt: skip
WITH_DEPTH = [name for name in CASES if CASES[name].depth(CASES[name].numbers[0]) is not None]


@pytest.mark.parametrize("name", CASES)
def test_frames_camera_and_truth(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    folder = WRITERS[name](tmp_path / ROOM)  # whose name tells TUM's camera
    source = open_sequence(folder).source
    found = list(source.frames(slice(None)))
    assert [frame.index for frame in found] == case.numbers
    assert [number_in(frame.rgb) for frame in found] == [number % 40 for number in case.numbers]
    np.testing.assert_allclose([f.time_s for f in found], [case.time_s(n) for n in case.numbers], rtol=0, atol=1e-6)
    if case.camera is None:
        assert source.camera is None
    else:
        assert type(source.camera) is type(case.camera)
        np.testing.assert_allclose(source.camera.central.matrix, case.camera.central.matrix, atol=1e-9)
        assert getattr(source.camera, "distortion", None) == getattr(case.camera, "distortion", None)
    for number in case.numbers:
        pose, depth, truth = case.pose(number), case.depth(number), source.truth(number)
        if pose is None and depth is None:
            assert truth is None
            continue
        assert truth.quality == case.quality
        if pose is None:
            assert truth.T_world_camera is None
        else:
            np.testing.assert_allclose(truth.T_world_camera, pose, atol=1e-5)
        if depth is None:
            assert truth.depth_mm is None
        else:
            assert truth.depth_mm.dtype == np.float32
            rows, middle = truth.depth_mm.shape[0], truth.depth_mm.shape[1] // 2
            np.testing.assert_allclose(truth.depth_mm[[0, rows // 2, rows - 1], middle], depth, rtol=1e-6)
    assert [w for w in source.warnings if "last row is cut off" not in in_words(w)] == []
    notes = " ".join(map(in_words, source.notes))
    assert [words for words in case.told if words not in notes] == []


@pytest.mark.parametrize("name", ["c3vd", "hamlyn", "serv-ct", "simcol3d", "stereomis", "endomapper", "climb", "tum"])
def test_it_is_found_from_above(name: str, tmp_path: Path) -> None:
    (tmp_path / "outer").mkdir()
    (tmp_path / "readme.txt").write_text("hello")
    folder = WRITERS[name](tmp_path / "outer" / "s")
    assert open_sequence(tmp_path).path == folder


@pytest.mark.parametrize(
    ("write", "one", "other"),
    [
        (write_images, "rectified01", "rectified04"),
        (write_experiment, "Experiment_1", "Experiment_2"),
        (lambda folder, numbers: write_simcol(folder.parent, folder.name), "B1", "B10"),
    ],
)
def test_several_sequences_are_named(write: Callable[..., Path], one: str, other: str, tmp_path: Path) -> None:
    folders = [write(tmp_path / name, [0, 1]) for name in (one, other)]
    names = r"\S*, ".join(folder.name for folder in folders)
    with pytest.raises(InputError, match=rf"holds 2 sequences \({names}\); give one of them"):
        open_sequence(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_calibration_beside_the_frames_wins_with_its_depth_scale(name: str, tmp_path: Path) -> None:
    case, folder = CASES[name], WRITERS[name](tmp_path / "s")
    source = open_sequence(folder).source
    mine = PinholeCamera(0.9 * source.width, 0.9 * source.width, source.width / 2, source.height / 2, source.width,
                         source.height)  # fmt: skip
    write_calibration(mine, folder / "camera.yaml", depth_scale_mm=3 * case.unit_mm)
    found = open_sequence(folder).source
    assert found.camera == mine
    depth = case.depth(case.numbers[0])
    if depth is not None:
        depth_mm = found.truth(case.numbers[0]).depth_mm
        assert depth_mm[depth_mm.shape[0] // 2, 40] == pytest.approx(3 * depth[1], rel=1e-6)
    assert name.split(":")[0] != "c3vd" or found.quality == "exact"


CAMERA_FILES = {
    "hamlyn": "calibration/rectified01/intrinsics.txt",
    "serv-ct": "Rectified_calibration/*.json",
    "simcol3d": "cam.txt",
    "endoslam:unity": "../Calibration/cam.txt",
    "stereomis": "StereoCalibration.ini",
}


@pytest.mark.parametrize("name", CAMERA_FILES)
def test_without_its_calibration_the_camera_is_assumed(name: str, tmp_path: Path) -> None:
    root = tmp_path / "s" / "t"
    root.parent.mkdir()
    folder = WRITERS[name](root)
    for file in {*root.glob(CAMERA_FILES[name]), *folder.glob(CAMERA_FILES[name])}:
        file.unlink()
    sequence = open_sequence(folder, dataset=name.split(":")[0])
    assert not sequence.calibrated
    assert any("field of view" in str(note) for note in sequence.notes)


@pytest.mark.parametrize("name", [name for name in WITH_DEPTH if name not in ("endomapper-sim", "7-scenes", "d4d")])
@pytest.mark.parametrize("content", ["colour", "floats", "damaged"])
def test_depth_of_another_kind_is_refused(name: str, content: str, tmp_path: Path) -> None:
    source = open_sequence(WRITERS[name](tmp_path / "s")).source
    number, file = next(iter(source.depth_files.items()))
    values = {"colour": np.ones((64, 80, 3), np.uint16), "floats": levels(np.float32, 3.5, 3.5)}
    if content == "damaged":
        file.write_bytes(file.read_bytes()[:40])
    else:
        write_image(tmp_path / "values.tiff", values[content])
        file.write_bytes((tmp_path / "values.tiff").read_bytes())
    with pytest.raises(InputError, match=r"expected a depth image of one (8|16|8- or 16)-bit channel") as caught:
        source.truth(number)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", WITH_DEPTH)
def test_a_depth_file_that_is_missing_leaves_the_pose(name: str, tmp_path: Path) -> None:
    folder = WRITERS[name](tmp_path / "s")
    number, file = next(iter(open_sequence(folder).source.depth_files.items()))
    file.unlink()
    truth = open_sequence(folder).source.truth(number)
    if CASES[name].pose(number) is None:
        assert truth is None
    else:
        assert truth.depth_mm is None
        assert truth.T_world_camera is not None


@pytest.mark.parametrize("number", range(4))
def test_a_point_of_the_scene_is_seen_where_unity_draws_it(number: int, tmp_path: Path) -> None:
    sequence = open_sequence(write_unity(tmp_path / "UnityCam" / "Colon"))
    x, y, z = local = np.array([0.015, 0.025, 0.08])  # right of the axis, above it, before the camera
    world_mm = 1000 * (unity_rotated(UNITY_ROWS[number][3:], local) + UNITY_ROWS[number][:3]) * [1, -1, 1]
    in_camera = np.linalg.inv(sequence.source.pose(number)) @ [*world_mm, 1]
    drawn_at = [UNITY_K[0, 2] + UNITY_K[0, 0] * x / z, UNITY_K[1, 2] - UNITY_K[1, 1] * y / z]
    np.testing.assert_allclose(sequence.camera.project(in_camera[:3]), drawn_at, atol=1e-4)
