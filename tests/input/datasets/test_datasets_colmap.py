"""COLMAP models, text and binary, with the images that they were made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from tests.support.drawn_colmap import (
    CAMERA,
    NAMES,
    NUMBERS,
    SIZE,
    UNPOSED,
    images,
    stored_pose,
    write_colmap,
    write_model,
)
from tests.support.drawn_colmap import write_numbered as write_pictures
from tests.support.drawn_inputs import number_in

PLANE, SAME = PinholeCamera(61.0, 62.0, 40.5, 29.5, *SIZE), PinholeCamera(61.0, 61.0, 40.5, 29.5, *SIZE)


def true_pose(number: int) -> np.ndarray:
    """Camera-to-world by hand: the turn undone, the camera at minus the turned-back shift."""
    return np.array([[0, 0, -1, 3], [0, 1, 0, -2], [1, 0, 0, -number], [0, 0, 0, 1]], dtype=float)


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize("model", [".", "sparse/0", "sparse", "colmap/sparse/0"])
def test_a_model_and_its_images(form: str, model: str, tmp_path: Path) -> None:
    sequence = open_sequence(write_colmap(tmp_path / "scene", form, model))
    assert (sequence.source.name, sequence.count, sequence.calibrated) == ("colmap", 4, True)
    # COLMAP counts pixels from the corner of the image.
    assert sequence.camera == PLANE
    assert sequence.camera_source == f"COLMAP cameras.{form}, PINHOLE"
    for (frame, truth), number in zip(sequence, NUMBERS, strict=True):
        assert frame.index == number_in(frame.rgb) == number
        assert frame.time_s == pytest.approx(number / 30)
        if number == UNPOSED:
            assert truth is None
            continue
        np.testing.assert_allclose(truth.T_world_camera, true_pose(number), atol=1e-12)
        assert (truth.index, truth.depth_mm, truth.quality) == (number, None, "sfm")
    assert sequence.warnings == []
    assert any("unknown scale is read as mm" in note for note in sequence.notes)
    assert "1 of 4 images have no pose" in sequence.notes


def test_images_may_lie_beside_the_files_of_the_model(tmp_path: Path) -> None:
    sequence = open_sequence(write_model(write_pictures(tmp_path), images(), {1: CAMERA}))
    assert (sequence.source.name, sequence.count) == ("colmap", 4)


def test_the_folder_of_another_model_can_be_given_and_binary_comes_before_text(tmp_path: Path) -> None:
    scene = write_colmap(tmp_path, camera=("PINHOLE", *SIZE, (50.0, 50.0, 40.0, 32.0)))
    moved = [(name, camera, (*pose[:4], 7.0, 2.0, 3.0)) for name, camera, pose in images()]
    write_model(scene / "sparse" / "1", moved, {1: CAMERA}, "bin")
    assert open_sequence(scene).camera.fx == 50.0
    np.testing.assert_allclose(open_sequence(scene / "sparse" / "1").source.pose(2), true_pose(7), atol=1e-12)
    write_colmap(tmp_path, "bin")
    assert open_sequence(tmp_path).camera.fx == 61.0


def test_without_images_or_in_part_it_is_none(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "sparse" / "0" / "cameras.txt").unlink()
    assert open_sequence(tmp_path).source.name == "images"
    with pytest.raises(InputError, match=r"no COLMAP model, looked for cameras\.bin and images\.bin, or both as \.txt"):
        open_sequence(tmp_path, dataset="colmap")


@pytest.mark.parametrize("written", ["clip 1/{}", "clip 1\\{}", "elsewhere/{}", "/data/images/{}", "../images/{}"])
def test_names_may_name_folders(written: str, tmp_path: Path) -> None:
    write_pictures(tmp_path / ("images/clip 1" if "clip" in written else "images"))
    write_model(tmp_path / "sparse", images({n: written.format(name) for n, name in NAMES.items()}), {1: CAMERA})
    sequence = open_sequence(tmp_path)
    assert (sequence.source.name, sequence.count) == ("colmap", 4)
    np.testing.assert_allclose(sequence.source.pose(12), true_pose(12), atol=1e-12)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({2: "a2.jpg"}, r"none of the 1 images in the COLMAP model \(such as 'a2\.jpg'\) is there"),
        ({2: "a\0b/none.png"}, "none of the 1 images in the COLMAP model"),
        ({2: f"{'x' * 3000}/none.png"}, "none of the 1 images in the COLMAP model"),
        ({2: "left/frame_2.png", 9: "right/frame_9.png"}, "are in 2 folders, a sequence in one"),
    ],
)
def test_names_of_no_sequence_there(names: dict[int, str], message: str, tmp_path: Path) -> None:
    write_pictures(tmp_path / "images")
    write_model(tmp_path / "sparse", images(names), {1: CAMERA})
    with pytest.raises(InputError, match=message):
        open_sequence(tmp_path)


def test_images_that_are_gone_and_unreadable_ones_are_left_out_and_said(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "images" / "frame_2.png").unlink()
    (tmp_path / "images" / "frame_10.png").write_bytes(b"no image")
    sequence = open_sequence(tmp_path)
    assert [frame.index for frame, _ in sequence] == [9, 12]
    assert any("1 of 3 images in" in w and "are not beside it" in w for w in sequence.warnings)
    assert any("frame_10.png cannot be read and was left out" in w for w in sequence.warnings)


@pytest.mark.parametrize(("form", "place", "value"), [("txt", 0, "nan"), ("bin", 3, "inf"), ("bin", 6, "nan")])
def test_a_pose_that_is_not_finite_is_none(form: str, place: int, value: str, tmp_path: Path) -> None:
    write_pictures(tmp_path / "images")
    broken = [(name, camera, (*p[:place], float(value), *p[place + 1 :])) for name, camera, p in images()]
    write_model(tmp_path / "sparse", [*broken[:1], *images()[1:]], {1: CAMERA}, form)
    sequence = open_sequence(tmp_path)
    assert sequence.source.pose(12) is None
    np.testing.assert_allclose(sequence.source.pose(2), true_pose(2), atol=1e-12)
    assert any("1 poses in" in warning for warning in sequence.warnings)
    write_model(tmp_path / "sparse", broken, {1: CAMERA}, form)
    with pytest.raises(InputError, match="every pose of the images that are here holds NaN or infinity"):
        open_sequence(tmp_path)


# ---- cameras


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize(
    ("model", "parameters", "expected"),
    [
        ("SIMPLE_PINHOLE", (61.0, 41.0, 30.0), SAME),
        ("PINHOLE", (61.0, 62.0, 41.0, 30.0), PLANE),
        ("SIMPLE_RADIAL", (61.0, 41.0, 30.0, 0.1), OpenCvCamera(SAME, (0.1, 0.0, 0.0, 0.0))),
        ("SIMPLE_RADIAL", (61.0, 41.0, 30.0, 0.0), SAME),
        ("RADIAL", (61.0, 41.0, 30.0, 0.1, 0.02), OpenCvCamera(SAME, (0.1, 0.02, 0.0, 0.0))),
        ("OPENCV", (*CAMERA[3], 0.1, 0.02, 0.003, 0.004), OpenCvCamera(PLANE, (0.1, 0.02, 0.003, 0.004))),
        ("OPENCV_FISHEYE", (*CAMERA[3], 0.1, 0.02, 0.003, 0.004), FisheyeCamera(PLANE, (0.1, 0.02, 0.003, 0.004))),
    ],
)
def test_every_lens_is_read_exactly(
    model: str, parameters: tuple[float, ...], expected: CameraModel, form: str, tmp_path: Path
) -> None:
    source = open_sequence(write_colmap(tmp_path, form, camera=(model, *SIZE, parameters))).source
    assert source.camera == expected
    point = np.array([0.2, -0.1, 1.0])
    np.testing.assert_allclose(expected.project(point) + 0.5, colmap_pixel(model, parameters, *point[:2]), atol=1e-12)


def colmap_pixel(model: str, parameters: tuple[float, ...], u: float, v: float) -> tuple[float, float]:
    """COLMAP's projection of the point (u, v, 1), from its documentation of the models."""
    one = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
    fx, fy, cx, cy, k1, k2, a, b, *_ = (*parameters[: 1 if one else 0], *parameters, 0, 0, 0, 0)
    r2 = u * u + v * v
    if model == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        t = np.arctan(r)
        scale = t / r * (1 + k1 * t**2 + k2 * t**4 + a * t**6 + b * t**8)
        return fx * u * scale + cx, fy * v * scale + cy
    radial = 1 + k1 * r2 + k2 * r2 * r2
    du = 2 * a * u * v + b * (r2 + 2 * u * u)
    dv = 2 * b * u * v + a * (r2 + 2 * v * v)
    return fx * (u * radial + du) + cx, fy * (v * radial + dv) + cy


