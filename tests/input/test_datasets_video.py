"""Videos that FFmpeg opens only half, and what a stream says of turns, colours and times."""

from __future__ import annotations

import gc
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scopemap.engine.errors import InputError
from scopemap.input.opening import open_sequence
from scopemap.input.video import VideoFile
from scopemap.input.video_format.time_stamps import TimeStamps
from tests.support.drawn_clips import RATE, clip, tissue, write
from tests.support.drawn_inputs import number_in, picture, write_video
from tests.support.drawn_videos import encode, one_colour


def test_a_video_whose_title_is_no_utf8_is_read(tmp_path: Path) -> None:
    file = write_video(tmp_path / "v.mp4", 4)
    content = file.read_bytes()
    assert b"Lavf" in content
    file.write_bytes(content.replace(b"Lavf", b"\xe9\xff\xe0f"))
    assert [number_in(frame.rgb) for frame, _ in open_sequence(file)] == [0, 1, 2, 3]


def test_a_video_of_an_unknown_codec_is_one_sentence(tmp_path: Path) -> None:
    file = write_video(tmp_path / "v.avi", 4)
    content = file.read_bytes()
    assert b"FMP4" in content
    file.write_bytes(content.replace(b"FMP4", b"ZZZZ"))
    with pytest.raises(InputError, match=r"v\.avi: it has no picture that FFmpeg can decode"):
        open_sequence(file)


COLOURS = [(200, 40, 60), (180, 120, 90), (255, 255, 255), (0, 0, 0), (30, 200, 220)]
FORMS = [
    ("libx264", "yuv420p", {"qp": "0"}),
    ("hevc", "yuv420p10le", {"x265-params": "lossless=1:log-level=error"}),
    ("ffv1", "yuv444p10le", {}),
]


@pytest.mark.parametrize(("codec", "pix_fmt", "options"), FORMS)
@pytest.mark.parametrize("bt709", [False, True])
@pytest.mark.parametrize("full", [False, True])
def test_colours_are_those_that_the_stream_states(
    codec: str, pix_fmt: str, options: dict[str, str], bt709: bool, full: bool, tmp_path: Path
) -> None:
    for number, rgb in enumerate(COLOURS):
        name = f"{number}.{'mkv' if codec == 'ffv1' else 'mp4'}"
        file = one_colour(tmp_path / name, rgb, codec, pix_fmt, bt709=bt709, full=full, options=options)
        frame = next(VideoFile(file).frames(slice(None)))
        assert np.abs(frame.rgb.astype(int) - rgb).max() <= 3


@pytest.mark.parametrize(
    ("degrees", "mirrored", "shown"),
    [
        (0, False, lambda rgb: rgb),
        (90, False, np.rot90),
        (-90, False, lambda rgb: np.rot90(rgb, -1)),
        (180, False, lambda rgb: np.rot90(rgb, 2)),
        (0, True, np.fliplr),
    ],
)
def test_pictures_are_turned_as_they_are_to_be_shown(
    degrees: int, mirrored: bool, shown: Callable[[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    pictures = [tissue(number, (160, 96)) for number in range(3)]

    def prepare(stream: av.VideoStream) -> None:
        stream.set_display_rotation(degrees, hflip=mirrored)
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)

    source = VideoFile(encode(tmp_path / "v.mp4", pictures, prepare=prepare))
    expected = [shown(one) for one in pictures]
    assert (source.height, source.width) == expected[0].shape[:2]
    assert source.pixel_aspect == pytest.approx(3 / 4 if abs(degrees) == 90 else 4 / 3)
    for frame, wanted in zip(source.frames(slice(None)), expected, strict=True):
        assert np.abs(frame.rgb.astype(int) - wanted).mean() < 2
    assert all(one.shape == expected[0].shape for one in source.samples(4))


@pytest.mark.slow
def test_pictures_that_were_read_do_not_wait_for_the_garbage_collector(tmp_path: Path) -> None:
    source = VideoFile(encode(tmp_path / "v.mp4", [tissue(number, (160, 96)) for number in range(12)]))
    gc.collect()
    gc.disable()
    try:
        assert sum(1 for _ in source.frames(slice(None))) == 12
        assert sum(isinstance(one, av.VideoFrame) for one in gc.get_objects()) <= 1
    finally:
        gc.enable()


def _times(file: Path) -> tuple[list[float], list[str]]:
    source = VideoFile(file)
    return [frame.time_s for frame in source.frames(slice(None))], source.warnings


def test_a_variable_rate_is_kept(tmp_path: Path) -> None:
    stamps = [0, 1, 3, 4, 9, 10, 11, 40, 41, 43]
    times_s, warnings = _times(write(tmp_path / "v.mkv", clip(10, size=(64, 48)), stamps))
    np.testing.assert_allclose(times_s, np.array(stamps) / RATE, atol=1e-3)
    assert warnings == []


def test_a_clock_that_jumps_is_mended_with_a_warning(tmp_path: Path) -> None:
    day = 24 * 3600 * RATE
    stamps = [0, 1, 2, day, day + 1, day + 2, day + 4, day + 5]
    times_s, warnings = _times(write(tmp_path / "v.mkv", clip(8, size=(64, 48)), stamps))
    # After the jump the clock's own steps count again.
    assert 0 < times_s[3] - times_s[2] < 60
    np.testing.assert_allclose(np.diff(times_s)[3:] * RATE, [1, 1, 2, 1], atol=0.05)
    assert len(warnings) == 1
    assert "1 time stamp(s) that are missing, do not increase or jump, first at frame 3" in warnings[0]


STAMPS = st.lists(
    st.none() | st.floats(-1e6, 1e6, allow_nan=False) | st.integers(0, 50).map(lambda n: n / 25), max_size=60
)


@given(STAMPS)
def test_mended_times_increase(stamps: list[float | None]) -> None:
    mend = TimeStamps(25.0)
    times_s = [mend(index, stamp) for index, stamp in enumerate(stamps)]
    steps = np.diff(times_s)
    assert (steps > 0).all()
    assert (steps <= 60.0 + 1e-6).all()
    assert (mend.first_repaired is None) == (mend.repaired == 0)


def test_a_stream_without_a_clock_counts_frames(tmp_path: Path) -> None:
    file = encode(tmp_path / "v.h264", clip(6, size=(64, 48)), pix_fmt="yuv420p")
    source = VideoFile(file)
    times_s = [frame.time_s for frame in source.frames(slice(None))]
    assert (np.diff(times_s) > 0).all()
    np.testing.assert_allclose(np.diff(times_s), 1 / source.rate_hz, rtol=0.01)


def test_samples_come_from_all_parts_of_a_video_that_can_be_searched(tmp_path: Path) -> None:
    pictures = [picture(i // 4, (160, 120)) for i in range(80)]
    searched = [number_in(one) for one in VideoFile(write(tmp_path / "all.mp4", pictures)).samples(8)]
    assert len(searched) == 8
    assert min(searched) < 3 < 14 < max(searched)
    one_key_frame = encode(tmp_path / "v.mp4", pictures, options={"qp": "0", "g": "600", "sc_threshold": "0"})
    numbers = [number_in(one) for one in VideoFile(one_key_frame).samples(8)]
    assert numbers == sorted(numbers)
    assert (len(numbers), max(numbers)) == (8, 17)
