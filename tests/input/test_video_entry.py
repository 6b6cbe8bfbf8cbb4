"""A part of a video: entered at the key picture before it, the same frames as decoded from the first picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest

from scopemap.input.source import SourceFrame
from scopemap.input.video import VideoFile
from tests.support.drawn_clips import tissue, write
from tests.support.drawn_inputs import picture
from tests.support.drawn_videos import encode

SIZE = (96, 64)
COUNT = 130
CLOSED = {"qp": "20", "g": "20", "bf": "3", "sc_threshold": "0"}
CODINGS: dict[str, Callable[[Path], Path]] = {
    "closed.mp4": lambda file: encode(file, _pictures(), pix_fmt="yuv420p", options=CLOSED),
    "closed.mov": lambda file: encode(file, _pictures(), pix_fmt="yuv420p", options=CLOSED),
    "open.mp4": lambda file: encode(
        file, _pictures(), pix_fmt="yuv420p", options=CLOSED | {"x264-params": "open-gop=1:keyint=20:bframes=3"}
    ),
    "hevc.mp4": lambda file: encode(
        file, _pictures(), "hevc", "yuv420p", {"x265-params": "keyint=20:min-keyint=20:bframes=4:log-level=error"}
    ),
    "refreshed.mp4": lambda file: encode(
        file, _pictures(), pix_fmt="yuv420p", options={"qp": "20", "g": "20", "intra-refresh": "1", "bf": "0"}
    ),
    "simple.mp4": lambda file: write(file, _pictures()),
    "closed.mkv": lambda file: encode(file, _pictures(), pix_fmt="yuv420p", options=CLOSED),
    "simple.avi": lambda file: write(file, _pictures()),
}


def _pictures() -> list[np.ndarray]:
    return [tissue(number, SIZE) for number in range(COUNT)]


def _same(found: list[SourceFrame], wanted: list[SourceFrame]) -> None:
    assert [(one.index, one.time_s) for one in found] == [(one.index, one.time_s) for one in wanted]
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one.rgb, other.rgb)


@pytest.mark.parametrize("name", CODINGS)
def test_a_part_is_the_same_as_decoded_from_the_start(name: str, tmp_path: Path) -> None:
    source = VideoFile(CODINGS[name](tmp_path / name))
    every = list(source.frames(slice(None)))
    assert [frame.index for frame in every] == list(range(COUNT))
    for part in (slice(1, 4), slice(19, 22), slice(57, 64), slice(60, 90, 7), slice(118, None), slice(-3, None)):
        _same(list(source.frames(part)), every[part])
    _same(list(source.frames(slice(-12, -8))), every[-12:-8])
    assert list(source.frames(slice(200, 210))) == []
    assert source.warnings == []


def _packets_read(file: Path, part: slice, monkeypatch: pytest.MonkeyPatch) -> int:
    source, read = VideoFile(file), list[int]()
    opened = av.open

    class Counted:
        def __init__(self, container: av.container.InputContainer) -> None:
            self._container = container

        def __enter__(self) -> Counted:
            return self

        def __exit__(self, *_: object) -> None:
            self._container.close()

        def __getattr__(self, name: str) -> object:
            return getattr(self._container, name)

        def demux(self, *streams: object) -> object:
            for packet in self._container.demux(*streams):
                read.append(packet.size)
                yield packet

    with monkeypatch.context() as patched:
        patched.setattr(av, "open", lambda *args, **kwargs: Counted(opened(*args, **kwargs)))
        assert len(list(source.frames(part))) == part.stop - part.start
    return len(read)


@pytest.mark.parametrize(("name", "most"), [("closed.mp4", 60), ("hevc.mp4", 60), ("closed.mkv", COUNT + 1)])
def test_only_pictures_from_the_key_picture_on_are_read(
    name: str, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _packets_read(CODINGS[name](tmp_path / name), slice(105, 108), monkeypatch) <= most


def test_damage_before_a_part_changes_no_number(tmp_path: Path) -> None:
    """Frames keep the numbers that they have in the whole video, and negative ones count those that are shown."""
    file = encode(tmp_path / "v.mp4", [picture(n % 40, (160, 120)) for n in range(120)], options=CLOSED)
    with av.open(str(file)) as container:
        places = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    content = bytearray(file.read_bytes())
    for position, size in (places[23], places[118]):
        content[position : position + size] = bytes(size)
    file.write_bytes(content)
    source = VideoFile(file)
    every = {frame.index: frame for frame in source.frames(slice(None))}
    assert len(every) < 120
    part = list(source.frames(slice(85, 95)))
    assert [frame.index for frame in part] == list(range(85, 95))
    _same(part, [every[number] for number in range(85, 95)])
    last = list(source.frames(slice(-4, None)))
    assert [frame.index for frame in last] == sorted(every)[-4:]