def test_a_camera_of_another_size_is_rescaled_about_the_corner(tmp_path: Path) -> None:
    sequence = open_sequence(write_colmap(tmp_path, camera=("PINHOLE", 160, 128, (122.0, 124.0, 82.0, 60.0))))
    assert sequence.source.camera == PLANE
    assert "rescaled from 160x128 px" in sequence.camera_source
    write_colmap(tmp_path, camera=("PINHOLE", 160, 100, (122.0, 124.0, 82.0, 60.0)))
    with pytest.raises(CalibrationError, match="is for 160x100 px, but the images are 80x64 px"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(("model", "count", "form"), [("DIVISION", 5, "txt"), ("EUCM", 6, "bin")])
def test_other_models_are_named_and_what_to_do(model: str, count: int, form: str, tmp_path: Path) -> None:
    other = (model, *SIZE, (61.0,) * count)
    write_colmap(tmp_path, form, camera=other)
    with pytest.raises(CalibrationError, match=rf"is of the model {model}, which is not read: reconstruct with SIMPLE"):
        open_sequence(tmp_path)
    # A camera that none of the images was taken by matters to nobody.
    write_model(tmp_path / "sparse" / "0", images(), {7: other, 1: CAMERA}, form)
    assert open_sequence(tmp_path).camera.fx == 61.0
    write_model(tmp_path / "sparse" / "0", images(), {1: other}, form)
    write_calibration(PinholeCamera(70.0, 70.0, 40.0, 32.0, *SIZE), tmp_path / "camera.yaml")
    assert open_sequence(tmp_path).camera.fx == 70.0


def test_several_cameras_are_one_only_with_equal_intrinsics(tmp_path: Path) -> None:
    write_pictures(tmp_path / "images")
    registered = [(name, 1 + (number == 10), stored_pose(number)) for number, name in NAMES.items()]
    write_model(tmp_path / "sparse", registered, {1: CAMERA, 2: CAMERA})
    assert open_sequence(tmp_path).camera.fx == 61.0
    write_model(tmp_path / "sparse", registered, {1: CAMERA, 2: ("SIMPLE_PINHOLE", *SIZE, (60.0, 41.0, 30.0))})
    with pytest.raises(InputError, match="2 cameras whose intrinsics differ"):
        open_sequence(tmp_path)
    (tmp_path / "images" / "frame_10.png").unlink()
    assert open_sequence(tmp_path).camera.fx == 61.0
