"""ROS recordings with something wrong: a sentence or a named repair, nothing lost, no memory taken by a claim."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.engine.errors import CalibrationError, InputError
from scopemap.input.datasets.rosbag import RosBag
from scopemap.input.opening import open_sequence
from tests.support.drawn_bags import IMAGE, INFO, SIZE, START_NS, STEP_NS, Bag, small_bag, write_bag1, write_mcap
from tests.support.drawn_dicom import jpeg
from tests.support.drawn_inputs import number_in, picture

JPEG_START = b"\xff\xd8\xff"


def numbers(source: RosBag) -> list[int]:
    return [number_in(frame.rgb) for frame in source.frames(slice(None))]


@pytest.mark.parametrize("write", [write_bag1, write_mcap])
def test_a_file_that_breaks_off_is_one_sentence_that_says_what_may_mend_it(tmp_path: Path, write: Any) -> None:
    file = write(tmp_path / "a")
    content = file.read_bytes()
    for length in (13, len(content) // 2, len(content) - 9):
        file.write_bytes(content[:length])
        with pytest.raises(InputError, match=r"damaged or was not closed; 'rosbag reindex'"):
            open_sequence(file)


def test_messages_before_a_damaged_one_are_used(tmp_path: Path) -> None:
    bag = Bag()
    size = (512, 400)  # each fills a chunk of its own
    for number in range(4):
        bag.image(IMAGE, number, picture(number, size), "rgb8")
        bag.image("/other", number, np.zeros((800, 700), np.uint8), "mono8")
    folder = bag.write_ros2(tmp_path / "a", "MCAP", "STORAGE")
    file = folder / "a.mcap"
    content = file.read_bytes()
    chunk = content.rfind(b"\x28\xb5\x2f\xfd")
    file.write_bytes(content[:chunk] + b"\0\0\0\0" + content[chunk + 4 :])
    source = open_sequence(file, dataset=f"rosbag:{IMAGE}").source
    read = [number_in(frame.rgb) for frame in source.frames(slice(None))]
    assert read == list(range(len(read)))
    assert 2 <= len(read) < 4
    assert any(f"after {len(read)} messages the bag breaks off" in warning for warning in source.warnings)
    assert [index for index, _ in source.stamps(slice(None)) or []] == list(range(len(read)))


def test_a_picture_that_cannot_be_decoded_is_left_out_and_keeps_its_number(tmp_path: Path) -> None:
    bag = Bag()
    for number in range(4):
        content = jpeg(picture(number, SIZE)) if number != 1 else JPEG_START + b"nothing"
        bag.compressed(f"{IMAGE}/compressed", number, content, "jpeg")
    bag.image("/short", 0, picture(0, SIZE), "rgb8")
    bag.image("/short", 1, picture(1, SIZE), "rgb8", data=np.zeros(9, np.uint8))
    bag.image("/short", 2, picture(2, SIZE), "rgb8")
    file = bag.write_bag1(tmp_path / "a.bag")
    source = RosBag(file, f"{IMAGE}/compressed")
    assert [frame.index for frame in source.frames(slice(None))] == [0, 2, 3]
    assert any("image 1 of" in warning and "was left out" in warning for warning in source.warnings)
    short = RosBag(file, "/short")
    assert numbers(short) == [0, 2]
    assert any("9 bytes for 48 rows of 192 bytes" in warning for warning in short.warnings)


DEPTH = np.ones((48, 64), np.uint16), "16UC1"


@pytest.mark.parametrize(
    ("messages", "message"),
    [
        ([("/depth", DEPTH, {}), ("/depth", DEPTH, {})], f"holds no images .* {INFO}, /depth"),
        ([(IMAGE, (picture(0, SIZE), "nv97"), {})], "encoding 'nv97' of its images is not known"),
        ([(IMAGE, (picture(0, SIZE), "rgb8"), {"height": 60_000, "width": 60_000})], "more than 64 million pixels"),
    ],
)
def test_bags_without_usable_pictures_are_one_sentence(tmp_path: Path, messages: list[Any], message: str) -> None:
    bag = Bag()
    bag.info()
    for number, (topic, (values, encoding), fields) in enumerate(messages):
        bag.image(topic, number, values, encoding, **fields)
    with pytest.raises(InputError, match=message):
        open_sequence(bag.write_bag1(tmp_path / "a.bag"))


def test_topics_sizes_and_stamps_that_do_not_fit(tmp_path: Path) -> None:
    bag = small_bag(2)
    bag.image("/depth", 0, *DEPTH)
    bag.image(IMAGE, 3, picture(2, SIZE), "rgb8", stamp_ns=0)
    bag.image(IMAGE, 4, picture(3, SIZE), "rgb8", stamp_ns=START_NS)
    bag.image(IMAGE, 5, picture(4, (SIZE[0], SIZE[1] + 2)), "rgb8")
    file = bag.write_bag1(tmp_path / "a.bag")
    for topic in ("/nowhere", "/depth"):
        with pytest.raises(InputError, match=f"no images under the topic '{topic}'; there are {IMAGE}"):
            open_sequence(file, dataset=f"rosbag:{topic}")
    with pytest.raises(InputError, match="only rosbag:TOPIC"):
        open_sequence(file, dataset="video:1")
    source = RosBag(file)
    assert source.stamps(slice(None))[2][1] == pytest.approx((START_NS + 3 * STEP_NS + 5) / 1e9)
    assert len(numbers(source)) == 4
    assert source.left_out[4].reason == "64x50 px, others are 64x48 px"
    assert any("hold no time stamp" in warning for warning in source.warnings)
    assert f"the stamps of {IMAGE} do not increase: images keep the order of recording" in source.warnings


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"width": 100, "height": 48}, "100x48"),
        ({"k": np.array([1.0, 0, 31, 0, 1, 24, 0, 0, 1])}, "focal length 1, 1 px"),
        ({"k": np.array([np.nan, 0, 31, 0, 60, 24, 0, 0, 1])}, "must be a finite number, found 'nan'"),
        ({"k": np.array([60.0, 0, 310, 0, 60, 24, 0, 0, 1])}, "principal point 310"),
        ({"model": "double_sphere", "d": (1.0,)}, "double[ _]sphere"),
        ({"model": "rational_polynomial", "d": (0.1,) * 12}, "thin-prism and tilt coefficients"),
        ({"d": (np.nan, 0, 0, 0, 1)}, "distortion_coefficients must be a finite number"),
        ({"k": np.zeros(9)}, ""),
        ({"roi": (1, 1, 48, 64)}, "its region, 64x48 px at 1,1, is no part of 64x48 px"),
    ],
)
def test_a_camera_that_cannot_be_is_told_and_another_may_be_given(
    tmp_path: Path, info: dict[str, Any], message: str
) -> None:
    bag = small_bag(2)
    bag.messages.pop(0)
    bag.info(**info)
    file = bag.write_bag1(tmp_path / "a.bag")
    if message:
        with pytest.raises(CalibrationError, match=message):
            open_sequence(file)
    else:
        sequence = open_sequence(file)
        assert not sequence.calibrated
        assert any("not calibrated (K is zero)" in note for note in sequence.notes)
    (tmp_path / "camera.txt").write_text("60 60 31 24\n")
    assert open_sequence(file, camera=tmp_path / "camera.txt").calibrated


def test_metadata_that_does_not_fit_the_files_is_one_sentence(tmp_path: Path) -> None:
    folder = small_bag().write_ros2(tmp_path / "a", "MCAP")
    metadata = folder / "metadata.yaml"
    text = metadata.read_text()
    assert "- a.mcap" in text
    for damaged in (text.replace("- a.mcap", "- a_1.mcap"), "rosbag2: [", text.replace("a.mcap", "../../b.mcap")):
        metadata.write_text(damaged)
        with pytest.raises(InputError, match="the bag is damaged or was not closed"):
            open_sequence(folder)
    metadata.unlink()
    assert RosBag(folder).count == 4
    (folder / "other.mcap").write_bytes((folder / "a.mcap").read_bytes())
    with pytest.raises(InputError, match=r"2 bags and no metadata\.yaml .*\(a\.mcap, other\.mcap\)"):
        RosBag(folder)


def test_a_count_beyond_the_file_is_bounded(tmp_path: Path) -> None:
    folder = small_bag().write_ros2(tmp_path / "a", "MCAP")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 4", f"message_count: {9 * 10**20}"))
    source = RosBag(folder)
    assert 4 <= source.count < 10**6
    assert numbers(source) == [0, 1, 2, 3]
    metadata.write_text(metadata.read_text().replace(f"message_count: {9 * 10**20}", "message_count: many"))
    with pytest.raises(InputError, match="the bag is damaged"):
        RosBag(folder)


def test_the_package_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write_bag1(tmp_path / "a")
    monkeypatch.setattr("scopemap.input.datasets.rosbag.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install -e '\.\[ros\]'"):
        open_sequence(file)
