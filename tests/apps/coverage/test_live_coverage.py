"""The map of what was not seen during a live session: it grows, and a failure does not end the session."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import trimesh

from scopemap.apps.coverage import live_map
from scopemap.apps.coverage.coverage import coverage
from scopemap.apps.coverage.live_map import KeptDepth, LiveCoverage
from scopemap.engine.config import Config
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import se3
from scopemap.result.depth_maps import DepthReader, DepthWriter
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from tests.apps.coverage.test_coverage import ALONG_THE_TUBE, without
from tests.support.drawn_run import CAMERA, changed, drawn_result, tube

pytestmark = pytest.mark.slow

NO_SURFACE = "the run so far has no surface"


@dataclass
class Volume:
    """The tube until `ahead_mm`."""

    ahead_mm: float

    def extract_mesh(self) -> trimesh.Trimesh:
        return without(tube(), lambda points: points[:, 2] > self.ahead_mm)


@dataclass
class Drawn:
    """A reconstructor whose surface is the tube until `ahead_mm`."""

    ahead_mm: float = 0.0
    scale_known: bool = False

    def depth_writer(self, folder: Path) -> DepthWriter:
        return DepthWriter(folder)

    def so_far(self, frames: FrameTable) -> tuple[Result, Volume | None]:
        config = Config.load(settings={"fusion.voxel_mm": 0.8})
        result = changed(drawn_result(), frames=frames, mesh=trimesh.Trimesh(), config=config, others=[])
        return result, Volume(self.ahead_mm) if self.ahead_mm else None


def step_of(index: int, number: int = 0) -> Any:
    T = se3(np.eye(3), ALONG_THE_TUBE[index % 30])
    seen = render_mesh(tube(), CAMERA, T)
    frame = Frame(index, index / 4, seen.rgb, CAMERA, np.isfinite(seen.depth_mm), seen.depth_mm, T)
    return SimpleNamespace(frame=frame, track=SimpleNamespace(map=number))


def test_the_map_grows_and_a_failure_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_map, "_EVERY_S", 0.0)
    kept, drawn, areas = KeptDepth(tmp_path), Drawn(), []
    with LiveCoverage(kept) as live:
        assert (live.count, live.shown.png) == (0, b"")
        for index in range(30):
            step = step_of(index)
            kept.observe(step, drawn)  # type: ignore[arg-type]
            if index not in (12, 15, 29):
                continue
            drawn.ahead_mm = 0.0 if index == 12 else ALONG_THE_TUBE[index, 2] + 30
            live._next_s = 0.0
            live.observe(step, drawn)  # type: ignore[arg-type]
            live.settle()
            if index == 12:
                assert live.shown == (b"", f"No map of what was not seen in map 1 until 3 s: {NO_SURFACE}.")
                continue
            found = coverage(kept.folder)
            found.draw(tmp_path / "map.png")
            assert live.shown.png == (tmp_path / "map.png").read_bytes()
            assert f"until {index / 4:.0f} s, {100 * found.total.share:.0f} % was not seen" in live.shown.words
            areas.append(found.total.area)
    assert live.count == 3
    assert areas[1] > 1.3 * areas[0]


def test_a_session_without_processes_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_map, "_EVERY_S", 0.0)
    monkeypatch.setattr(live_map, "run_in_processes", MagicMock(side_effect=OSError("no memory")))
    kept, drawn = KeptDepth(tmp_path), Drawn(40.0)
    with LiveCoverage(kept) as live:
        for index in range(12):
            kept.observe(step_of(index), drawn)  # type: ignore[arg-type]
            live.observe(step_of(index), drawn)  # type: ignore[arg-type]
        live.settle()
    assert live.shown == (b"", "No map of what was not seen: no memory.")


def test_depth_is_kept_of_few_frames_of_each_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_map, "MOST_FRAMES", 6)
    monkeypatch.setattr(live_map, "_MOST_MAPS", 2)
    kept, drawn = KeptDepth(tmp_path), Drawn()
    for index in range(20):
        kept.observe(step_of(index, 0 if index < 14 else index - 13), drawn)  # type: ignore[arg-type]
    assert kept.frames(0)["index"].tolist() == [0, 4, 8, 12]
    assert [len(kept.frames(number)) for number in (1, 5, 6)] == [0, 0, 1]
    kept.move_to(tmp_path)
    reader = DepthReader(tmp_path)
    assert [index for index in range(20) if reader.has(index)] == [0, 4, 8, 12, 19]
    assert json.loads((tmp_path / "depth" / "depth.json").read_text())["scale_known"] is False
    kept.observe(step_of(20), Drawn())  # type: ignore[arg-type]
    assert kept.frames(0)["index"].tolist() == [20]  # after a reset
