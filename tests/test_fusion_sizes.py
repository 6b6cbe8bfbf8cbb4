"""Sizes of fusion that nobody set: they follow the scene, so a larger or smaller world gives the same surface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_phantom import with_true_depth, write_tiny

from scopemap import open_sequence, reconstruct
from scopemap.cameras.camera import PinholeCamera
from scopemap.config import Config, FusionSettings
from scopemap.frame import Frame
from scopemap.fusion import FrameSpool, TsdfVolume, choose_sizes, follows_scene, with_sizes

VIEW = PinholeCamera(150.0, 150.0, 79.5, 59.5, 160, 120)


def wall(depth_mm: float, index: int = 0) -> Frame:
    rgb = np.full((120, 160, 3), 100, np.uint8)
    depth = np.full((120, 160), depth_mm, np.float32)
    return Frame(index, 0.0, rgb, VIEW, np.ones((120, 160), bool), depth, np.eye(4))


def test_a_hand_s_breadth_has_the_voxels_of_endo_depth_and_motion() -> None:
    assert choose_sizes(FusionSettings(), 60.0) == (1.0, 5.0, 200.0)


def test_what_is_set_stays_and_the_rest_follows_it() -> None:
    assert choose_sizes(FusionSettings(voxel_mm=0.5)) == (0.5, 2.5, 100.0)
    assert choose_sizes(FusionSettings(voxel_mm=0.5, truncation_mm=4.0, max_depth_mm=30.0)) == (0.5, 4.0, 30.0)
    assert choose_sizes(FusionSettings(max_depth_mm=30.0), 120.0) == (2.0, 10.0, 30.0)


def test_a_volume_without_sizes_is_refused() -> None:
    for typical_mm in (None, float("nan"), 0.0):
        with pytest.raises(ValueError, match="typical depth must be known"):
            choose_sizes(FusionSettings(), typical_mm)
    with pytest.raises(ValueError, match=r"fusing without fusion\.voxel_mm"):
        TsdfVolume(FusionSettings())


def test_settings_state_what_was_used_and_read_back(tmp_path: Path) -> None:
    fusion = with_sizes(FusionSettings(), choose_sizes(FusionSettings(), 10.0))
    (tmp_path / "config.toml").write_text(Config(fusion=fusion).toml(), encoding="utf-8")
    read = Config.load(file=tmp_path / "config.toml").fusion
    assert (read.voxel_mm, read.truncation_mm, read.max_depth_mm) == (0.17, 0.85, 34.0)
    assert follows_scene(FusionSettings())
    assert not follows_scene(read)


def test_what_is_too_far_to_be_kept_is_unknown() -> None:
    spool = FrameSpool()
    spool.put(wall(50_000.0))
    spool.put(wall(20_000.0))
    far, near = spool.frames()
    assert far.depth_mm is not None
    assert near.depth_mm is not None
    assert np.isnan(far.depth_mm).all()
    np.testing.assert_allclose(near.depth_mm, 20_000.0, rtol=2e-4)


def test_the_typical_depth_is_the_median_over_frames_of_what_is_usable() -> None:
    spool = FrameSpool()
    assert spool.typical_mm() is None
    spool.put(replace(wall(70.0), valid=np.zeros((120, 160), bool)))
    assert spool.typical_mm() is None
    for n, depth_mm in enumerate((10.0, 12.0, 90.0)):
        spool.put(wall(depth_mm, n))
    assert spool.typical_mm() == pytest.approx(12.0)


@pytest.mark.parametrize("factor", [0.03, 30.0])
def test_a_world_of_another_size_gives_the_same_surface_in_that_size(tmp_path: Path, factor: float) -> None:
    phantom = write_tiny(tmp_path / "phantom", frames=6)
    quick = {"networks__flow": "dis", "networks__perceptual": "structure"}
    same, other = (
        reconstruct(
            open_sequence(phantom),
            with_true_depth(phantom, depth__files_scale_mm=0.0015 * size, depth__max_depth_mm=1e4, **quick),
        )
        for size in (1.0, factor)
    )
    assert same.config.fusion.voxel_mm is not None
    assert other.config.fusion.voxel_mm == pytest.approx(factor * same.config.fusion.voxel_mm, rel=0.05)
    # What a result states is what makes it again.
    (tmp_path / "config.toml").write_text(other.config.toml(), encoding="utf-8")
    again = reconstruct(open_sequence(phantom), Config.load(file=tmp_path / "config.toml"))
    assert again.config == other.config
    assert len(again.mesh.vertices) == pytest.approx(len(other.mesh.vertices), rel=0.001)
    assert len(other.mesh.vertices) == pytest.approx(len(same.mesh.vertices), rel=0.15)
    assert other.mesh.area == pytest.approx(factor**2 * same.mesh.area, rel=0.1)
    assert any(f"voxels of {other.config.fusion.voxel_mm:g} mm" in note for note in other.provenance["notes"])
