"""Sizes of fusion that nobody set: they follow the scene, so a larger or smaller world gives the same surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config, FusionSettings
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame, Rows
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.fusion.surface_fusion import SurfaceFusion, TsdfVolume, choose_parameters, depth_notices
from tests.support.front_door import said
from tests.support.tiny_phantom import with_true_depth, write_tiny

pytestmark = pytest.mark.slow

VIEW = PinholeCamera(150.0, 150.0, 79.5, 59.5, 160, 120)


def wall(depth_mm: float, index: int = 0) -> Frame:
    rgb = np.full((120, 160, 3), 100, np.uint8)
    depth = np.full((120, 160), depth_mm, np.float32)
    return Frame(index, 0.0, rgb, VIEW, np.ones((120, 160), bool), depth, np.eye(4))


def test_what_is_set_stays_and_the_rest_follows_it() -> None:
    # Endo-Depth-and-Motion's, at a hand's breadth.
    assert choose_parameters(FusionSettings(), 60.0) == (1.0, 5.0, 200.0)
    assert choose_parameters(FusionSettings(voxel_mm=0.5)) == (0.5, 2.5, 100.0)
    assert choose_parameters(FusionSettings(voxel_mm=0.5, truncation_mm=4.0, max_depth_mm=30.0)) == (0.5, 4.0, 30.0)
    assert choose_parameters(FusionSettings(max_depth_mm=30.0), 120.0) == (2.0, 10.0, 30.0)
    assert choose_parameters(FusionSettings(voxel_mm=0.5), 90.0) == (0.5, 2.5, 100.0)


@pytest.mark.parametrize(("largest_mm", "said"), [(None, ["fusion-farther"]), (100.0, [])])
def test_voxels_that_are_set_leave_no_scene_out_unless_a_largest_depth_is_set(
    largest_mm: float | None, said: list[str]
) -> None:
    settings = FusionSettings(voxel_mm=0.5, max_depth_mm=largest_mm)
    fusion = SurfaceFusion(settings, FrameStore(), corrected=True)
    fused = fusion.fuse([wall(120.0, n) for n in range(3)], 120.0)
    assert [notice.code for notice in fused.notices] == said
    assert fused.settings.max_depth_mm == (largest_mm or 400.0)
    assert len(fused.mesh.faces) > 0 if largest_mm is None else len(fused.mesh.faces) == 0
    assert len(depth_notices([120.0], fused.settings)) == (0 if largest_mm is None else 1)


def test_the_store_returns_what_it_was_given_in_order_and_by_number(tmp_path: Path) -> None:
    store, frames = FrameStore(tmp_path), [wall(depth_mm, n) for n, depth_mm in enumerate((20_000.0, 30.0, 40.0))]
    frames[1] = replace(frames[1], depth_sigma_mm=np.full((120, 160), 0.3, np.float32), T_world_camera=None)
    for frame in frames:
        store.put(frame)
    assert len(store) == 3
    for before, after in zip(frames, store.frames(), strict=True):
        assert (after.index, after.camera) == (before.index, before.camera)
        np.testing.assert_allclose(after.depth_mm, before.depth_mm, rtol=2e-4)
        np.testing.assert_array_equal(after.valid, before.valid)
        np.testing.assert_allclose(after.rgb, before.rgb, atol=3)
    assert [frame.index for frame in store.frames({2, 0})] == [0, 2]
    (lost,) = store.frames([1])
    assert lost.T_world_camera is None
    assert lost.depth_sigma_mm == pytest.approx(0.3, rel=2e-4)
    assert store.median_depth_mm() == pytest.approx(40.0, rel=2e-4)
    assert store.median_depth_mm({1}) == pytest.approx(30.0, rel=2e-4)
    store.put(replace(wall(50_000.0, 3), valid=np.zeros((120, 160), bool)))
    assert store.median_depth_mm({3}) is None
    # Depth beyond the range is unknown.
    assert np.isnan(store.frame(3).depth_mm).all()


_KIND = np.dtype([("number", np.int64), ("at", np.float64, (2,))])


def _rows(*numbers: int) -> np.ndarray:
    return np.array([(number, (0.5, number)) for number in numbers], _KIND)


@pytest.mark.parametrize("on_disk", [False, True])
def test_rows_come_back_in_order_in_parts_and_without_those_forgotten(on_disk: bool, tmp_path: Path) -> None:
    rows = FrameStore(tmp_path).table("some", _KIND) if on_disk else Rows(_KIND)
    assert len(rows.read()) == 0
    for number in range(0, 300, 3):
        rows.append(_rows(number, number + 1, number + 2))
    rows.append(_rows())
    assert len(rows) == 300
    np.testing.assert_array_equal(rows.read(), _rows(*range(300)))
    np.testing.assert_array_equal(rows.read(7, 2), _rows(7, 8))
    rows.keep(np.arange(300) % 2 == 1)
    rows.append(_rows(300))
    np.testing.assert_array_equal(rows.read(), _rows(*range(1, 300, 2), 300))


def test_a_store_that_lost_bytes_is_refused(tmp_path: Path) -> None:
    store = FrameStore(tmp_path, name="stored")
    store.put(wall(30.0))
    record = store.record()
    store.put(wall(30.0, 1))
    store.resume(record)
    assert [frame.index for frame in store.frames()] == [0]
    for file in ("frames", "frame_entries"):
        whole = (tmp_path / "stored" / file).read_bytes()
        (tmp_path / "stored" / file).write_bytes(whole[:-1])
        store.resume(record)
        with pytest.raises(InputError, match=rf"the stored frames are damaged \({file}\)"):
            list(store.frames())
        (tmp_path / "stored" / file).write_bytes(whole)


@pytest.mark.parametrize(
    ("corrected", "voxel_mm", "shown", "at_end"),
    [(False, 1.0, False, False), (True, 1.0, False, True), (True, 1.0, True, True), (False, None, True, True)],
)
def test_frames_wait_where_they_are_corrected_or_voxels_follow_the_scene(
    corrected: bool, voxel_mm: float | None, shown: bool, at_end: bool
) -> None:
    settings = FusionSettings(voxel_mm=voxel_mm, every=2)
    fusion = SurfaceFusion(settings, FrameStore(), corrected=corrected)
    fusion.shown = shown
    frames = [wall(60.0, n) for n in range(3)]
    for frame in frames:
        fusion.put(frame)
    assert (fusion.at_end, fusion.at_once) == (at_end, shown or not at_end)
    assert bool(len(fusion.surface(0).faces)) == fusion.at_once
    surface = fusion.fuse(fusion.store.frames(), fusion.store.median_depth_mm())
    volume = TsdfVolume(FusionSettings(voxel_mm=1.0))
    for frame in frames[::2]:
        volume.integrate(frame)
    assert len(surface.mesh.vertices) == pytest.approx(len(volume.extract_mesh().vertices), rel=0.05)
    assert surface.settings.voxel_mm == 1.0
    assert len(surface.notices) == (voxel_mm is None)
    assert fusion.fuse([], None).settings.voxel_mm in (voxel_mm, 1.0)


def test_a_world_of_another_size_gives_the_same_surface_in_that_size(tmp_path: Path) -> None:
    phantom, factor = write_tiny(tmp_path / "phantom", frames=6), 30.0
    quick = {"networks__flow": "dis", "networks__perceptual": "structure"}
    same, other = (
        reconstruct(
            open_sequence(phantom),
            with_true_depth(phantom, depth__files_scale_mm=0.0015 * size, depth__max_depth_mm=1e4, **quick),
        )
        for size in (1.0, factor)
    )
    assert other.config.fusion.voxel_mm == pytest.approx(factor * same.config.fusion.voxel_mm, rel=0.05)
    # What a result states is what makes it again.
    (tmp_path / "config.toml").write_text(other.config.toml(), encoding="utf-8")
    again = reconstruct(open_sequence(phantom), Config.load(file=tmp_path / "config.toml"))
    assert again.config == other.config
    assert len(again.mesh.vertices) == pytest.approx(len(other.mesh.vertices), rel=0.001)
    assert len(other.mesh.vertices) == pytest.approx(len(same.mesh.vertices), rel=0.15)
    assert other.mesh.area == pytest.approx(factor**2 * same.mesh.area, rel=0.1)
    assert any(f"Voxels measure {other.config.fusion.voxel_mm:g} mm" in note for note in said(other.provenance))


def test_voxels_far_finer_than_a_pixel_are_made_larger_and_that_is_said() -> None:
    settings = FusionSettings(voxel_mm=0.01, truncation_mm=3.0, every=1)
    fusion, frame = SurfaceFusion(settings, FrameStore(), corrected=True), wall(60.0)
    fusion.put(frame)
    surface = fusion.fuse(fusion.store.frames(), 60.0)
    assert surface.settings.voxel_mm == pytest.approx(60.0 / frame.camera.fx / 4, rel=0.05)
    assert surface.settings.truncation_mm == 3.0
    assert "fusion-coarsened" in {notice.code for notice in surface.notices}
    assert len(surface.mesh.faces) > 100


def test_a_frame_without_depth_gives_no_volume_that_is_shown() -> None:
    fusion = SurfaceFusion(FusionSettings(every=1), FrameStore(), corrected=True)
    fusion.shown = True
    frame = wall(60.0)
    fusion.put(replace(frame, depth_mm=np.full_like(frame.depth_mm, np.nan)))
    assert not len(fusion.surface(0).faces)
    fusion.put(replace(frame, index=1))
    assert len(fusion.surface(0).faces) > 100
