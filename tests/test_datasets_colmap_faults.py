"""COLMAP models that are damaged: cut off, contradictory, or claiming more than they hold."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from test_datasets_colmap import (
    CAMERA,
    NAMES,
    SIZE,
    binary_cameras,
    binary_images,
    images,
    stored_pose,
    text_images,
    true_pose,
    write_scene,
)

from scopemap.cameras.formats.colmap_model import read_cameras, read_images
from scopemap.errors import CalibrationError, InputError, ScopemapError
from scopemap.io.opening import open_sequence

ROW = "1 1 0 0 0 0 0 0 1 frame_2.png"


# ---- cameras.txt


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("", InputError, "it has no camera 1"),
        ("2 PINHOLE 80 64 61 62 41 30", InputError, "it has no camera 1"),
        ("1 PINHOLE 80 64 61 62 41", CalibrationError, "found 3 parameters where the model PINHOLE has 4"),
        ("1 PINHOLE 80 64 61 62 41 30 0", CalibrationError, "found 5 parameters"),
        (
            "1 PINHOLE 80",
            CalibrationError,
            "line 1: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found '1 PINHOLE 80'",
        ),
        ("one PINHOLE 80 64 61 62 41 30", CalibrationError, "line 1: expected CAMERA_ID"),
        ("1 PINHOLE 80 64 f 62 41 30", CalibrationError, "line 1: expected CAMERA_ID"),
        ("1 PINHOLE 80 64 nan 62 41 30", CalibrationError, "a parameter is NaN or infinity"),
        ("1 OPENCV 80 64 61 62 41 30 0 0 inf 0", CalibrationError, "a parameter is NaN or infinity"),
        ("1 PINHOLE 80 64 -61 62 41 30", CalibrationError, "does not fit images of 80x64 px: focal length -61, 62 px"),
        ("1 PINHOLE 80 64 9000 62 41 30", CalibrationError, "plausible: 24 to 400"),
        ("1 PINHOLE 80 64 61 62 400 30", CalibrationError, "principal point 399.5, 29.5"),
        ("1 PINHOLE 0 64 61 62 41 30", CalibrationError, "0x64 px, which are none"),
        ("1 PINHOLE 80 -64 61 62 41 30", CalibrationError, "80x-64 px, which are none"),
        (f"1 PINHOLE {10**400} 64 61 62 41 30", CalibrationError, "which are none"),
        ("1 KALEIDOSCOPE 80 64 61 62", CalibrationError, "of the model KALEIDOSCOPE, which is not read"),
        ("1 PINHOLE 80 64 61 62 41 30\n1 PINHOLE 80 64 61 62 41 30", CalibrationError, "camera 1 comes again"),
    ],
)
def test_damaged_text_cameras(text: str, error: type[ScopemapError], message: str, tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text(text)
    with pytest.raises(error, match=message) as caught:
        open_sequence(tmp_path)
    assert "cameras.txt" in str(caught.value)
    assert "\n" not in str(caught.value)


# ---- images.txt


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no image with its pose"),
        ("# Number of images: 3", "holds no image with its pose"),
        ("1 1 0 0 0 0 0 0 frame_2.png", "line 1: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
        ("1 1 0 0 0 0 0 0 1", "holds no image with its pose"),
        ("1 1 0 x 0 0 0 0 1 frame_2.png", "line 1: expected IMAGE_ID"),
        (f"{ROW}\n\n2 1 0 0 0 0 0 frame_9.png", "line 3: expected IMAGE_ID"),
        (f"{ROW}\n\n{ROW}", "the image 'frame_2.png' comes again .*line 3"),
        (f"{ROW}\n\n{ROW.replace('frame', './frame')}", "comes again"),
        ("1 2 0 0 0 0 0 0 1 frame_2.png", "line 1: the quaternion has length 2 instead of 1"),
        ("1 0 0 0 0 0 0 0 1 frame_2.png", "line 1: the quaternion has length 0 instead of 1"),
        ("1 1 0 0 0 0 0 0 1.5 frame_2.png", "line 1: expected the number of a camera before the name, found '1.5'"),
        ("1 1 0 0 0 0 0 0 -1 frame_2.png", "expected the number of a camera"),
        ("1 1 0 0 0 0 0 0 9 frame_2.png", r"cameras\.txt: it has no camera 9"),
    ],
)
def test_damaged_text_images(text: str, message: str, tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "sparse" / "0" / "images.txt").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(tmp_path)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("name", ["images", "cameras"])
def test_text_that_is_none_is_a_sentence(name: str, tmp_path: Path) -> None:
    write_scene(tmp_path)
    (tmp_path / "sparse" / "0" / f"{name}.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises((InputError, CalibrationError), match=f"cannot read the {name} of a COLMAP model from"):
        open_sequence(tmp_path)


def test_lines_of_points_may_be_empty_missing_or_long(tmp_path: Path) -> None:
    write_scene(tmp_path)
    file = tmp_path / "sparse" / "0" / "images.txt"
    whole = text_images(images(), ("", "1 2 3 4 5 6 7 8 9 10 11 12", "3 4 5"))
    no_points = "".join(line + "\n" for line in whole.splitlines() if line.endswith(".png") or line.startswith("#"))
    for text in (whole, no_points, whole.replace("\n", "\r\n"), whole.replace(".png\n", ".png \n")):
        file.write_bytes(text.encode())
        source = open_sequence(tmp_path).source
        for number in NAMES:
            np.testing.assert_allclose(source.pose(number), true_pose(number), atol=1e-12)


def test_rounded_quaternions_become_exact_rotations(tmp_path: Path) -> None:
    write_scene(tmp_path)
    rounded = [(name, camera, (0.7071, 0.0, 0.7069, 0.0, *pose[4:])) for name, camera, pose in images()]
    (tmp_path / "sparse" / "0" / "images.txt").write_text(text_images(rounded))
    pose = open_sequence(tmp_path).source.pose(12)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-14)
    np.testing.assert_allclose(pose, true_pose(12), atol=1e-2)


# ---- binary


def write_binary(folder: Path, name: str, content: bytes) -> Path:
    file = folder / name
    file.write_bytes(content)
    return file


@pytest.mark.parametrize("claimed", [4, 10**12])
@pytest.mark.parametrize("name", ["images", "cameras"])
def test_a_count_takes_no_memory(name: str, claimed: int, tmp_path: Path) -> None:
    write_scene(tmp_path, "bin")
    file = tmp_path / "sparse" / "0" / f"{name}.bin"
    file.write_bytes(struct.pack("<Q", claimed) + file.read_bytes()[8:])
    read: Callable[[Path], object] = read_images if name == "images" else read_cameras
    tracemalloc.start()
    with pytest.raises(ScopemapError, match=rf"{name}\.bin: it (claims {claimed} images|is cut off)"):
        read(file)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


@pytest.mark.parametrize("claimed", [2, 10**12, 2**63])
def test_so_does_a_count_of_points(claimed: int, tmp_path: Path) -> None:
    content = binary_images([("frame_2.png", 1, stored_pose(2))])
    file = write_binary(tmp_path, "images.bin", content[:-8] + struct.pack("<Q", claimed))
    with pytest.raises(InputError, match="it is cut off"):
        read_images(file)


def test_a_file_cut_off_anywhere_is_a_sentence(tmp_path: Path) -> None:
    for name, content, read in (
        ("images.bin", binary_images(images()), read_images),
        ("cameras.bin", binary_cameras({1: CAMERA, 2: ("RADIAL", *SIZE, (61.0, 40.0, 32.0, 0.0, 0.0))}), read_cameras),
    ):
        assert read(write_binary(tmp_path, name, content))
        for length in range(0, len(content), 5):
            with pytest.raises(ScopemapError, match=rf"{name}"):
                read(write_binary(tmp_path, name, content[:length]))
        with pytest.raises(ScopemapError, match="bytes are left after the last entry"):
            read(write_binary(tmp_path, name, content + b"\0"))


def test_bytes_gone_wrong_end_in_a_sentence_or_a_model(tmp_path: Path) -> None:
    write_scene(tmp_path, "bin")
    dice = np.random.default_rng(0)
    opened = 0
    for _ in range(60):
        for name, content in (("images", binary_images(images())), ("cameras", binary_cameras({1: CAMERA}))):
            damaged = bytearray(content)
            for place in dice.integers(0, len(content), 2):
                damaged[place] = dice.integers(0, 256)
            write_binary(tmp_path / "sparse" / "0", f"{name}.bin", bytes(damaged))
        # Anything but an error of ours ends the test.
        with suppress(ScopemapError):
            open_sequence(tmp_path)
            opened += 1
    assert 0 < opened < 55


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("images", struct.pack("<Q", 0), "holds no image with its pose"),
        ("images", binary_images([("", 1, stored_pose(2)), *images()]), "image 1 has no name"),
        ("images", binary_images([("x" * 5000, 1, stored_pose(2))]), "image 1 has no name"),
        ("images", binary_images([*images(), *images()]), r"the image 'frame_12\.png' comes again .*image 4"),
        ("images", binary_images(images()).replace(b"frame_2", b"fr\xffme_2"), "codec can't decode"),
        (
            "images",
            binary_images([("frame_2.png", 1, (2.0, *stored_pose(2)[1:]))]),
            "image 1: the quaternion has length",
        ),
        ("cameras", struct.pack("<Q", 0), "it has no camera 1"),
    ],
)
def test_damaged_binary_files(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    write_scene(tmp_path, "bin")
    write_binary(tmp_path / "sparse" / "0", f"{name}.bin", content)
    with pytest.raises(InputError, match=message):
        open_sequence(tmp_path)


@pytest.mark.parametrize("model", [-1, 18, 2**31 - 1])
def test_a_binary_camera_of_an_unknown_model(model: int, tmp_path: Path) -> None:
    write_scene(tmp_path, "bin")
    content = struct.pack("<QIiQQ4d", 1, 1, model, *SIZE, *CAMERA[3])
    write_binary(tmp_path / "sparse" / "0", "cameras.bin", content)
    with pytest.raises(CalibrationError, match=f"camera 1 is of an unknown model, number {model}"):
        open_sequence(tmp_path)
