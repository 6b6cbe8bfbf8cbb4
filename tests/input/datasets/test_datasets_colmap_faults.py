"""COLMAP models that are damaged: cut off, contradictory, or claiming more than they hold."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.errors import ScopemapError
from scopemap.input.camera_files.colmap_model import read_cameras, read_images
from scopemap.input.opening import open_sequence
from tests.support.drawn_colmap import (
    CAMERA,
    NAMES,
    SIZE,
    binary_cameras,
    binary_images,
    images,
    stored_pose,
    text_images,
    write_colmap,
)

ROW = "1 1 0 0 0 0 0 0 1 frame_2.png"
CAMERA_ROW = "1 PINHOLE 80 64 61 62 41 30"
TEXTS = {
    "cameras": [
        ("", "it has no camera 1"),
        ("1 PINHOLE 80 64 61 62 41", "found 3 parameters where the model PINHOLE has 4"),
        ("1 PINHOLE 80", "line 1: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found '1 PINHOLE 80'"),
        ("1 PINHOLE 80 64 f 62 41 30", "line 1: expected CAMERA_ID"),
        ("1 PINHOLE 80 64 nan 62 41 30", "a parameter is NaN or infinity"),
        ("1 PINHOLE 80 64 -61 62 41 30", "does not fit images of 80x64 px: focal length -61, 62 px"),
        ("1 PINHOLE 80 64 61 62 400 30", "principal point 399.5, 29.5"),
        ("1 PINHOLE 80 -64 61 62 41 30", "invalid image size, 80x-64 px"),
        (f"1 PINHOLE {10**400} 64 61 62 41 30", "invalid image size"),
        ("1 KALEIDOSCOPE 80 64 61 62", "of the model KALEIDOSCOPE, which is not read"),
        (f"{CAMERA_ROW}\n{CAMERA_ROW}", "camera 1 is repeated"),
        ("\udcff\udcfe\x00\udc80", "cannot read the cameras of a COLMAP model from"),
    ],
    "images": [
        ("# Number of images: 3", "holds no image with its pose"),
        ("1 1 0 0 0 0 0 0 frame_2.png", "line 1: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
        ("1 1 0 x 0 0 0 0 1 frame_2.png", "line 1: expected IMAGE_ID"),
        (f"{ROW}\n\n2 1 0 0 0 0 0 frame_9.png", "line 3: expected IMAGE_ID"),
        (f"{ROW}\n\n{ROW}", "the image 'frame_2.png' is repeated .*line 3"),
        (f"{ROW}\n\n{ROW.replace('frame', './frame')}", "is repeated"),
        ("1 2 0 0 0 0 0 0 1 frame_2.png", "line 1: the quaternion has length 2 instead of 1"),
        ("1 1 0 0 0 0 0 0 1.5 frame_2.png", "line 1: expected the number of a camera before the name, found '1.5'"),
        ("1 1 0 0 0 0 0 0 9 frame_2.png", r"cameras\.txt: it has no camera 9"),
        ("\udcff\udcfe\x00\udc80", "cannot read the images of a COLMAP model from"),
    ],
}
BINARIES = {
    "cameras": [
        (struct.pack("<Q", 0), "it has no camera 1"),
        *(
            (
                struct.pack("<QIiQQ4d", 1, 1, model, *SIZE, *CAMERA[3]),
                f"camera 1 is of an unknown model, number {model}",
            )
            for model in (-1, 18, 2**31 - 1)
        ),
    ],
    "images": [
        (struct.pack("<Q", 0), "holds no image with its pose"),
        (binary_images([("", 1, stored_pose(2)), *images()]), "image 1 has no name"),
        (binary_images([("x" * 5000, 1, stored_pose(2))]), "image 1 has no name"),
        (binary_images([*images(), *images()]), r"the image 'frame_12\.png' is repeated .*image 4"),
        (binary_images(images()).replace(b"frame_2", b"fr\xffme_2"), "codec can't decode"),
        (binary_images([("frame_2.png", 1, (2.0, *stored_pose(2)[1:]))]), "image 1: the quaternion has length"),
    ],
}
FAULTS = [
    (f"{name}.txt", text.encode("utf-8", "surrogateescape"), message)
    for name, rows in TEXTS.items()
    for text, message in rows
] + [(f"{name}.bin", content, message) for name, rows in BINARIES.items() for content, message in rows]


@pytest.mark.parametrize(("name", "content", "message"), FAULTS)
def test_damaged_files(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    write_colmap(tmp_path, name[-3:])
    (tmp_path / "sparse" / "0" / name).write_bytes(content)
    with pytest.raises(ScopemapError, match=message) as caught:
        open_sequence(tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_lines_of_points_may_be_empty_missing_or_long_and_rotations_rounded(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    file = tmp_path / "sparse" / "0" / "images.txt"
    expected = {number: open_sequence(tmp_path).source.pose(number) for number in NAMES}
    whole = text_images(images(), ("", "1 2 3 4 5 6 7 8 9 10 11 12", "3 4 5"))
    no_points = "".join(line + "\n" for line in whole.splitlines() if line.endswith(".png") or line.startswith("#"))
    for text in (whole, no_points, whole.replace("\n", "\r\n"), whole.replace(".png\n", ".png \n")):
        file.write_bytes(text.encode())
        for number, pose in expected.items():
            np.testing.assert_allclose(open_sequence(tmp_path).source.pose(number), pose, atol=1e-12)
    rounded = [(name, camera, (0.7071, 0.0, 0.7069, 0.0, *pose[4:])) for name, camera, pose in images()]
    file.write_text(text_images(rounded))
    pose = open_sequence(tmp_path).source.pose(12)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-14)
    np.testing.assert_allclose(pose, expected[12], atol=1e-2)


@pytest.mark.parametrize("claimed", [4, 10**12])
@pytest.mark.parametrize("name", ["images", "cameras", "points"])
def test_a_count_takes_no_memory(name: str, claimed: int, tmp_path: Path) -> None:
    write_colmap(tmp_path, "bin")
    file = tmp_path / "sparse" / "0" / f"{'cameras' if name == 'cameras' else 'images'}.bin"
    content, count = file.read_bytes(), struct.pack("<Q", claimed)
    one = binary_images([("frame_2.png", 1, stored_pose(2))])
    file.write_bytes(one[:-8] + count if name == "points" else count + content[8:])
    read: Callable[[Path], object] = read_cameras if name == "cameras" else read_images
    tracemalloc.start()
    with pytest.raises(ScopemapError, match=rf"{file.name}: it (claims {claimed} images|is cut off)"):
        read(file)
    assert tracemalloc.get_traced_memory()[1] < 2e6
    tracemalloc.stop()


def test_a_file_cut_off_anywhere_is_a_sentence(tmp_path: Path) -> None:
    for name, content, read in (
        ("images.bin", binary_images(images()), read_images),
        ("cameras.bin", binary_cameras({1: CAMERA, 2: ("RADIAL", *SIZE, (61.0, 40.0, 32.0, 0.0, 0.0))}), read_cameras),
    ):
        file = tmp_path / name
        file.write_bytes(content)
        assert read(file)
        for damaged in (*(content[:length] for length in range(0, len(content), 5)), content + b"\0"):
            file.write_bytes(damaged)
            with pytest.raises(ScopemapError, match=rf"{name}"):
                read(file)


def test_bytes_gone_wrong_end_in_a_sentence_or_a_model(tmp_path: Path) -> None:
    write_colmap(tmp_path, "bin")
    dice, opened = np.random.default_rng(0), 0
    for _ in range(60):
        for name, content in (("images", binary_images(images())), ("cameras", binary_cameras({1: CAMERA}))):
            damaged = bytearray(content)
            for place in dice.integers(0, len(content), 2):
                damaged[place] = dice.integers(0, 256)
            (tmp_path / "sparse" / "0" / f"{name}.bin").write_bytes(bytes(damaged))
        # Anything but an error of ours ends the test.
        with suppress(ScopemapError):
            open_sequence(tmp_path)
            opened += 1
    assert 0 < opened < 55
