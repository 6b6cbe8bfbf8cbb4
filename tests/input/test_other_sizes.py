"""Pictures of another size: up to 1 % is cut or completed, more is left out and named, most is an error."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from scopemap.engine.config import InputSettings
from scopemap.engine.errors import InputError
from scopemap.engine.notices import Notice
from scopemap.input.opening import open_sequence
from scopemap.result.result import Result
from scopemap.result.wording import text_of
from tests.support.drawn_bags import IMAGE, SIZE, START_NS, small_bag
from tests.support.drawn_clips import tissue
from tests.support.drawn_inputs import picture, save
from tests.support.front_door import call
from tests.support.result_files import frame_rows

WIDTH, HEIGHT = 320, 240
FAST = ("--preset", "realtime", "--quiet")
EVERY = InputSettings(skip_duplicates=False)
Change = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of pictures of one size."""
    folder = tmp_path_factory.mktemp("images")
    for number in range(66):
        save(folder / f"{number:03d}.png", tissue(number))
    return folder


def _changed(images: Path, folder: Path, odd: dict[int, Change], count: int = 66) -> Path:
    """So many of the pictures, some of them changed."""
    folder.mkdir()
    for file in sorted(images.iterdir())[:count]:
        shutil.copy(file, folder)
    for number, change in odd.items():
        save(folder / f"{number:03d}.png", change(tissue(number)))
    return folder


def _video(file: Path, sizes: list[tuple[int, int]]) -> Path:
    """Transport streams one behind the other, as recorders write them when the source is switched."""
    content = b""
    for part, size in enumerate(sizes):
        one = file.with_name(f"{part}.ts")
        with av.open(str(one), "w") as container:
            stream = container.add_stream("mpeg2video", rate=25)
            stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
            for number in range(30):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(number, size), format="rgb24")))
            container.mux(stream.encode())
        content += one.read_bytes()
    file.write_bytes(content)
    return file


def _codes(path: Path, **options: object) -> dict[str, Notice]:
    sequence = open_sequence(path, **options)
    shapes = {frame.rgb.shape for frame in sequence.frames()}
    assert len(shapes) == 1
    return {notice.code: notice for notice in sequence.warnings if isinstance(notice, Notice)}


@pytest.mark.slow
@pytest.mark.parametrize("at", [0, 7, 65])
@pytest.mark.parametrize(
    "change",
    [
        lambda rgb: rgb[:, :-1],
        lambda rgb: rgb[:-1],
        lambda rgb: rgb[:-2, :-3],
        lambda rgb: cv2.copyMakeBorder(rgb, 0, 1, 0, 2, cv2.BORDER_REPLICATE),
    ],
)
def test_pictures_a_pixel_apart_are_used(at: int, change: Change, images: Path, tmp_path: Path) -> None:
    folder = _changed(images, tmp_path / "images", {at: change})
    sequence = open_sequence(folder)
    frames = list(sequence.source.frames(slice(None)))
    assert (sequence.source.width, sequence.source.height) == (WIDTH, HEIGHT)
    assert [frame.index for frame in frames] == list(range(66))
    kept = change(tissue(at))[:HEIGHT, :WIDTH]
    # Every pixel stays where it is: a calibration still fits.
    np.testing.assert_array_equal(frames[at].rgb[: kept.shape[0], : kept.shape[1]], kept)
    assert sequence.skipped == []
    assert _codes(folder)["input-resized"].values == {"frames": 1, "size": "320x240", "first": f"{at:03d}.png"}


@pytest.mark.slow
@pytest.mark.parametrize("odd", [{3}, {0, 1, 2}, {5, 60}])
def test_pictures_of_another_size_are_left_out_and_named(odd: set[int], images: Path, tmp_path: Path) -> None:
    folder = _changed(images, tmp_path / "images", {number: lambda rgb: cv2.resize(rgb, (160, 120)) for number in odd})
    sequence = open_sequence(folder)
    assert {frame.index for frame in sequence.source.frames(slice(None))} == set(range(66)) - odd
    assert {one.index: (one.name, one.kind) for one in sequence.skipped} == {n: (f"{n:03d}.png", "size") for n in odd}
    found = _codes(folder)["input-other-size"]
    assert found.values["frames"] == len(odd)
    assert found.values["first"] == f"{min(odd):03d}.png"
    assert "160x120 px, others are 320x240 px" in text_of(found)
    # What is not selected is not named.
    assert "input-other-size" not in _codes(folder, frames=slice(10, 50))


def test_where_most_differ_it_is_an_error(images: Path, tmp_path: Path) -> None:
    sizes = [(320, 240), (160, 120), (200, 150), (96, 80)]
    odd = {n: lambda rgb, n=n: cv2.resize(rgb, sizes[n % 4]) for n in range(40)}
    folder = _changed(images, tmp_path / "images", odd, count=40)
    with pytest.raises(InputError, match=r"no common size \(10 of 320x240 px, 10 of 160x120 px, .*give those of one"):
        open_sequence(folder)


@pytest.mark.parametrize(
    ("sizes", "used", "code"),
    [
        ([(160, 120), (160, 120), (128, 96)], 60, "input-other-size"),
        ([(320, 240), (318, 240)], 60, "input-resized"),
    ],
)
def test_a_video_that_changes_its_size_goes_on(
    sizes: list[tuple[int, int]], used: int, code: str, tmp_path: Path
) -> None:
    file = _video(tmp_path / "joined.ts", sizes)
    assert len(list(open_sequence(file, settings=EVERY).frames())) in (used - 1, used)  # the decoder keeps one back
    assert set(_codes(file)) == {code}


def test_a_video_most_of_which_has_another_size_is_refused(tmp_path: Path) -> None:
    file = _video(tmp_path / "joined.ts", [(160, 120), (128, 96), (128, 96), (128, 96)])
    with pytest.raises(
        InputError, match=r"90 of 1\d\d pictures have another size, such as frame 29, 128x96 px, others are 160x120 px"
    ):
        list(open_sequence(file, settings=EVERY).frames())


def test_a_bag_leaves_them_out_too(tmp_path: Path) -> None:
    bag = small_bag(4)
    bag.image(IMAGE, 5, picture(4, (SIZE[0], SIZE[1] // 2)), "rgb8", stamp_ns=START_NS)
    file = bag.write_bag1(tmp_path / "a.bag")
    assert set(_codes(file)) == {"input-other-size"}


@pytest.mark.slow
def test_the_frame_table_names_them(images: Path, tmp_path: Path) -> None:
    folder = _changed(images, tmp_path / "images", {4: lambda rgb: rgb[:100], 8: lambda rgb: rgb[:, :-1]}, count=12)
    call("run", folder, "--out", tmp_path / "result", *FAST)
    run, rows = Result(tmp_path / "result"), frame_rows(tmp_path / "result")
    assert (rows[4]["status"], rows[4]["reason"]) == ("skipped", "320x100 px, others are 320x240 px")
    assert rows[8]["status"] != "skipped"
    assert run.provenance["skipped"] == {"size": 1}
    codes = {notice["code"] for notice in run.provenance["notices"]}
    assert {"input-resized", "input-other-size"} <= codes
