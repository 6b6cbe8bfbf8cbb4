"""Pictures that are read again for the texture: a long video is not decoded from its first view to its last."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.input.video import VideoFile
from scopemap.runner.texturing import read_again
from tests.support.drawn_clips import tissue, write


def test_views_far_apart_are_read_each_from_the_key_picture_before(tmp_path: Path) -> None:
    source = VideoFile(write(tmp_path / "clip.mp4", [tissue(number, (96, 64)) for number in range(80)]))  # a key in ten
    every = {frame.index: frame.rgb for frame in source.frames(slice(None))}
    read = list(read_again(source, slice(None), [12, 15, 33, 71]))
    assert [frame.index for frame in read] == [12, 13, 14, 15, 33, 71]
    for frame in read:
        np.testing.assert_array_equal(frame.rgb, every[frame.index])
