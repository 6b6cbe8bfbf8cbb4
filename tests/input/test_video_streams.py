"""Which stream of a file is the video, how long it lasts, whether its pictures change their size; files without one."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition
from PIL import Image

from scopemap.apps.inspect.container import read_container
from scopemap.engine.config import InputSettings
from scopemap.engine.errors import InputError
from scopemap.input.opening import open_sequence
from scopemap.input.video import VideoFile
from tests.support.drawn_inputs import number_in, picture

SIZE, SMALL = (160, 120), (96, 64)
RATE = 25
EVERY = InputSettings(skip_duplicates=False)
Stream = tuple[str, Sequence[int], tuple[int, int], Disposition | int]


def _written(file: Path, streams: Sequence[Stream], sound_s: float = 0.0) -> Path:
    """A file with streams of (codec, levels of the pictures, size, disposition), and silence that lasts `sound_s`."""
    with av.open(str(file), "w") as container:
        added = []
        for codec, numbers, size, disposition in streams:
            stream = container.add_stream(codec, rate=RATE)
            stream.width, stream.height = size
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            stream.disposition, stream.bit_rate = disposition, 4_000_000
            added.append((stream, numbers, size))
        sound = container.add_stream("aac", rate=8000) if sound_s else None
        for stream, numbers, size in added:
            for at, number in enumerate(numbers):
                frame = av.VideoFrame.from_ndarray(picture(number, size), format="rgb24")
                frame.pts, frame.time_base = at, Fraction(1, RATE)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        if sound is not None:
            for start in range(0, round(8000 * sound_s), 1024):
                block = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
                block.sample_rate, block.pts, block.time_base = 8000, start, Fraction(1, 8000)
                container.mux(sound.encode(block))
            container.mux(sound.encode())
    return file


COVER: Stream = ("mjpeg", [40], (320, 240), 0)
ATTACHED: Stream = ("mjpeg", [40], (320, 240), Disposition.attached_pic)
USED: Stream = ("mpeg4", range(12), SIZE, Disposition.default)
OTHER: Stream = ("mpeg4", range(20, 30), SMALL, 0)
WITHOUT_DEFAULT: Stream = ("mpeg4", range(12), SIZE, 0)


@pytest.mark.parametrize(
    ("name", "streams", "others"),
    [
        ("v.mkv", [COVER, USED], "stream 0, 320x240 px, a cover picture"),
        ("v.mkv", [COVER, WITHOUT_DEFAULT], "stream 0, 320x240 px, a cover picture"),
        ("v.mp4", [ATTACHED, USED], "stream 1, 320x240 px, a cover picture"),
        ("v.mkv", [OTHER, USED], "stream 0, 96x64 px"),
        ("v.mkv", [USED, OTHER], "stream 1, 96x64 px"),
        ("v.mp4", [OTHER, COVER, USED], "stream 0, 96x64 px, stream 1, 320x240 px, a cover picture"),
    ],
)
def test_the_default_stream_is_used_and_others_are_named(
    name: str, streams: list[Stream], others: str, tmp_path: Path
) -> None:
    file = _written(tmp_path / name, streams)
    source = VideoFile(file)
    assert [number_in(frame.rgb) for frame in source.frames(slice(None))] == list(range(12))
    assert all(rgb.shape == (SIZE[1], SIZE[0], 3) for rgb in source.samples(4))
    (note,) = [str(note) for note in source.notes if "streams" in str(note)]
    assert f"{len(streams)} video streams" in note
    assert note.endswith(f"is used, not {others}")
    facts = read_container(str(file))
    assert facts is not None
    assert (facts["width"], facts["height"]) == SIZE


@pytest.mark.parametrize(
    ("name", "sound_s"), [("v.mkv", 0.2), ("v.mkv", 8.0), ("v.flv", 8.0), ("v.ts", 8.0), ("v.mp4", 8.0)]
)
def test_sound_that_is_longer_or_shorter_breaks_nothing_off(name: str, sound_s: float, tmp_path: Path) -> None:
    codec = "flv1" if name.endswith("flv") else "mpeg4"
    source = VideoFile(_written(tmp_path / name, [(codec, range(40), SIZE, Disposition.default)], sound_s))
    assert len(list(source.frames(slice(None)))) == 40
    assert source.warnings == []
    assert source.count == pytest.approx(40, abs=1)
    assert [frame.index for frame in source.frames(slice(-5, None))] == [35, 36, 37, 38, 39]


def test_a_video_with_sound_that_breaks_off_is_told(tmp_path: Path) -> None:
    file = _written(tmp_path / "v.flv", [("flv1", range(40), SIZE, Disposition.default)], 1.6)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    source = VideoFile(file)
    read = len(list(source.frames(slice(None))))
    assert read < 35
    assert any("breaks off" in str(warning) for warning in source.warnings)
    assert [frame.index for frame in source.frames(slice(-3, None))] == list(range(read - 3, read))


def _joined(file: Path, parts: Sequence[tuple[int, tuple[int, int]]]) -> Path:
    content, first = b"", 0
    for count, size in parts:
        one = _written(file.with_name("part.ts"), [("mpeg4", range(first, first + count), size, 0)])
        content, first = content + one.read_bytes(), first + count
    file.write_bytes(content)
    return file


def test_the_size_is_that_of_the_selected_frames(tmp_path: Path) -> None:
    file = _joined(tmp_path / "joined.ts", [(10, SIZE), (30, SMALL)])
    with pytest.raises(InputError, match=r"pictures have another size.*such as --frames (\d+):\d+$") as refused:
        list(open_sequence(file, settings=EVERY).frames())
    advised = str(refused.value).rpartition(" ")[2]
    for part, size in ((advised, SMALL), ("-20:", SMALL), ("0:8", SIZE), ("2:8", SIZE)):
        sequence = open_sequence(file, frames=part, settings=EVERY)
        frames = list(sequence.frames())
        assert (sequence.source.width, sequence.source.height) == size
        assert not sequence.skipped
        assert len(frames) == {"-20:": 20, "0:8": 8, "2:8": 6}.get(part, len(frames))
    assert len(list(open_sequence(file, frames=advised, settings=EVERY).frames())) >= 29


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"time,x,y\n0.1,2,3\n", r"a text file, not a video; give a video, a folder"),
        ("zeit;größe\n1;2\n".encode("latin-1"), r"a text file, not a video"),
        (b"", r"it is empty"),
        (b"\x00\x00\x00\x20ftypisom\x00\x00\x02\x00" + bytes(4000), r"its index \(moov\) is missing"),
        (bytes(range(256)) * 20, r"not a video, or its beginning is damaged"),
    ],
)
def test_a_file_without_a_video_is_named_by_what_it_is(content: bytes, words: str, tmp_path: Path) -> None:
    file = tmp_path / "v.mp4"
    file.write_bytes(content)
    with pytest.raises(InputError, match=rf"v\.mp4: .*{words}") as refused:
        VideoFile(file)
    assert "Invalid data" not in str(refused.value)


def _packets_of(pictures: int, file: Path) -> list[bytes]:
    """A transport stream, whose packets have 188 bytes; a key picture every 12 pictures."""
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=RATE, options={"g": "12"})
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = *SIZE, "yuv420p", 4_000_000
        for number in range(pictures):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(number, SIZE), format="rgb24")))
        container.mux(stream.encode())
    content = file.read_bytes()
    return [content[at : at + 188] for at in range(0, len(content), 188)]


def test_pictures_that_ffmpeg_fills_in_are_said(tmp_path: Path) -> None:
    """Lost packets end in smeared pictures, which FFmpeg returns as sound ones."""
    packets = _packets_of(36, tmp_path / "whole.ts")
    hole = tmp_path / "hole.ts"
    hole.write_bytes(b"".join(packets[: len(packets) // 2] + packets[len(packets) // 2 + 4 :]))
    source = open_sequence(hole, settings=EVERY).source
    list(source.frames(slice(None)))
    (warning,) = source.warnings
    assert str(warning).startswith("the data of the video hole.ts are interrupted or damaged near frame ")
    assert "unless pieces were joined there" in str(warning), "FFmpeg does not tell a join from a loss"
    assert 8 <= int(str(warning).split("near frame ")[1].split(":")[0]) <= 22


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("stack.tif", "of a TIFF only the first picture is read; save its pages as a folder of images"),
        ("moving.webp", "animated WebP is not read; save it as a video or a folder of images"),
    ],
)
def test_files_of_several_pictures_that_are_not_read_are_named(name: str, why: str, tmp_path: Path) -> None:
    """They were said to hold one frame, or pictures that are too large."""
    first, *others = (Image.fromarray(picture(number, SIZE)) for number in range(5))
    first.save(tmp_path / name, save_all=True, append_images=others)
    with pytest.raises(InputError, match=why):
        open_sequence(tmp_path / name)
