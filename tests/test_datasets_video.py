"""Videos that FFmpeg opens only half."""

from __future__ import annotations

from pathlib import Path

import pytest
from drawn_inputs import number_in, write_video

from scopemap.datasets import open_sequence
from scopemap.errors import InputError


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
    with pytest.raises(InputError, match=r"v\.avi: FFmpeg knows no decoder for it"):
        open_sequence(file)


def test_a_video_knows_neither_poses_nor_truth(tmp_path: Path) -> None:
    source = open_sequence(write_video(tmp_path / "v.mp4", 4)).source
    assert (source.pose(0), source.truth(0), source.stamps(slice(None))) == (None, None, None)
