"""ROS recordings: which pictures, which topic, which camera, which time."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.input.datasets.rosbag import RosBag
from scopemap.input.opening import open_sequence
from tests.support.drawn_bags import IMAGE, SIZE, START_NS, STEP_NS, Bag, small_bag, write_bag1, write_mcap, write_ros2
from tests.support.drawn_inputs import number_in, picture


def first_picture(source: RosBag) -> np.ndarray:
    return next(source.frames(slice(None))).rgb


def of_two(folder: Path, encoding: str, values: np.ndarray, **fields: Any) -> RosBag:
    """A bag of the same picture twice, packed where the encoding says so."""
    bag = Bag()
    for number in range(2):
        if ";" in encoding:
            bag.compressed(IMAGE, number, cv2.imencode(".png", values)[1].tobytes(), encoding)
        else:
            bag.image(IMAGE, number, values, encoding, **fields)
    return RosBag(bag.write_bag1(folder / "a.bag"))


def test_pictures_their_times_and_camera_come_out(tmp_path: Path) -> None:
    for number, write in enumerate((write_bag1, write_ros2, write_mcap)):
        sequence = open_sequence(write(tmp_path / f"{number}"))
        frames = list(sequence.source.frames(slice(None)))
        assert [number_in(frame.rgb) for frame in frames] == [frame.index for frame in frames] == [0, 1, 2, 3]
        np.testing.assert_allclose([f.time_s for f in frames], [(START_NS + i * STEP_NS) / 1e9 for i in range(4)])
        assert all(frame.name.startswith(IMAGE) for frame in frames)
        assert sequence.calibrated
        assert sequence.source.warnings == []


@pytest.mark.parametrize("packing", ["", "BZ2", "LZ4"])
def test_ros1_bags_may_be_packed(tmp_path: Path, packing: str) -> None:
    bag = small_bag(encoding="bgr8").write_bag1(tmp_path / "a.bag", packing)
    assert [number_in(frame.rgb) for frame in RosBag(bag).frames(slice(1, None, 2))] == [1, 3]


@pytest.mark.parametrize(("plugin", "ending"), [("SQLITE3", "db3"), ("MCAP", "mcap")])
@pytest.mark.parametrize("packing", ["", "FILE", "MESSAGE"])
def test_ros2_bags_may_be_packed_or_one_file(tmp_path: Path, plugin: str, ending: str, packing: str) -> None:
    folder = small_bag().write_ros2(tmp_path / "a", plugin, packing).rename(tmp_path / "a b \u00e9")
    assert [number_in(frame.rgb) for frame in RosBag(folder).frames(slice(-2, None))] == [2, 3]
    if not packing:
        file = (folder / f"a.{ending}").rename(tmp_path / f"recording.{ending}")
        assert open_sequence(file).count == 4


# ---- pictures

GREY = np.full((SIZE[1], SIZE[0]), 77, np.uint8)
COLOUR = np.broadcast_to(np.array([200, 120, 40], np.uint8), (SIZE[1], SIZE[0], 3))
WIDE = (COLOUR.astype(np.uint16) << 8) + 13
FILLED = np.pad(COLOUR.reshape(SIZE[1], -1), ((0, 0), (0, 8)), constant_values=255)


def mosaic(order: str) -> np.ndarray:
    values = np.empty((SIZE[1], SIZE[0]), np.uint8)
    for place, colour in enumerate(order):
        values[place // 2 :: 2, place % 2 :: 2] = COLOUR[0, 0, "rgb".index(colour)]
    return values


def opaque(values: np.ndarray) -> np.ndarray:
    return np.dstack([values, np.full(values.shape[:2], 9, values.dtype)])


def level(value: int, dtype: type = np.uint8) -> np.ndarray:
    return np.full_like(GREY, value, dtype)


@pytest.mark.parametrize(
    ("encoding", "values", "fields", "expected"),
    [
        ("rgb8", COLOUR, {}, COLOUR),
        ("bgr8", COLOUR[..., ::-1], {}, COLOUR),
        ("8UC3", COLOUR[..., ::-1], {}, COLOUR),
        ("rgba8", opaque(COLOUR), {}, COLOUR),
        ("bgra8", opaque(COLOUR[..., ::-1]), {}, COLOUR),
        ("rgb16", WIDE, {}, COLOUR),
        ("bgr16", WIDE[..., ::-1], {}, COLOUR),
        ("rgb8", FILLED, {"width": SIZE[0]}, COLOUR),
        ("rgb16", WIDE.byteswap(), {"is_bigendian": 1}, COLOUR),
        *((f"bayer_{order}8", mosaic(order), {}, COLOUR) for order in ("rggb", "bggr", "gbrg", "grbg")),
        ("bayer_rggb16", (mosaic("rggb").astype(np.uint16) << 8) + 5, {}, COLOUR),
        ("bayer_gbrg8; png compressed bayer_gbrg8", mosaic("gbrg"), {}, COLOUR),
        ("mono8", GREY, {}, GREY[..., None]),
        ("mono16", GREY.astype(np.uint16) << 8, {}, GREY[..., None]),
        ("yuv422", np.stack([level(128), level(200)], -1), {}, level(214)[..., None]),
        ("yuv422_yuy2", np.stack([level(200), level(128)], -1), {}, level(214)[..., None]),
    ],
)
def test_every_encoding(
    tmp_path: Path, encoding: str, values: np.ndarray, fields: dict[str, int], expected: np.ndarray
) -> None:
    inner = np.s_[4:-4, 4:-4]
    off = first_picture(of_two(tmp_path, encoding, values, **fields))[inner].astype(int) - expected[inner]
    assert np.abs(off).max() <= (1 if "yuv" in encoding else 0)


@pytest.mark.parametrize(
    ("form", "bits"), [("mono16", 10), ("bayer_rggb16", 12), ("rgb16", 14), ("mono16; png compressed", 16)]
)
def test_as_many_of_16_bits_are_used_as_the_first_image_needs(tmp_path: Path, form: str, bits: int) -> None:
    bag, shape = Bag(), (SIZE[1], SIZE[0], 3) if form == "rgb16" else (SIZE[1], SIZE[0])
    for number, grey in enumerate((200, 100, 300)):
        values = np.minimum(np.full(shape, grey) << (bits - 8), 65535).astype(np.uint16)
        if "png" in form:
            bag.compressed(IMAGE, number, cv2.imencode(".png", values)[1].tobytes(), form)
        else:
            bag.image(IMAGE, number, values, form)
    source = RosBag(bag.write_bag1(tmp_path / "a.bag"))
    assert [int(frame.rgb[20, 20].max()) for frame in source.frames(slice(None))] == [200, 100, 255]
    assert any(f"samples of 16 bits: {bits} are used" in str(note) for note in source.notes)
    assert any("brighter than" in warning for warning in source.warnings) == (bits < 16)


# ---- topics and times


@pytest.mark.parametrize(
    ("counts", "infos", "expected"),
    [
        ({"/a/image": 3, "/b/image": 2}, ("/b/camera_info", "/c/camera_info"), "/b/image"),
        ({"/cam/right/image": 4, "/cam/left/image": 2}, (), "/cam/left/image"),
        ({"/cleft/image": 2, "/right/image": 5, "/other/image": 3}, (), "/other/image"),
        ({"/grey/left/image": 5, "/colour/image": 2}, (), "/colour/image"),
        ({"/a/image": 2, "/b/image": 3}, ("/x/camera_info",), "/b/image"),
    ],
)
def test_the_calibrated_then_the_coloured_then_the_left_then_the_longest_topic_is_taken(
    tmp_path: Path, counts: dict[str, int], infos: tuple[str, ...], expected: str
) -> None:
    bag = Bag()
    for topic, count in counts.items():
        for number in range(count):
            bag.image(topic, number, *((GREY, "mono8") if "grey" in topic else (picture(number, SIZE), "rgb8")))
    for info in infos:
        bag.info(info)
    source = RosBag(bag.write_bag1(tmp_path / "a.bag"))
    assert next(source.frames(slice(None))).name == f"{expected}[0]"
    assert any(f"images of {expected}, one of" in n and "(--dataset rosbag:TOPIC" in n for n in source.notes)
    assert any("the only camera_info, /x/camera_info" in n for n in source.notes) == ("/x/camera_info" in infos)


# ---- cameras

PINHOLE, EIGHT = PinholeCamera(60, 61, 31, 24, *SIZE), (0.1, 0.2, 0.01, 0.02, 0.3, 0.01, 0.02, 0.03)


@pytest.mark.parametrize(
    ("topic", "info", "expected"),
    [
        (IMAGE, {}, PINHOLE),
        (IMAGE, {"model": "rational_polynomial", "d": EIGHT}, OpenCvCamera(PINHOLE, EIGHT)),
        (IMAGE, {"model": "equidistant", "d": (0.1, 0.2)}, FisheyeCamera(PINHOLE, (0.1, 0.2, 0, 0))),
        ("/endoscope/left/image_rect_color", {"d": (-0.2, 0.1, 0, 0, 0)}, PinholeCamera(55, 56, 30, 23, *SIZE)),
    ],
)
def test_lenses_and_rectified_pictures(tmp_path: Path, topic: str, info: dict[str, Any], expected: CameraModel) -> None:
    source = camera(tmp_path, topic, **info)
    assert source.camera == expected
    assert ("P of rectified images" in source.camera_source) == ("rect" in topic)


def camera(tmp_path: Path, topic: str = IMAGE, **info: Any) -> RosBag:
    bag = Bag()
    bag.info(**info)
    for number in range(2):
        bag.image(topic, number, picture(number, SIZE), "rgb8")
    return RosBag(bag.write_bag1(tmp_path / "a.bag"))


def test_region_and_binning_are_applied(tmp_path: Path) -> None:
    full = {"width": 256, "height": 192, "k": np.array([200, 0, 120, 0, 200, 90, 0, 0, 1.0])}
    source = camera(tmp_path, **full, roi=(10, 20, 96, 128), binning_x=2, binning_y=2)
    assert source.camera is not None
    # The point that the whole sensor has at (120, 90) lies at (110, 70) of the region, in pixels of twice the size.
    np.testing.assert_allclose(source.camera.project(np.array([0.0, 0, 1])), [(110.5) / 2 - 0.5, 70.5 / 2 - 0.5])
    np.testing.assert_allclose(source.camera.central.fx, 100)


# ---- depth


def test_depth_that_is_aligned_is_truth(tmp_path: Path) -> None:
    bag = small_bag(3)
    metres = np.full((SIZE[1], SIZE[0]), 0.06, np.float32)
    metres[0, :3] = (0, np.nan, -1)
    for number in (0, 2):
        bag.image("/endoscope/depth_registered/image", number, metres * (1 + number), "32FC1")
        bag.image("/endoscope/depth/image", number, metres, "32FC1")
    source = RosBag(bag.write_ros2(tmp_path / "a", "MCAP"))
    truth = source.truth(2)
    assert truth is not None
    assert truth.quality == "registered"
    assert np.isnan(truth.depth_mm[0, :3]).all()
    np.testing.assert_allclose(truth.depth_mm[1:], 180, rtol=1e-6)
    assert source.truth(1) is None
    assert any("not used" in str(note) and "/endoscope/depth/image" in str(note) for note in source.notes)


@pytest.mark.parametrize(
    ("form", "header", "level", "depth_mm"),
    [
        ("32FC1; compressedDepth png", struct.pack("<iff", 0, 100.0, 0.0), 2000, 1000 * 100 / 2000),
        ("16UC1; png compressed ", b"", 123, 123),
    ],
)
def test_compressed_depth_is_truth_and_no_picture(
    tmp_path: Path, form: str, header: bytes, level: int, depth_mm: float
) -> None:
    bag = small_bag(2)
    content = header + cv2.imencode(".png", np.full((SIZE[1], SIZE[0]), level, np.uint16))[1].tobytes()
    for number in range(4):
        bag.compressed("/cam/depth/image_rect_raw/compressed", number, content, form)
        bag.compressed("/cam/depth_registered/image/compressed", number, content, form)
    source = RosBag(bag.write_bag1(tmp_path / "a.bag"))
    assert next(source.frames(slice(None))).name == f"{IMAGE}[0]"
    np.testing.assert_allclose(source.truth(1).depth_mm, depth_mm)


@pytest.mark.parametrize(
    ("depth", "pictures", "used"),
    [
        ("/cam/depth_unregistered/image", "/cam/image", False),
        ("/cam/depth_not_registered/image", "/cam/image", False),
        ("/cam/unaligned_depth/image", "/cam/image", False),
        ("/cam/depth_registered/image", "/cam/image", True),
        ("/cam/aligned_depth_to_infra1/image", "/cam/color/image", False),
        ("/cam/aligned_depth_to_color/image", "/cam/color/image", True),
        ("/cam/aligned_depth/image", "/cam/color/image", True),
    ],
)
def test_depth_is_that_of_the_pictures_it_names(tmp_path: Path, depth: str, pictures: str, used: bool) -> None:
    bag = Bag()
    for number in range(2):
        bag.image(pictures, number, picture(number, SIZE), "rgb8")
        bag.image(depth, number, np.full((SIZE[1], SIZE[0]), 50, np.uint16), "16UC1")
    assert (RosBag(bag.write_bag1(tmp_path / "a.bag")).truth(0) is not None) == used
