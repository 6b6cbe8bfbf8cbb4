"""What a run keeps of each frame and keyframe until its end is small: the rest is on disk."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import REGIONS, Frame, rows_in_memory
from scopemap.engine.fusion.frame_store import FrameStore, SpreadFrames
from scopemap.engine.mapping import Backend
from scopemap.engine.mapping.feature_tracks import FeatureTracks
from scopemap.engine.mapping.mapper import Mapper
from scopemap.engine.tracking.track import Track
from scopemap.report.frame_pictures import FramePictures
from scopemap.result.frame_table import ROW, FrameTable, GrowingFrameTable
from tests.support import plane_scene
from tests.support.plane_scene import CAMERA

pytestmark = pytest.mark.slow


def _row(number: int) -> dict[str, Any]:
    T = plane_scene.pose(at_mm=(float(number), 1.0, 2.0))
    seen = {"usable": 0.9, "sharpness": 0.8, "nonrigidity": np.full(REGIONS, number, np.float32)}
    track = Track(number, "ok", f"reason {number} \u00e4", T, number // 10, 0.1, 0.5, iterations=number, map=2, **seen)
    pose = None if number % 3 == 0 else T + 1
    more = {"time_s": number / 30, "name": f"{number}\udcff.png", "depth_scale": 1.5}
    return track.row | more | {"T_world_camera": pose}


def _bytes_each(put: Callable[[int], object], count: int, warm_up: int) -> float:
    """Return how much memory grows with each number that is put, after some."""
    tracemalloc.start()
    for number in range(count):
        if number == warm_up:
            before = tracemalloc.get_traced_memory()[0]
        put(number)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    return grown / (count - warm_up)


@pytest.mark.parametrize("on_disk", [False, True])
def test_rows_come_back(on_disk: bool, tmp_path: Path) -> None:
    table = GrowingFrameTable(FrameStore(tmp_path).table if on_disk else rows_in_memory)
    assert (len(table), table.last_index, len(table.read())) == (0, -1, 0)
    for number in range(40):
        table.append(_row(number))
    assert (len(table), table.last_index) == (40, 39)

    def same(found: FrameTable, numbers: list[int]) -> None:
        wanted = FrameTable.of(map(_row, numbers))
        for name in ROW.names or ():
            np.testing.assert_array_equal(found[name], wanted[name])

    same(table.read(), [*range(40)])
    assert table.thin() == {*range(1, 20, 2)}
    same(table.read(), [*range(0, 20, 2), *range(20, 40)])


def test_a_frame_leaves_little_in_memory(tmp_path: Path) -> None:
    store = FrameStore(tmp_path)
    table, pictures = GrowingFrameTable(store.table), FramePictures()
    mapper = Mapper(MappingSettings(), DisFlow(), store.table)
    small = np.zeros((8, 8, 3), np.uint8)
    camera = CAMERA.resized(8, 8)

    def put(number: int) -> None:
        row = _row(number)
        table.append(row)
        mapper.observe(Track(number, "ok", "", np.eye(4), number // 10))
        store.put(Frame(number, 0.0, small, camera, small[..., 0] == 0, small[..., 0] + 1.0, row["T_world_camera"]))
        pictures.put(number, small, small[..., 0] == 0)

    # Measures of sharpness, 24 bytes, in an array that grows by a quarter.
    assert _bytes_each(put, 1500, 500) < 100


def test_frames_kept_to_check_the_surface_of_a_map_leave_little_in_memory(tmp_path: Path) -> None:
    store, maps, view = FrameStore(tmp_path), list[SpreadFrames](), plane_scene.frame(plane_scene.pose())

    def put(number: int) -> None:
        maps.append(SpreadFrames())
        for k in range(20):
            maps[-1].put(replace(view, index=20 * number + k), store)

    assert _bytes_each(put, 30, 10) < 0.1 * view.rgb.nbytes
    assert [frame.index for frame in maps[1].frames(store)] == list(range(20, 40, 2))


def test_a_keyframe_leaves_little_in_memory(tmp_path: Path) -> None:
    backend = Backend(MappingSettings(), DisFlow(), FrameStore(tmp_path).table)

    def put(number: int) -> None:
        view = plane_scene.see(plane_scene.pose(at_mm=(30.0 * np.sin(0.3 * number), 10.0 * np.cos(0.3 * number), 0.0)))
        frame = (view.rgb, CAMERA, plane_scene.EVERYWHERE, view.depth_mm, view.T_world_camera)
        backend.add(Frame(number, number / 3, *frame))
        backend.settle()

    # The last 32 keyframes; and the 64 strongest descriptors, of 400 keyframes at most: 16 KiB each.
    assert _bytes_each(put, 50, 40) < 24_000
    assert plane_scene.only(backend.adjust()).loop_frames


def test_of_many_maps_the_last_ones_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.engine.mapping.feature_tracks._MOST_MAPS", 2)
    tracks = FeatureTracks(DisFlow(), gaps=(1,))
    for number, map_number in enumerate((0, 1, 0, 2, 0, 1)):
        view = plane_scene.see(plane_scene.pose(at_mm=(2.0 * number, 0.0, 0.0)))
        frame = (view.rgb, CAMERA, plane_scene.EVERYWHERE, view.depth_mm, view.T_world_camera)
        tracks.add(Frame(number, number / 30, *frame), map_number)
    points, observations = tracks.collected()
    pairs = set(zip(points.host[observations.point].tolist(), observations.keyframe.tolist(), strict=True))
    # Map 1 was forgotten when map 2 began: the last keyframe has no other one to be matched with.
    assert pairs == {(0, 2), (2, 0), (2, 4), (4, 2)}
