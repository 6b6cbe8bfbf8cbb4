"""ROS recordings: which pictures, which topic, which camera, which time."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_bags import IMAGE, SIZE, START_NS, STEP_NS, Bag, small_bag, write_bag1, write_mcap, write_ros2
from drawn_inputs import number_in, picture

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.lenses import FisheyeCamera, OpenCvCamera
from scopemap.io.datasets.rosbag import RosBag
from scopemap.io.opening import open_sequence


def test_pictures_their_times_and_camera_come_out(tmp_path: Path) -> None:
    for number, write in enumerate((write_bag1, write_ros2, write_mcap)):
        sequence = open_sequence(write(tmp_path / f"{number}"))
        frames = list(sequence.source.frames(slice(None)))
        assert [number_in(frame.rgb) for frame in frames] == [0, 1, 2, 3]
        assert [frame.index for frame in frames] == [0, 1, 2, 3]
        np.testing.assert_allclose([f.time_s for f in frames], [(START_NS + i * STEP_NS) / 1e9 for i in range(4)])
        assert all(frame.name.startswith(IMAGE) for frame in frames)
        assert sequence.calibrated
        assert sequence.source.warnings == []


@pytest.mark.parametrize("packing", ["", "BZ2", "LZ4"])
def test_ros1_bags_may_be_packed(tmp_path: Path, packing: str) -> None:
    bag = small_bag(encoding="bgr8").write_bag1(tmp_path / "a.bag", packing)
    assert [number_in(frame.rgb) for frame in RosBag(bag).frames(slice(1, None, 2))] == [1, 3]


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("packing", ["", "FILE", "MESSAGE"])
def test_ros2_bags_may_be_packed(tmp_path: Path, plugin: str, packing: str) -> None:
    folder = small_bag().write_ros2(tmp_path / "a", plugin, packing).rename(tmp_path / "a b \u00e9")
    assert [number_in(frame.rgb) for frame in RosBag(folder).frames(slice(-2, None))] == [2, 3]


@pytest.mark.parametrize(("plugin", "ending"), [("SQLITE3", "db3"), ("MCAP", "mcap")])
def test_a_single_file_of_a_ros2_bag_can_be_given(tmp_path: Path, plugin: str, ending: str) -> None:
    folder = small_bag().write_ros2(tmp_path / "a", plugin)
    file = (folder / f"a.{ending}").rename(tmp_path / f"recording.{ending}")
    sequence = open_sequence(file)
    assert (sequence.source.name, sequence.count) == ("rosbag", 4)


GREY = np.full((SIZE[1], SIZE[0]), 77, np.uint8)
COLOUR = np.broadcast_to(np.array([200, 120, 40], np.uint8), (SIZE[1], SIZE[0], 3))
WIDE = (COLOUR.astype(np.uint16) << 8) + 13


def mosaic(order: str) -> np.ndarray:
    values = np.empty((SIZE[1], SIZE[0]), np.uint8)
    for place, colour in enumerate(order):
        values[place // 2 :: 2, place % 2 :: 2] = COLOUR[0, 0, "rgb".index(colour)]
    return values


def opaque(values: np.ndarray) -> np.ndarray:
    return np.dstack([values, np.full(values.shape[:2], 9, values.dtype)])


@pytest.mark.parametrize(
    ("encoding", "values"),
    [
        ("rgb8", COLOUR),
        ("bgr8", COLOUR[..., ::-1]),
        ("8UC3", COLOUR[..., ::-1]),
        ("rgba8", opaque(COLOUR)),
        ("bgra8", opaque(COLOUR[..., ::-1])),
        ("rgb16", WIDE),
        ("bgr16", WIDE[..., ::-1]),
        *((f"bayer_{order}8", mosaic(order)) for order in ("rggb", "bggr", "gbrg", "grbg")),
        ("bayer_rggb16", (mosaic("rggb").astype(np.uint16) << 8) + 5),
    ],
)
def test_colour_of_every_encoding(tmp_path: Path, encoding: str, values: np.ndarray) -> None:
    bag = Bag()
    for number in range(2):
        bag.image(IMAGE, number, values, encoding)
    rgb = next(RosBag(bag.write_bag1(tmp_path / "a.bag")).frames(slice(None))).rgb
    np.testing.assert_array_equal(rgb[4:-4, 4:-4], COLOUR[4:-4, 4:-4])


@pytest.mark.parametrize(
    ("encoding", "values", "level"),
    [
        ("mono8", GREY, 77),
        ("mono16", GREY.astype(np.uint16) << 8, 77),
        ("yuv422", np.stack([np.full_like(GREY, 128), np.full_like(GREY, 200)], -1), 214),
        ("yuv422_yuy2", np.stack([np.full_like(GREY, 200), np.full_like(GREY, 128)], -1), 214),
    ],
)
def test_grey_of_every_encoding(tmp_path: Path, encoding: str, values: np.ndarray, level: int) -> None:
    bag = Bag()
    for number in range(2):
        bag.image(IMAGE, number, values, encoding)
    rgb = next(RosBag(bag.write_bag1(tmp_path / "a.bag")).frames(slice(None))).rgb
    assert (np.abs(rgb.astype(int) - level) <= 1).all()


def test_rows_may_be_filled_up_and_samples_stored_the_other_way_round(tmp_path: Path) -> None:
    bag = Bag()
    for number in range(2):
        filled = np.full((SIZE[1], 3 * SIZE[0] + 8), 255, np.uint8)
        filled[:, : 3 * SIZE[0]] = COLOUR.reshape(SIZE[1], -1)
        bag.image("/filled", number, filled, "rgb8", width=SIZE[0])
        bag.image("/swapped", number, WIDE.byteswap(), "rgb16", is_bigendian=1)
    file = bag.write_bag1(tmp_path / "a.bag")
    for topic in ("/filled", "swapped"):
        rgb = next(open_sequence(file, dataset=f"rosbag:{topic}").source.frames(slice(None))).rgb
        np.testing.assert_array_equal(rgb, COLOUR)


def test_a_compressed_mosaic_gets_its_colours(tmp_path: Path) -> None:
    bag = Bag()
    for number in range(2):
        content = cv2.imencode(".png", mosaic("gbrg"))[1].tobytes()
        bag.compressed(IMAGE, number, content, "bayer_gbrg8; png compressed bayer_gbrg8")
    rgb = next(RosBag(bag.write_bag1(tmp_path / "a.bag")).frames(slice(None))).rgb
    np.testing.assert_array_equal(rgb[4:-4, 4:-4], COLOUR[4:-4, 4:-4])


def test_the_calibrated_then_the_left_then_the_longest_topic_is_taken(tmp_path: Path) -> None:
    def chosen(counts: dict[str, int], infos: tuple[str, ...] = ()) -> tuple[str, list[str]]:
        bag = Bag()
        for topic, count in counts.items():
            for number in range(count):
                bag.image(topic, number, picture(number, SIZE), "rgb8")
        for info in infos:
            bag.info(info)
        file = tmp_path / f"{len(list(tmp_path.iterdir()))}.bag"
        source = RosBag(bag.write_bag1(file))
        return next(source.frames(slice(None))).name.split("[")[0], source.notes

    assert chosen({"/a/image": 3, "/b/image": 2}, ("/b/camera_info", "/c/camera_info"))[0] == "/b/image"
    assert chosen({"/cam/right/image": 4, "/cam/left/image": 2})[0] == "/cam/left/image"
    assert chosen({"/cleft/image": 2, "/right/image": 5, "/other/image": 3})[0] == "/other/image"
    name, notes = chosen({"/a/image": 2, "/b/image": 3})
    assert name == "/b/image"
    assert any("images of /b/image, one of /a/image, /b/image (--dataset rosbag:TOPIC" in note for note in notes)
    assert any("the only camera_info, /x/camera_info" in n for n in chosen({"/a": 2}, ("/x/camera_info",))[1])


def camera(tmp_path: Path, topic: str = IMAGE, **info: Any) -> RosBag:
    bag = Bag()
    bag.info(**info)
    for number in range(2):
        bag.image(topic, number, picture(number, SIZE), "rgb8")
    return RosBag(bag.write_bag1(tmp_path / "a.bag"))


def test_lenses(tmp_path: Path) -> None:
    pinhole = PinholeCamera(60, 61, 31, 24, *SIZE)
    assert camera(tmp_path).camera == pinhole
    eight = (0.1, 0.2, 0.01, 0.02, 0.3, 0.01, 0.02, 0.03)
    (tmp_path / "a.bag").unlink()
    assert camera(tmp_path, model="rational_polynomial", d=eight).camera == OpenCvCamera(pinhole, eight)
    (tmp_path / "a.bag").unlink()
    assert camera(tmp_path, model="equidistant", d=(0.1, 0.2)).camera == FisheyeCamera(pinhole, (0.1, 0.2, 0, 0))


def test_rectified_pictures_are_seen_by_p(tmp_path: Path) -> None:
    source = camera(tmp_path, "/endoscope/left/image_rect_color", d=(-0.2, 0.1, 0, 0, 0))
    assert source.camera == PinholeCamera(55, 56, 30, 23, *SIZE)
    assert "P of rectified images" in source.camera_source


def test_region_and_binning_are_applied(tmp_path: Path) -> None:
    full = {"width": 256, "height": 192, "k": np.array([200, 0, 120, 0, 200, 90, 0, 0, 1.0])}
    source = camera(tmp_path, **full, roi=(10, 20, 96, 128), binning_x=2, binning_y=2)
    assert source.camera is not None
    # The point that the whole sensor has at (120, 90) lies at (110, 70) of the region, in pixels of twice the size.
    np.testing.assert_allclose(source.camera.project(np.array([0.0, 0, 1])), [(110.5) / 2 - 0.5, 70.5 / 2 - 0.5])
    np.testing.assert_allclose(source.camera.central.fx, 100)


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
    assert truth.depth_mm is not None
    assert np.isnan(truth.depth_mm[0, :3]).all()
    np.testing.assert_allclose(truth.depth_mm[1:], 180, rtol=1e-6)
    assert source.truth(1) is None
    assert any("not used: /endoscope/depth/image" in note for note in source.notes)


def test_compressed_depth_is_read(tmp_path: Path) -> None:
    bag = small_bag(2)
    inverse = np.full((SIZE[1], SIZE[0]), 2000, np.uint16)
    content = struct.pack("<iff", 0, 100.0, 0.0) + cv2.imencode(".png", inverse)[1].tobytes()
    for number in range(2):
        bag.compressed("/e/aligned_depth/compressedDepth", number, content, "32FC1; compressedDepth png")
    truth = RosBag(bag.write_bag1(tmp_path / "a.bag")).truth(1)
    assert truth is not None
    np.testing.assert_allclose(truth.depth_mm, 1000 * 100 / 2000)


def test_times_without_stamps_are_those_of_recording(tmp_path: Path) -> None:
    bag = Bag()
    for number in range(3):
        bag.image(IMAGE, number, picture(number, SIZE), "rgb8", stamp_ns=0)
    source = RosBag(bag.write_bag1(tmp_path / "a.bag"))
    expected = [(START_NS + number * STEP_NS + 5) / 1e9 for number in range(3)]
    np.testing.assert_allclose([time for _, time in source.stamps(slice(None))], expected)
    assert any("when they were recorded" in note for note in source.notes)


def test_stamps_decode_no_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = RosBag(small_bag().write_bag1(tmp_path / "a.bag"))
    monkeypatch.setattr("scopemap.io.datasets.rosbag.image_of", lambda message: pytest.fail("decoded"))
    assert [index for index, _ in source.stamps(slice(None, None, 2))] == [0, 2]


def test_compressed_depth_is_no_colour_video_and_may_be_truth(tmp_path: Path) -> None:
    bag = Bag()
    content = cv2.imencode(".png", np.full((SIZE[1], SIZE[0]), 123, np.uint16))[1].tobytes()
    for number in range(4):
        bag.compressed("/cam/depth/image_rect_raw/compressed", number, content, "16UC1; png compressed ")
        bag.compressed("/cam/depth_registered/image/compressed", number, content, "16UC1; png compressed ")
    for number in range(2):
        bag.image("/cam/color/image_raw", number, picture(number, SIZE), "rgb8")
    source = RosBag(bag.write_bag1(tmp_path / "a.bag"))
    assert next(source.frames(slice(None))).name == "/cam/color/image_raw[0]"
    truth = source.truth(1)
    assert truth is not None
    np.testing.assert_array_equal(truth.depth_mm, 123)


def test_colour_is_preferred_to_grey(tmp_path: Path) -> None:
    bag = Bag()
    for number in range(3):
        bag.image("/cam/infra/left/image", number, GREY, "mono8")
    for number in range(2):
        bag.compressed("/cam/color/image", number, cv2.imencode(".png", COLOUR)[1].tobytes(), "rgb8; png compressed")
    assert next(RosBag(bag.write_bag1(tmp_path / "a.bag")).frames(slice(None))).name == "/cam/color/image[0]"


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


@pytest.mark.parametrize(
    ("form", "bits"), [("mono16", 10), ("bayer_rggb16", 12), ("rgb16", 14), ("mono16; png compressed", 16)]
)
def test_as_many_of_16_bits_are_used_as_the_first_image_needs(tmp_path: Path, form: str, bits: int) -> None:
    bag, shape = Bag(), (SIZE[1], SIZE[0], 3) if form == "rgb16" else (SIZE[1], SIZE[0])
    for number, level in enumerate((200, 100, 300)):
        values = np.minimum(np.full(shape, level) << (bits - 8), 65535).astype(np.uint16)
        if "png" in form:
            bag.compressed(IMAGE, number, cv2.imencode(".png", values)[1].tobytes(), form)
        else:
            bag.image(IMAGE, number, values, form)
    source = RosBag(bag.write_bag1(tmp_path / "a.bag"))
    assert [int(frame.rgb[20, 20].max()) for frame in source.frames(slice(None))] == [200, 100, 255]
    assert any(f"samples of 16 bits: {bits} are used" in note for note in source.notes)
    assert any("brighter than" in warning for warning in source.warnings) == (bits < 16)
