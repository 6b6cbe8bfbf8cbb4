"""COLMAP models, text and binary, with the images that they were made of."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from drawn_inputs import number_in, picture, save

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.colmap_model import ModelCamera, camera_model
from scopemap.cameras.formats.writing import write_calibration
from scopemap.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.errors import CalibrationError, InputError
from scopemap.io.opening import open_sequence
from scopemap.io.reference import reference_trajectory

SIZE = (80, 64)
NUMBERS = [2, 9, 10, 12]
UNPOSED = 9
NAMES = {number: f"frame_{number}.png" for number in NUMBERS if number != UNPOSED}
HALF = 0.5**0.5
CAMERA = ("PINHOLE", *SIZE, (61.0, 62.0, 41.0, 30.0))
MODEL_NUMBERS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11, "SIMPLE_DIVISION": 12, "DIVISION": 13, "SIMPLE_FISHEYE": 14, "FISHEYE": 15,
    "EUCM": 16, "EQUIRECTANGULAR": 17,
}  # fmt: skip

Pose = tuple[float, ...]
Image = tuple[str, int, Pose]  # name, camera, qw qx qy qz tx ty tz
Camera = tuple[str, int, int, tuple[float, ...]]


def stored_pose(number: int) -> Pose:
    """World-to-camera: a quarter turn about y, which takes z to x and x to -z, then a shift of number, 2, 3."""
    return (HALF, 0.0, HALF, 0.0, float(number), 2.0, 3.0)


def true_pose(number: int) -> np.ndarray:
    """Camera-to-world by hand: the turn undone, the camera at minus the turned-back shift."""
    return np.array([[0, 0, -1, 3], [0, 1, 0, -2], [1, 0, 0, -number], [0, 0, 0, 1]], dtype=float)


def images(names: dict[int, str] | None = None, camera: int = 1) -> list[Image]:
    """The images of a model, not in the order of their numbers, as COLMAP writes them."""
    pairs = (names or NAMES).items()
    return [(name, camera, stored_pose(number)) for number, name in sorted(pairs, key=lambda pair: -pair[0])]


def text_images(registered: list[Image], points: tuple[str, ...] = ("", "1.5 2.5 -1 3.5 4.5 7")) -> str:
    lines = ["# Image list with two lines of data per image:", "# Number of images: 3, mean observations per image: 1"]
    for k, (name, camera, pose) in enumerate(registered):
        lines += [f"{k + 5} {' '.join(map(str, pose))} {camera} {name}", points[k % len(points)]]
    return "\n".join(lines) + "\n"


def text_cameras(cameras: dict[int, Camera]) -> str:
    lines = ["# Camera list with one line of data per camera:", ""]
    return "\n".join([*lines, *(f"{n} {m} {w} {h} {' '.join(map(str, p))}" for n, (m, w, h, p) in cameras.items())])


def binary_images(registered: list[Image]) -> bytes:
    content = struct.pack("<Q", len(registered))
    for k, (name, camera, pose) in enumerate(registered):
        content += struct.pack("<I", k + 5) + struct.pack("<7d", *pose) + struct.pack("<I", camera)
        content += name.encode() + b"\0" + struct.pack("<Q", k)
        content += b"".join(struct.pack("<ddQ", 1.5, 2.5, 2**64 - 1) for _ in range(k))
    return content


def binary_cameras(cameras: dict[int, Camera]) -> bytes:
    content = struct.pack("<Q", len(cameras))
    for number, (model, width, height, parameters) in cameras.items():
        content += struct.pack("<IiQQ", number, MODEL_NUMBERS[model], width, height)
        content += struct.pack(f"<{len(parameters)}d", *parameters)
    return content


def write_model(folder: Path, registered: list[Image], cameras: dict[int, Camera], form: str = "txt") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if form == "txt":
        (folder / "images.txt").write_text(text_images(registered))
        (folder / "cameras.txt").write_text(text_cameras(cameras))
    else:
        (folder / "images.bin").write_bytes(binary_images(registered))
        (folder / "cameras.bin").write_bytes(binary_cameras(cameras))
    return folder


def write_pictures(folder: Path, size: tuple[int, int] = SIZE) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in NUMBERS:
        save(folder / f"frame_{number}.png", picture(number, size))
    return folder


def write_scene(root: Path, form: str = "txt", model: str = "sparse/0", **cameras: Camera) -> Path:
    write_pictures(root / "images")
    write_model(root / model, images(), {1: cameras.get("camera", CAMERA)}, form)
    return root


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize("model", [".", "sparse/0", "sparse", "colmap/sparse/0"])
def test_a_model_and_its_images(form: str, model: str, tmp_path: Path) -> None:
    sequence = open_sequence(write_scene(tmp_path / "scene", form, model))
    assert (sequence.source.name, sequence.count, sequence.calibrated) == ("colmap", 4, True)
    # COLMAP counts pixels from the corner of the image.
    assert sequence.camera == PinholeCamera(61.0, 62.0, 40.5, 29.5, *SIZE)
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
    assert any("scale unknown: units are taken as mm" in note for note in sequence.notes)
    assert "1 of 4 images have no pose" in sequence.notes


def test_poses_and_stamps_read_no_image(tmp_path: Path) -> None:
    sequence = open_sequence(write_scene(tmp_path))
    for file in (tmp_path / "images").iterdir():
        file.unlink()
    reference = reference_trajectory(sequence)
    assert reference.indices.tolist() == [2, 10, 12]
    np.testing.assert_allclose(reference.T_world_camera, [true_pose(n) for n in (2, 10, 12)], atol=1e-12)
    assert sequence.source.pose(UNPOSED) is None
    assert sequence.source.pose(999) is None


def test_it_is_found_from_above_and_in_a_folder_of_the_same_name(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "set" / "scene" / "scene")
    (tmp_path / "set" / "papers").mkdir()
    for place in (scene, scene.parent, tmp_path / "set", tmp_path):
        sequence = open_sequence(place)
        assert (sequence.source.name, sequence.path) == ("colmap", scene)
    write_scene(tmp_path / "set" / "scene" / "other")
    with pytest.raises(InputError, match=r"holds 2 sequences \(other, scene\); give one of them"):
        open_sequence(scene.parent)


def test_images_may_lie_beside_the_files_of_the_model(tmp_path: Path) -> None:
    write_model(write_pictures(tmp_path), images(), {1: CAMERA})
    sequence = open_sequence(tmp_path)
    assert (sequence.source.name, sequence.count) == ("colmap", 4)


def test_the_folder_of_another_model_can_be_given(tmp_path: Path) -> None:
    scene = write_scene(tmp_path)
    moved = [(name, camera, (*pose[:4], 7.0, 2.0, 3.0)) for name, camera, pose in images()]
    write_model(scene / "sparse" / "1", moved, {1: CAMERA}, "bin")
    (scene / "sparse" / "2").mkdir()
    sequence = open_sequence(scene)
    np.testing.assert_allclose(sequence.source.pose(2), true_pose(2), atol=1e-12)
    np.testing.assert_allclose(open_sequence(scene / "sparse" / "1").source.pose(2), true_pose(7), atol=1e-12)


def test_without_images_or_in_part_it_is_none(tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "sparse" / "0" / "cameras.txt").unlink()
    assert open_sequence(tmp_path).source.name == "images"
    with pytest.raises(InputError, match=r"no COLMAP model, looked for cameras\.bin and images\.bin, or both as \.txt"):
        open_sequence(tmp_path, dataset="colmap")


def test_binary_comes_before_text_as_in_colmap(tmp_path: Path) -> None:
    write_scene(tmp_path, "txt", camera=("PINHOLE", *SIZE, (50.0, 50.0, 40.0, 32.0)))
    assert open_sequence(tmp_path).camera.fx == 50.0
    write_scene(tmp_path, "bin")
    assert open_sequence(tmp_path).camera.fx == 61.0


@pytest.mark.parametrize("written", ["clip 1/{}", "clip 1\\{}", "elsewhere/{}", "/data/images/{}", "../images/{}"])
def test_names_may_name_folders(written: str, tmp_path: Path) -> None:
    folder = "images/clip 1" if "clip" in written else "images"
    write_pictures(tmp_path / folder)
    write_model(tmp_path / "sparse", images({n: written.format(name) for n, name in NAMES.items()}), {1: CAMERA})
    sequence = open_sequence(tmp_path)
    assert (sequence.source.name, sequence.count) == ("colmap", 4)
    np.testing.assert_allclose(sequence.source.pose(12), true_pose(12), atol=1e-12)


def test_names_that_no_file_system_takes_are_sentences(tmp_path: Path) -> None:
    write_pictures(tmp_path / "images")
    for parent in ("a\0b", "x" * 3000):
        write_model(tmp_path / "sparse", images({2: f"{parent}/none.png"}), {1: CAMERA})
        with pytest.raises(InputError, match="none of the 1 images in the COLMAP model"):
            open_sequence(tmp_path)


def test_images_of_several_folders_are_no_sequence(tmp_path: Path) -> None:
    write_pictures(tmp_path / "images" / "left")
    write_pictures(tmp_path / "images" / "right")
    write_model(tmp_path / "sparse", images({2: "left/frame_2.png", 9: "right/frame_9.png"}), {1: CAMERA})
    with pytest.raises(InputError, match=r"are in 2 folders, a sequence in one"):
        open_sequence(tmp_path)


def test_images_that_are_gone_and_unreadable_ones_are_left_out_and_said(tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "images" / "frame_2.png").unlink()
    (tmp_path / "images" / "frame_10.png").write_bytes(b"no image")
    sequence = open_sequence(tmp_path)
    assert [frame.index for frame, _ in sequence] == [9, 12]
    assert any("1 of 3 images in" in w and "are not beside it" in w for w in sequence.warnings)
    assert any("frame_10.png cannot be read and was left out" in w for w in sequence.warnings)


def test_none_of_the_images_there_is_a_sentence(tmp_path: Path) -> None:
    write_pictures(tmp_path / "images")
    write_model(tmp_path / "sparse", images({2: "a2.jpg"}), {1: CAMERA})
    with pytest.raises(InputError, match=r"none of the 1 images in the COLMAP model \(such as 'a2\.jpg'\) is there"):
        open_sequence(tmp_path)


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize("place", [0, 3, 4, 6])
def test_a_pose_that_is_not_finite_is_none(form: str, place: int, tmp_path: Path) -> None:
    registered = images()
    for k in range(3):
        broken = list(registered[k][2])
        broken[place] = float("nan") if k else float("inf")
        registered[k] = (*registered[k][:2], tuple(broken))
        write_pictures(tmp_path / "images")
        write_model(tmp_path / "sparse", registered, {1: CAMERA}, form)
        if k < 2:
            sequence = open_sequence(tmp_path)
            assert sequence.source.pose(12) is None
            assert (sequence.source.pose(10) is None) == (k == 1)
            np.testing.assert_allclose(sequence.source.pose(2), true_pose(2), atol=1e-12)
            assert any(f"{k + 1} poses in" in warning for warning in sequence.warnings)
    with pytest.raises(InputError, match="every pose of the images that are here holds NaN or infinity"):
        open_sequence(tmp_path)


# ---- cameras

LENSES = {
    "SIMPLE_PINHOLE": ((61.0, 41.0, 30.0), PinholeCamera(61.0, 61.0, 40.5, 29.5, *SIZE)),
    "PINHOLE": ((61.0, 62.0, 41.0, 30.0), PinholeCamera(61.0, 62.0, 40.5, 29.5, *SIZE)),
    "SIMPLE_RADIAL": (
        (61.0, 41.0, 30.0, 0.1),
        OpenCvCamera(PinholeCamera(61.0, 61.0, 40.5, 29.5, *SIZE), (0.1, 0.0, 0.0, 0.0)),
    ),
    "RADIAL": (
        (61.0, 41.0, 30.0, 0.1, 0.02),
        OpenCvCamera(PinholeCamera(61.0, 61.0, 40.5, 29.5, *SIZE), (0.1, 0.02, 0.0, 0.0)),
    ),
    "OPENCV": (
        (61.0, 62.0, 41.0, 30.0, 0.1, 0.02, 0.003, 0.004),
        OpenCvCamera(PinholeCamera(61.0, 62.0, 40.5, 29.5, *SIZE), (0.1, 0.02, 0.003, 0.004)),
    ),
    "OPENCV_FISHEYE": (
        (61.0, 62.0, 41.0, 30.0, 0.1, 0.02, 0.003, 0.004),
        FisheyeCamera(PinholeCamera(61.0, 62.0, 40.5, 29.5, *SIZE), (0.1, 0.02, 0.003, 0.004)),
    ),
}


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize("model", LENSES)
def test_every_lens_is_read_exactly(model: str, form: str, tmp_path: Path) -> None:
    parameters, expected = LENSES[model]
    source = open_sequence(write_scene(tmp_path, form, camera=(model, *SIZE, parameters))).source
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


def test_a_lens_that_bends_nothing_is_a_pinhole(tmp_path: Path) -> None:
    assert isinstance(camera_model(ModelCamera("SIMPLE_RADIAL", *SIZE, (61.0, 40.0, 32.0, 0.0)), "it"), PinholeCamera)


def test_a_camera_of_another_size_is_rescaled_about_the_corner(tmp_path: Path) -> None:
    sequence = open_sequence(write_scene(tmp_path, camera=("PINHOLE", 160, 128, (122.0, 124.0, 82.0, 60.0))))
    assert sequence.source.camera == PinholeCamera(61.0, 62.0, 40.5, 29.5, *SIZE)
    assert "rescaled from 160x128 px" in sequence.camera_source
    write_scene(tmp_path, camera=("PINHOLE", 160, 100, (122.0, 124.0, 82.0, 60.0)))
    with pytest.raises(CalibrationError, match="is for 160x100 px, but the images are 80x64 px"):
        open_sequence(tmp_path)


def test_a_calibration_beside_the_model_wins_and_does_without_its_cameras(tmp_path: Path) -> None:
    write_scene(tmp_path, camera=("EUCM", *SIZE, (61.0, 62.0, 41.0, 30.0, 0.5, 1.0)))
    write_calibration(PinholeCamera(70.0, 70.0, 40.0, 32.0, *SIZE), tmp_path / "camera.yaml")
    assert open_sequence(tmp_path).camera.fx == 70.0


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize("model", ["DIVISION", "EUCM", "EQUIRECTANGULAR", "RAD_TAN_THIN_PRISM_FISHEYE"])
def test_other_models_are_named_and_what_to_do(model: str, form: str, tmp_path: Path) -> None:
    count = {"DIVISION": 5, "EUCM": 6, "EQUIRECTANGULAR": 2, "RAD_TAN_THIN_PRISM_FISHEYE": 16}[model]
    other = (model, *SIZE, (61.0,) * count)
    write_scene(tmp_path, form, camera=other)
    with pytest.raises(CalibrationError, match=rf"is of the model {model}, which is not read: reconstruct with SIMPLE"):
        open_sequence(tmp_path)
    # A camera that none of the images was taken by matters to nobody.
    write_model(tmp_path / "sparse" / "0", images(), {7: other, 1: CAMERA}, form)
    assert open_sequence(tmp_path).camera.fx == 61.0


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
