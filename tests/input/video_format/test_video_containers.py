"""What a container promises against what it shows: edit lists, stamps, reordered pictures, damage at the end."""

from __future__ import annotations

import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from scopemap.input.opening import open_sequence
from scopemap.input.video import VideoFile
from scopemap.input.video_format.time_stamps import TimeStamps
from tests.support.drawn_clips import RATE
from tests.support.drawn_inputs import number_in, picture
from tests.support.drawn_videos import encode

SIZE = (160, 120)
COUNT = 42  # as many as a picture can carry in its level of red
REORDERED = {"qp": "12", "g": "20", "bf": "3"}


def _pictures(count: int = COUNT) -> list[np.ndarray]:
    return [picture(number, SIZE) for number in range(count)]


def _numbers(source: VideoFile, selection: slice = slice(None)) -> list[int]:
    return [number_in(frame.rgb) for frame in source.frames(selection)]


def _box(content: bytes, *path: bytes) -> tuple[int, int]:
    """Return begin and end of an mp4's box, by the names of those around it."""
    begin, end = 0, len(content)
    for name in path:
        at = content.index(name, begin, end) - 4
        begin, end = at, at + struct.unpack(">I", content[at : at + 4])[0]
    return begin, end


def _edited(file: Path, edits: list[tuple[int, int]]) -> Path:
    """Have an mp4 show parts alone: edits of (first frame, frames), -1 for nothing that lasts so many frames."""
    content = bytearray(file.read_bytes())
    begin, end = _box(bytes(content), b"moov", b"trak", b"edts")
    scale = struct.unpack(">I", content[(at := _box(bytes(content), b"moov", b"mvhd")[0] + 20) : at + 4])[0]
    media = struct.unpack(">I", content[(at := _box(bytes(content), b"mdia", b"mdhd")[0] + 20) : at + 4])[0]
    start = struct.unpack(">i", content[begin + 28 : begin + 32])[0]  # of the first picture: reordered ones come later
    entries = b"".join(
        struct.pack(">IiI", count * scale // RATE, first if first < 0 else start + first * media // RATE, 1 << 16)
        for first, count in edits
    )
    elst = struct.pack(">I4sII", 16 + len(entries), b"elst", 0, len(edits)) + entries
    edts = struct.pack(">I4s", 8 + len(elst), b"edts") + elst
    grown = len(edts) - (end - begin)
    content[begin:end] = edts
    for around in ((b"moov",), (b"moov", b"trak")):
        at = content.index(around[-1]) - 4
        content[at : at + 4] = struct.pack(">I", struct.unpack(">I", content[at : at + 4])[0] + grown)
    assert content.index(b"mdat") < content.index(b"moov")
    file.write_bytes(content)
    return file


@pytest.mark.parametrize("ending", ["mp4", "mov"])
@pytest.mark.parametrize(
    ("edits", "shown"),
    [
        ([(28, 14)], list(range(28, 42))),
        ([(0, 14)], list(range(14))),
        ([(25, 10)], list(range(25, 35))),
        ([(-1, 25), (20, 20)], list(range(20, 40))),
        ([(5, 10), (28, 12)], [*range(5, 15), *range(28, 40)]),
    ],
)
def test_what_an_edit_list_leaves_out_is_not_missing(
    ending: str, edits: list[tuple[int, int]], shown: list[int], tmp_path: Path
) -> None:
    file = _edited(encode(tmp_path / f"v.{ending}", _pictures(), pix_fmt="yuv420p", options=REORDERED), edits)
    source = VideoFile(file)
    assert _numbers(source) == shown
    assert (source.count, source.warnings) == (len(shown), [])
    assert _numbers(source, slice(-4, None)) == shown[-4:]
    assert open_sequence(file, frames="2:6").count == 4


def test_a_trimmed_video_that_breaks_off_is_told(tmp_path: Path) -> None:
    file = _edited(encode(tmp_path / "v.mp4", _pictures(), pix_fmt="yuv420p", options=REORDERED), [(5, 35)])
    content = file.read_bytes()
    moov = slice(*_box(content, b"moov"))
    # The header comes first, as of streamed files, and the last third of the pictures is missing.
    lead, data = content[: _box(content, b"mdat")[0]], content[_box(content, b"mdat")[0] : moov.start]
    header = bytearray(content[moov])
    at = header.index(b"stco") + 8
    for entry in range(struct.unpack(">I", header[at : at + 4])[0]):
        place = at + 4 + 4 * entry
        header[place : place + 4] = struct.pack(">I", struct.unpack(">I", header[place : place + 4])[0] + len(header))
    file.write_bytes(lead + header + data[: len(data) // 2])
    source = VideoFile(file)
    read = len(_numbers(source))
    assert 5 < read < 30
    assert any("breaks off" in str(warning) for warning in source.warnings)


CONTAINERS = [
    ("v.mp4", "libx264", REORDERED),
    ("v.mov", "libx264", REORDERED),
    ("v.mkv", "libx264", REORDERED),
    ("v.avi", "libx264", REORDERED),
    ("v.avi", "mpeg4", {"bf": "2", "b": "4000000"}),
    ("v.ts", "libx264", REORDERED),
    ("v.mpg", "mpeg2video", {"bf": "2", "b": "4000000"}),
    ("v.webm", "libvpx-vp9", {"lag-in-frames": "25", "b": "2000000"}),
    ("v.mp4", "hevc", {"x265-params": "bframes=8:qp=10:log-level=error"}),
]


@pytest.mark.parametrize(("name", "codec", "options"), CONTAINERS)
def test_reordered_pictures_come_in_order_and_on_time(
    name: str, codec: str, options: dict[str, str], tmp_path: Path
) -> None:
    source = VideoFile(encode(tmp_path / name, _pictures(), codec, "yuv420p", options))
    frames = list(source.frames(slice(None)))
    assert [number_in(frame.rgb) for frame in frames] == list(range(COUNT))
    np.testing.assert_allclose(np.diff([frame.time_s for frame in frames]), 1 / RATE, atol=1.1e-3)
    # A transport or programme stream states no count; how long it lasts is estimated from its first part.
    assert source.count == pytest.approx(COUNT, abs=4 if name in ("v.ts", "v.mpg") else 0)
    assert (source.warnings, source.stamped) == ([], True)


def test_leading_frames_without_stamps_are_not_repaired() -> None:
    mend = TimeStamps(25.0)
    times_s = [mend(index, stamp) for index, stamp in enumerate([None, None, None, 0.02, 0.06, 0.10])]
    np.testing.assert_allclose(times_s, np.arange(6) / 25)
    assert mend.repaired == 0


NTSC = Fraction(30000, 1001)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["v.mp4", "v.mkv", "v.avi"])
def test_29_97_frames_a_second_do_not_drift(name: str, tmp_path: Path) -> None:
    """Frame 20,000 is due after 667.3 s; a rate of 29.97 or 30 would be 0.7 ms or 0.67 s off there."""
    count, grey = 20_010, np.full((32, 32, 3), 90, np.uint8)
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream("mpeg4", rate=NTSC)
        stream.width = stream.height = 32
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(grey, format="rgb24")
            frame.pts, frame.time_base = number, 1 / NTSC
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    source = VideoFile(tmp_path / name)
    assert source.count == count
    found = {frame.index: frame.time_s for frame in source.frames(slice(19_990, 20_005))}
    assert list(found) == list(range(19_990, 20_005))
    for index, time_s in found.items():
        assert time_s == pytest.approx(float(index / NTSC), abs=1e-3 if name.endswith("mkv") else 1e-6)


def _damaged(content: bytes, packets: list[tuple[int, int]]) -> bytes:
    damaged, rng = bytearray(content), np.random.default_rng(3)
    for position, size in packets:
        kept = min(6, size)
        damaged[position + kept : position + size] = rng.integers(0, 256, size - kept, dtype=np.uint8).tobytes()
    return bytes(damaged)


def _shown_by_one_thread(file: Path) -> int:
    """As ffprobe counts frames: each packet that fails loses its own picture alone."""
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        stream.thread_type, count = "NONE", 0
        for packet in container.demux(stream):
            try:
                count += len(packet.decode())
            except av.FFmpegError:
                continue
    return count


@pytest.mark.parametrize("last", [(1,), (2,), (3,), (4,), (5,), (2, 5), (1, 2, 3), (1, 6)])
@pytest.mark.parametrize("cut", [lambda whole: whole, lambda whole: _edited(whole, [(5, 30)])])
def test_damage_in_the_last_packets_loses_no_other_picture(
    cut: Callable[[Path], Path], last: tuple[int, ...], tmp_path: Path
) -> None:
    """Decoders in several threads hand out the last pictures together, and none where one of them fails."""
    file = cut(encode(tmp_path / "v.mp4", _pictures(), pix_fmt="yuv420p", options=REORDERED))
    with av.open(str(file)) as container:
        places = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    file.write_bytes(_damaged(file.read_bytes(), [places[-number] for number in last]))
    source = VideoFile(file)
    assert sum(1 for _ in source.frames(slice(None))) == _shown_by_one_thread(file)
    assert not any("breaks off" in str(warning) for warning in source.warnings)
