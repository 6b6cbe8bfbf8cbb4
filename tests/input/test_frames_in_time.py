"""Pictures must come in time: a second more is allowed for each that is passed over."""

from __future__ import annotations

from pathlib import Path

import pytest

from scopemap.input.opening import open_sequence
from scopemap.input.source import Source
from tests.support.drawn_inputs import picture, save


def test_a_late_start_leaves_time_for_the_pictures_before_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(8):
        save(tmp_path / f"{number:03d}.png", picture(number))
    monkeypatch.setattr(Source, "frame_limit_s", 2.0)
    assert [frame.index for frame in open_sequence(tmp_path, frames="5:8").frames()] == [5, 6, 7]
