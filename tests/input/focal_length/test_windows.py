"""Windows of a sequence: which frames they hold."""

from __future__ import annotations

from pathlib import Path

import pytest

from scopemap.engine.config import Config
from scopemap.input.focal_length.windows import frames_of_windows
from scopemap.input.opening import open_sequence
from tests.support.drawn_inputs import picture, save


@pytest.mark.parametrize("count", [3, 5, 6, 12, 23])
def test_every_window_has_a_host_and_two_partners(count: int, tmp_path: Path) -> None:
    for number in range(count):
        save(tmp_path / f"{number:03d}.png", picture(number))
    windows = [[frame.index for frame in frames] for frames in frames_of_windows(open_sequence(tmp_path), Config())]
    assert [window[0] for window in windows] == [*range(0, count - 2, 5)]
    assert min(len(window) for window in windows) >= 3
    assert all(window == [*range(window[0], window[0] + len(window))] for window in windows)
